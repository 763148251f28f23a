"""What the documentation names is there."""

import re

import pytest

from nlt.paths import PROJECT

PAGES = [PROJECT / "README.md", *sorted((PROJECT / "docs").glob("*.md"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_files_and_tests_exist(page):
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)  # what a user would type or write
    files = re.findall(r"(?<![\w/])(?:nlt|tests|configs|scripts|benchmarks)/[\w/.-]*\w", text)
    links = re.findall(r"\]\((?!https?:)([^)#]+)\)", text)
    assert files or links
    missing = [file for file in files if not (PROJECT / file).exists()]
    missing += [link for link in links if not (page.parent / link).exists()]
    for file, name in re.findall(r"(test_\w+\.py)::(\w+)", text):
        if f"def {name}(" not in (PROJECT / "tests" / file).read_text():
            missing.append(f"{file}::{name}")
    assert not missing
