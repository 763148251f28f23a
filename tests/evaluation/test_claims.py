"""The paper's claims on made-up results: the paper's own numbers, others, noisy ones, missing ones."""

import json

import numpy as np
import pytest
import scipy.stats
from made_results import make_results, papers_numbers

from nlt.evaluation.claims import claims_of, difference, judge
from nlt.evaluation.paper import paper, tables
from nlt.evaluation.results import load, write_manifest
from nlt.metrics.quantities import QUANTITIES
from nlt.report.claims import text, write_claims


def verdicts(results):
    return {claim.id: claim.verdict for claim in judge(results)}


def test_there_are_enough_and_they_are_of_the_papers_tables_and_methods():
    claims = [claim for table in tables() for claim in claims_of(table)]
    assert len(claims) == len({claim["id"] for claim in claims}) >= 12
    known = {*paper()["labels"]}
    for claim in claims:
        named = [m for key in ("better", "than", "order", "close", "to") for m in claim.get(key, [])]
        assert named and set(named) <= known and set(claim["metrics"]) <= set(QUANTITIES)
        assert claim["where"] and claim["says"]


@pytest.mark.parametrize("table", [table for table in tables() if table != "static"])
def test_the_papers_numbers_bear_the_papers_claims(tmp_path, table):
    found = verdicts(make_results(tmp_path, papers_numbers(table), table))
    assert len(found) >= 4
    assert set(found.values()) == {"holds"}, found


@pytest.mark.parametrize(("error", "verdict"), [(1.0, "holds"), (2.0, "does not hold")])
def test_pointnet_is_level_with_feature_projection_where_nothing_moves(tmp_path, error, verdict):
    rows = papers_numbers("table2")
    rows["feature_projection"] = {column: value * error for column, value in rows["nlt"].items()}
    found = verdicts(make_results(tmp_path, rows, "static"))
    assert found == {"static-scenes-accurate": "holds", "static-scenes-need-no-transport": verdict}


def test_reversed_numbers_do_not(tmp_path):
    rows = papers_numbers("table2")
    swapped = rows | {"nlt_photons": rows["cnn"], "cnn": rows["nlt_photons"]}
    found = verdicts(make_results(tmp_path, swapped, "table2"))
    assert found["photons-best-moving-lights"] == found["photons-help-moving-lights"] == "does not hold"
    assert found["denoising-degrades-moving-lights"] == "holds"


@pytest.mark.parametrize("noise", [{"over_views": 0.9}, {"seeds": 3, "over_seeds": 0.5}])
def test_noise_leaves_them_undecided(tmp_path, noise):
    """Whether over views or over seeds."""
    assert verdicts(make_results(tmp_path, papers_numbers("table2"), "table2", **noise))[
        "photons-help-moving-lights"
    ] == ("undecided")


def test_a_missing_method_or_metric_is_said(tmp_path):
    rows = papers_numbers("table2")
    del rows["nlt"]
    for row in rows.values():
        del row["mssim"]
    results = make_results(tmp_path, rows, "table2")
    found = verdicts(results)
    assert found["transport-helps-moving-lights"] == found["projection-far-behind-moving-lights"] == "not measured"
    assert found["real-time"] == "holds"
    write_claims(results)
    assert "nan" not in (tmp_path / "claims.json").read_text().lower()


def test_interval_over_views_is_the_paired_t_interval(tmp_path):
    results = make_results(tmp_path, papers_numbers("table1"), "table1", over_views=0.3)
    value, half = difference(results, "mssim", "cnn", "nlt")
    x, y = results.per_view("cnn", "mssim"), results.per_view("nlt", "mssim")
    expected = scipy.stats.ttest_rel(x, y).confidence_interval(0.95)
    assert half == pytest.approx((expected.high - expected.low) / 2)
    assert value == pytest.approx(results.mean("cnn", "mssim") - results.mean("nlt", "mssim"))


def test_interval_over_seeds_is_welchs(tmp_path):
    results = make_results(tmp_path, papers_numbers("table1"), "table1", seeds=4, over_seeds=0.2, over_views=0.0)
    _, half = difference(results, "mse", "cnn", "nlt")
    found = scipy.stats.ttest_ind(results.values("cnn", "mse"), results.values("nlt", "mse"), equal_var=False)
    interval = found.confidence_interval(0.95)
    assert half == pytest.approx((interval.high - interval.low) / 2)


def test_interval_covers(tmp_path):
    """95% intervals of a difference of two noisy means contain the true one about as often."""
    rng, hits, tries = np.random.default_rng(1), 0, 60
    for k in range(tries):
        rows = {m: {"mse": 1.0} for m in ("cnn", "nlt")}
        results = make_results(tmp_path / str(k), rows, "table1")
        for view in results.views:
            view["mse"] = 1 + rng.standard_normal()
        for run in results.runs:
            run["mse"] = results.per_view(run["method"], "mse").mean()
        value, half = difference(results, "mse", "cnn", "nlt")
        hits += abs(value) < half
    assert scipy.stats.binomtest(hits, tries, 0.95).pvalue > 1e-3


def test_a_difference_below_the_references_error_is_said(tmp_path):
    """In every metric with a floor, and in no other; the verdicts stay."""
    results = make_results(tmp_path, papers_numbers("table2"), "table2")
    before = judge(results)
    assert not any(c.below_floor for claim in before for c in claim.comparisons)
    floor = {"mse": 0.004, "mssim": 0.97, "psnr": 30.0}
    write_manifest(tmp_path, {**results.manifest, "floor": floor})
    results = load(tmp_path)
    after = write_claims(results)
    assert [claim.verdict for claim in after] == [claim.verdict for claim in before]
    least = {"mse": 0.004, "mssim": 0.03}
    for claim in after:
        for c in claim.comparisons:
            gap = abs(results.mean(c.method, c.metric) - results.mean(c.other, c.metric))
            assert c.below_floor == (gap < least.get(c.metric, 0))
        assert text(claim).endswith("smaller than the reference's own error") == claim.weakest.below_floor
    assert len({c.below_floor for claim in after for c in claim.comparisons if c.metric in least}) == 2
    assert "smaller than the reference's own error" in (tmp_path / "claims.md").read_text()


def test_the_deciding_comparison_is_shown(tmp_path):
    rows = papers_numbers("table1")
    rows["nlt"]["fid"] = 20.0  # better than with photons
    results = make_results(tmp_path, rows, "table1")
    (claim,) = [claim for claim in judge(results) if claim.id == "photons-best-fixed-lights"]
    assert (claim.verdict, claim.weakest.metric, claim.weakest.other) == ("does not hold", "fid", "nlt")
    assert claim.weakest.margin == pytest.approx(20.0 - 30.6, rel=0.01)
    assert claim.weakest.low < claim.weakest.margin < claim.weakest.high < 0
    write_claims(results)
    (stored,) = [c for c in json.loads((tmp_path / "claims.json").read_text()) if c["id"] == claim.id]
    assert len(stored["comparisons"]) == 16 and stored["verdict"] == "does not hold"
    assert (
        f"| {claim.id} | **does not hold** | FID, Ours (w/ photons) against Ours (w/o photons)"
        in (tmp_path / "claims.md").read_text()
    )
