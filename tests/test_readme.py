"""The manifest of the README's table says where it comes from."""

import json

from nlt.paths import PROJECT


def test_provenance():
    record = json.loads((PROJECT / "results/table2/manifest.json").read_text())
    assert record["command"].startswith("nlt compare") and len(record["commit"]) == 40
    assert record["n_test"] >= 64 and record["seeds"][0] == 0 and record["device"] and record["versions"]["torch"]
