"""Copies the tables that the README shows out of results/: `python scripts/update_readme.py`."""

import re
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[1]


def first_table(path: Path) -> str:
    """The first table of a Markdown file."""
    lines = path.read_text().splitlines()
    start = next(k for k, line in enumerate(lines) if line.startswith("|"))
    stop = next(k for k in range(start, len(lines)) if not lines[k].startswith("|"))
    return "\n".join(lines[start:stop])


def update(text: str) -> str:
    """The text with every block between `<!-- results/.../table.md -->` and `<!-- end -->` made anew."""
    block = re.compile(r"<!-- (results/\S+/table\.md) -->\n.*?\n<!-- end -->", re.DOTALL)
    return block.sub(lambda m: f"<!-- {m[1]} -->\n{first_table(PROJECT / m[1])}\n<!-- end -->", text)


if __name__ == "__main__":
    readme = PROJECT / "README.md"
    readme.write_text(update(readme.read_text()))
