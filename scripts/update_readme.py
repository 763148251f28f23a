"""Copies what the documentation shows out of results/ and the code: `python scripts/update_readme.py`.

A block between `<!-- SOURCE -->` and `<!-- end -->` is made anew, where SOURCE is a table of results
(`results/NAME/table.md`, of which the first is shown), another page of results (shown whole, such as
`results/NAME/stress/stress.md`), a group of fields (`nlt/data/sample.py FIELDS`) or `scripts/paper_scale.py`.
"""

import re
import runpy
from pathlib import Path

from nlt.data import sample

PROJECT = Path(__file__).resolve().parents[1]
PAGES = [PROJECT / "README.md", *sorted((PROJECT / "docs").glob("*.md"))]


def content(source: str) -> str:
    """What belongs into a block."""
    path, _, name = source.partition(" ")
    if path == "nlt/data/sample.py":
        return field_table(getattr(sample, name))
    if path == "scripts/paper_scale.py":
        return str(runpy.run_path(str(PROJECT / path))["tables"](PROJECT / "results/bench/target"))
    return first_table(PROJECT / path) if path.endswith("/table.md") else body(PROJECT / path)


def body(path: Path) -> str:
    """A Markdown file without its title, a level lower; that it is not there, where it is not."""
    if not path.exists():
        return f"Not measured yet: there is no {path.relative_to(PROJECT)}."
    return re.sub(r"^#", "##", path.read_text().partition("\n")[2].strip(), flags=re.MULTILINE)


def first_table(path: Path) -> str:
    """The first table of a Markdown file."""
    lines = path.read_text().splitlines()
    start = next(k for k, line in enumerate(lines) if line.startswith("|"))
    stop = next(k for k in range(start, len(lines)) if not lines[k].startswith("|"))
    return "\n".join(lines[start:stop])


def field_table(fields: dict[str, sample.Field]) -> str:
    """A row per field of a sample."""
    rows = ["| field | shape | dtype | unit | meaning |", "|---|---|---|---|---|"]
    for name, f in fields.items():
        star, shape = " *" * f.reference_only, ", ".join(map(str, f.shape))
        rows.append(f"| `{name}`{star} | ({shape}) | {f.dtype} | {f.unit} | {f.meaning} |")
    return "\n".join(rows)


def update(text: str) -> str:
    """The text with every block made anew."""
    block = re.compile(r"<!-- (results/\S+\.md|nlt/\S+ \w+|scripts/\S+) -->\n.*?<!-- end -->", re.DOTALL)
    return block.sub(lambda m: f"<!-- {m[1]} -->\n{content(m[1])}\n<!-- end -->", text)


if __name__ == "__main__":
    for page in PAGES:
        page.write_text(update(page.read_text()))
