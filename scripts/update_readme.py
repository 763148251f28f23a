"""Update the documentation's copies of results and of the code's tables: `python scripts/update_readme.py`.

Each block between `<!-- SOURCE -->` and `<!-- end -->` is generated again. SOURCE is a table of results
(`results/NAME/table.md`, whose first table is shown), the first table below a heading of another page of results
(`results/NAME/stress/stress.md Ranks`), such a page as a whole (without a heading), a group of fields
(`nlt/data/sample.py FIELDS`), or a script with a function `tables()` (`scripts/paper_scale.py`).
"""

import re
import runpy
from pathlib import Path

from nlt.data import sample

PROJECT = Path(__file__).resolve().parents[1]
PAGES = [PROJECT / "README.md", *sorted((PROJECT / "docs").glob("*.md"))]


def content(source: str) -> str:
    """Return the content of a block."""
    path, _, name = source.partition(" ")
    if path == "nlt/data/sample.py":
        return field_table(getattr(sample, name))
    if path.startswith("scripts/"):
        return str(runpy.run_path(str(PROJECT / path))["tables"]())
    return first_table(PROJECT / path, name) if name or path.endswith("/table.md") else body(PROJECT / path)


def body(path: Path) -> str:
    """Return a Markdown file without its title, a level lower, or a note that the file does not exist yet."""
    if not path.exists():
        return f"Not measured yet: there is no {path.relative_to(PROJECT)}."
    return re.sub(r"^#", "##", path.read_text().partition("\n")[2].strip(), flags=re.MULTILINE)


def first_table(path: Path, heading: str = "") -> str:
    """Return the first table of a Markdown file, or the first one below a heading."""
    lines = path.read_text().splitlines()
    below = lines.index(f"## {heading}") if heading else 0
    start = next(k for k in range(below, len(lines)) if lines[k].startswith("|"))
    stop = next(k for k in range(start, len(lines)) if not lines[k].startswith("|"))
    return "\n".join(lines[start:stop])


def field_table(fields: dict[str, sample.Field]) -> str:
    """Return a Markdown table with a row per field of a sample."""
    rows = ["| field | shape | dtype | unit | meaning |", "|---|---|---|---|---|"]
    for name, f in fields.items():
        where = "" if f.splits == sample.SPLITS else f" ({', '.join(f.splits)})"
        shape = ", ".join(map(str, f.shape))
        rows.append(f"| `{name}`{where} | ({shape}) | {f.dtype} | {f.unit} | {f.meaning} |")
    return "\n".join(rows)


def update(text: str) -> str:
    """Return the text with every block generated again."""
    block = re.compile(r"<!-- (results/\S+\.md(?: [^>]+)?|nlt/\S+ \w+|scripts/\S+) -->\n.*?<!-- end -->", re.DOTALL)
    return block.sub(lambda m: f"<!-- {m[1]} -->\n{content(m[1])}\n<!-- end -->", text)


if __name__ == "__main__":
    for page in PAGES:
        page.write_text(update(page.read_text()))
