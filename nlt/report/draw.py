"""`nlt report DIR`: tables, figures and report.html from stored results; the same results give the same bytes."""

from collections.abc import Callable, Iterable
from pathlib import Path

from nlt.evaluation.results import load
from nlt.report.claims import text, write_claims
from nlt.report.figures import draw_learning_curves, draw_speed_accuracy
from nlt.report.gallery import Shown, draw_failures, draw_qualitative, draw_samples
from nlt.report.page import Section, write_page
from nlt.report.tables import write_tables


def draw(
    directory: str | Path, megabytes: int | None = None, sections: Iterable[Callable[[Path], Section | None]] = ()
) -> None:
    """Write the tables, figures and report.html (at most `megabytes`) of the results in a directory.

    `sections` are functions that return a feature's section of report.html for a directory, or None. Raise UserError if
    the directory has no results or they cannot be read.
    """
    results = load(directory)
    write_tables(results)
    claims = write_claims(results)
    measured = [claim for claim in claims if claim.verdict != "not measured"]
    for claim in measured:
        print(f"{claim.verdict:13}  {claim.id:40} {text(claim)}")
    if unmeasured := len(claims) - len(measured):
        print(f"{unmeasured} other claims were not measured; see claims.md")
    draw_speed_accuracy(results)
    draw_learning_curves(results)
    if images := Shown.load(results):
        draw_samples(images)
        if images.methods:
            draw_qualitative(images)
            draw_failures(images)
    write_page(results, claims, megabytes, [section(results.directory) for section in sections])
