"""What the documentation names is there, and what it copies is as it stands there."""

import re
import runpy
import tomllib

import pytest
import yaml

from nlt import __version__
from nlt.data.spec import FORMAT, DatasetSpec
from nlt.data.store import points_name
from nlt.paths import PROJECT

PAGES = [*sorted(PROJECT.glob("*.md")), *sorted((PROJECT / "docs").glob("*.md"))]


def anchors(page):
    """Return the anchors of a page's headings."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_files_and_tests_exist(page):
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)  # what a user would type or write
    files = re.findall(r"(?<![\w/])(?:nlt|tests|configs|scripts|benchmarks)/[\w/.-]*\w", text)
    links = re.findall(r"\]\((?!https?:)([^)#]+)(?:#([^)]+))?\)", text)
    assert files or links or page.name == "CHANGELOG.md"
    missing = [file for file in files if not (PROJECT / file).exists()]
    for link, anchor in links:
        if not (page.parent / link).exists() or (anchor and anchor not in anchors(page.parent / link)):
            missing.append(f"{link}#{anchor}")
    for file, name in re.findall(r"(test_\w+\.py)::(\w+)", text):
        if f"def {name}(" not in next((PROJECT / "tests").rglob(file)).read_text():
            missing.append(f"{file}::{name}")
    assert not missing


def test_copies_are_as_they_stand():
    """Tables of results, fields of a sample, estimates: `python scripts/update_readme.py` changes nothing."""
    script = runpy.run_path(str(PROJECT / "scripts/update_readme.py"))
    assert set(script["PAGES"]) <= set(PAGES)
    copied = "".join(page.read_text() for page in script["PAGES"])
    for source in (
        "results/real_living_room_256/table.md",
        "results/real_living_room/table.md",
        "nlt/data/sample.py FIELDS",
        "scripts/paper_scale.py",
        "scripts/claims.py",
        "results/recipe/table.md",
    ):
        assert f"<!-- {source} -->" in copied
    assert script["update"](copied) == copied
    forged = copied.replace("first half of the reference", "a number of someone's")
    assert script["update"](forged) == copied != forged


def test_files_of_a_dataset():
    """docs/data-format.md: the format's number, the names of the files, the keys of the manifest."""
    page, spec = (PROJECT / "docs/data-format.md").read_text(), DatasetSpec(["egg"], "static", train=1, val=1, test=1)
    assert f"Format {FORMAT} " in page and points_name(0) in page
    for shard in spec.shards():
        assert shard.name in page or f"{shard.split}/..." in page
    assert all(f"`{key}`" in page for key in (*spec.manifest, "variant"))


def test_citation_and_licence():
    """CITATION.cff has what its format requires, and says the same as the package."""
    cited = yaml.safe_load((PROJECT / "CITATION.cff").read_text())
    assert {"cff-version", "message", "title", "authors"} <= set(cited)
    project = tomllib.loads((PROJECT / "pyproject.toml").read_text())["project"]
    assert cited["version"] == project["version"] == __version__
    assert cited["license"] == project["license"] == (PROJECT / "LICENSE").read_text().split()[0]
