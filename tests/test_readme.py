"""The README's table is the one in results, and its manifest says where it comes from."""

import json

from nlt.paths import PROJECT


def test_table_is_the_results():
    readme = (PROJECT / "README.md").read_text()
    shown = readme.split("<!-- results/table2/table.md -->\n")[1].split("\n<!-- end -->")[0]
    assert shown.startswith("| method |") and shown.count("\n") == 10
    assert shown in (PROJECT / "results/table2/table.md").read_text()


def test_provenance():
    record = json.loads((PROJECT / "results/table2/manifest.json").read_text())
    assert record["command"].startswith("nlt compare") and len(record["commit"]) == 40
    assert record["n_test"] == 64 and record["seed"] == 0 and record["device"] and record["versions"]["torch"]
