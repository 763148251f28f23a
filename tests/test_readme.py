"""The README's tables are those in results, and their manifests say where they come from."""

import json
import runpy

from nlt.paths import PROJECT


def test_tables_are_the_results():
    readme = (PROJECT / "README.md").read_text()
    assert "<!-- results/table2/table.md -->" in readme
    assert runpy.run_path(str(PROJECT / "scripts/update_readme.py"))["update"](readme) == readme


def test_provenance():
    record = json.loads((PROJECT / "results/table2/manifest.json").read_text())
    assert record["command"].startswith("nlt compare") and len(record["commit"]) == 40
    assert record["n_test"] == 64 and record["seeds"] == [0] and record["device"] and record["versions"]["torch"]
