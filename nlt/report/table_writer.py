"""Tables of text, written as Markdown and LaTeX."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from nlt.data.files import write_bytes
from nlt.evaluation.results import Results


@dataclass(frozen=True)
class Table:
    """A table of text cells; `first` is the heading of the first column, which names the row."""

    title: str
    note: str
    columns: list[str]
    rows: list[list[str]]
    # The quantity of each column and the results that it is from; empty for a table of other things.
    sources: list[tuple[str, Results]] = field(default_factory=list)
    first: str = "method"


def line(cells: Iterable[object]) -> str:
    """Return a row of a Markdown table."""
    return f"| {' | '.join(map(str, cells))} |"


def grid(headings: Sequence[str], rows: Iterable[Iterable[object]], numbers: bool = True) -> list[str]:
    """Return the lines of a Markdown table; `numbers` aligns all columns but the first to the right."""
    return [line(headings), "|---|" + ("---:|" if numbers else "---|") * (len(headings) - 1), *map(line, rows), ""]


def section(table: Table, level: int = 2, numbers: bool = True) -> list[str]:
    """Return the lines of a table in Markdown, with its title as a heading of this level and its note."""
    note = [table.note, ""] if table.note else []
    return [f"{'#' * level} {table.title}", "", *note, *grid([table.first, *table.columns], table.rows, numbers)]


def write_texts(path: Path, tables: Sequence[Table], source: str) -> None:
    """Write tables to `path` with the suffixes .md and .tex; `source` names the files that the numbers come from."""
    lines = [text for k, table in enumerate(tables) for text in section(table, 2 if k else 1)]
    lines += [f"Source of the numbers: manifest.json, {source}.", ""]
    write_bytes(path.with_suffix(".md"), "\n".join(lines).encode())
    write_bytes(path.with_suffix(".tex"), "\n".join(text for table in tables for text in _latex(table)).encode())


_COMMANDS = {
    **{c: f"\\{c}" for c in "&%$#_{}"}, "±": r"$\pm$", "↓": r"$\downarrow$", "↑": r"$\uparrow$", "≈": r"$\approx$",
    "–": "--",
}  # fmt: skip


def _latex(table: Table) -> list[str]:
    """Return the lines of a table in LaTeX; the document needs \\usepackage{booktabs}."""
    escape = lambda text: text.translate(str.maketrans(_COMMANDS))
    row = lambda cells: " & ".join(map(escape, cells)) + r" \\"
    caption = escape(f"{table.title}. {table.note}".strip())
    return [
        r"\begin{table}", r"\centering\footnotesize", f"\\caption{{{caption}}}",
        f"\\begin{{tabular}}{{l{'r' * len(table.columns)}}}", r"\toprule", row([table.first, *table.columns]),
        r"\midrule", *map(row, table.rows), r"\bottomrule", r"\end{tabular}", r"\end{table}", "",
    ]  # fmt: skip
