"""`nlt report DIR`: whatever is made of stored results. Made again from the same results, no byte changes."""

from __future__ import annotations

from pathlib import Path

from nlt.evaluation.claims import text, write_claims
from nlt.evaluation.drawing.figures import draw_samples, draw_speed_accuracy
from nlt.evaluation.drawing.gallery import Shown, draw_failures, draw_qualitative
from nlt.evaluation.drawing.learning_curves import draw_learning_curves
from nlt.evaluation.drawing.page import write_page
from nlt.evaluation.drawing.stress_figures import draw_stress
from nlt.evaluation.drawing.stress_report import STRESS
from nlt.evaluation.drawing.tables import write_tables
from nlt.evaluation.results import load


def draw(directory: str | Path, megabytes: int | None = None) -> None:
    """Tables, figures and report.html, of at most so many megabytes, of the results in a directory.

    Raises:
        UserError: there are none.
    """
    results = load(directory)
    write_tables(results)
    claims = write_claims(results)
    for claim in claims:
        print(f"{claim.verdict:13}  {claim.id:40} {text(claim)}")
    draw_samples(results)
    draw_speed_accuracy(results)
    draw_learning_curves(results)
    if images := Shown.load(results):
        draw_qualitative(images)
        draw_failures(images)
    draw_stress(results.directory / STRESS)
    write_page(results, claims, megabytes)
