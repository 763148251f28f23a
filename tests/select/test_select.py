"""`nlt select`: what varies against facts found independently; the statistics of the choice; the search end to end."""

import csv
import itertools
import json
import math
import re
import shutil
from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
import torch
import yaml
from scipy import stats
from tiny import SCALE, write

from nlt.baselines.feature_projection import FeatureProjection
from nlt.cli import main
from nlt.config import merge
from nlt.data.dataset import LightTransportDataset
from nlt.data.engines import Process
from nlt.data.generate import generate
from nlt.data.render import SampleRenderer
from nlt.data.spec import DatasetSpec
from nlt.errors import UserError
from nlt.evaluation import clock
from nlt.models.module import RenderingModule
from nlt.models.nlt import NeuralLightTransport
from nlt.paths import CONFIGS
from nlt.scenes.assembly import Scene
from nlt.scenes.builtin import BUILTINS, mitsuba_scene
from nlt.scenes.description import EXPERIMENTS, load_description
from nlt.scenes.pointcloud import sample_points
from nlt.select import advice, search
from nlt.select.choice import choose, paired_difference, ranked, within
from nlt.select.space import Candidate, SearchSpace
from nlt.waiting import WAIT_POLICY

pytestmark = pytest.mark.slow

pytest_plugins = ["training_fixtures"]

# ---- what varies ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=sorted(BUILTINS))
def built(request):
    """Yield (name, description, {shape: BSDF flags}, emitting shapes), by Mitsuba alone; scalar_rgb loads faster."""
    before = mi.variant()
    mi.set_variant("scalar_rgb")
    description = yaml.safe_load((CONFIGS / "scenes" / f"{request.param}.yaml").read_text())
    shapes = mitsuba_scene(request.param).shapes()
    flags = {shape.id(): int(shape.bsdf().flags()) for shape in shapes}
    yield request.param, description, flags, {shape.id() for shape in shapes if shape.is_emitter()}
    if before is not None:
        mi.set_variant(before)


def test_what_varies(built):
    """What moves, what emits and what is specular agrees with Mitsuba's own flags."""
    name, content, flags, emitting = built
    description = load_description(name)
    scenes = {experiment: Scene(description, experiment) for experiment in EXPERIMENTS[1:]}
    # Nothing is movable; the rest is that of fixed lights.
    scenes["static"] = SimpleNamespace(movables=description.movables("static"), shapes=scenes["fixed_lights"].shapes)
    for experiment, scene in scenes.items():
        moving, lights = advice.what_moves(scene)
        objects = content["objects"] if experiment != "static" else {}
        extra = {"moving_light"} if experiment == "moving_lights" else set()
        assert set(moving) == set(objects) | extra, experiment
        mine = {key for key, value in objects.items() if emitting & set(value["shapes"])}
        assert set(lights) == (extra or mine), experiment
        verdict = advice.advise(DatasetSpec([name], experiment), [facts(moving, lights)])[0].verdict
        assert verdict.partition(":")[0] == (
            "direct light or photons" if lights else "direct light or points" if moving else "none"
        )
    points = sample_points(scenes["fixed_lights"], 200, 0)
    shares = advice.shares_of_materials(points)
    lobes = [mi.BSDFFlags.GlossyReflection, mi.BSDFFlags.GlossyTransmission]
    lobes += [mi.BSDFFlags.DeltaReflection, mi.BSDFFlags.DeltaTransmission]
    specular = np.array([any(value & int(lobe) for lobe in lobes) for value in flags.values()])
    assert np.isclose(1 - shares.get("diffuse", 0), specular[points["shape"]].mean())
    assert np.isclose(sum(shares.values()), 1)
    assert advice.advise(DatasetSpec([name]), [facts(materials=shares)])[1].verdict == "needed"


def facts(moving=(), lights=(), materials=None, points=None, photons=None):
    flat = dict.fromkeys(advice._COUNTS, 1.0)
    return advice.Facts("room", tuple(moving), tuple(lights), materials or {"diffuse": 1.0}, points or flat,
                        photons or flat)  # fmt: skip


def test_advice_of_several_scenes():
    """A dataset needs what any of its scenes needs."""
    spec = DatasetSpec(["egg", "kitchen"], num_points=4096, num_photons=300)
    some = [facts(["cup"]), facts(["lamp", "cup"], ["lamp"], {"diffuse": 0.5, "mirror": 0.5})]
    transport, direction, *_ = advice.advise(spec, some)
    assert (
        transport.verdict.startswith("direct light or photons")
        and "lamp" in transport.reason
        and "cup" not in transport.reason
    )
    assert direction.verdict == "needed" and "mirror 25" in direction.reason
    assert advice.advise(spec, some[:1])[1].verdict.startswith("not needed")
    text = advice.table(advice.advise(spec, some), some)
    assert all(item.reason in text for item in advice.advise(spec, some))


def test_occupancy():
    """The expected occupancy agrees with the mean over subsets that are drawn."""
    rng = np.random.default_rng(0)
    pixels = rng.choice(33, 4096, p=rng.dirichlet(np.full(33, 0.3)))  # the last is for what is not seen
    surface = np.arange(32) % 4 > 0
    curve = advice.occupancy(pixels, surface, 4096)
    for n in (128, 512, 4096):
        drawn = [rng.choice(pixels, n, replace=False) for _ in range(400)]
        shares = [np.isin(np.flatnonzero(surface), subset).mean() for subset in drawn]
        assert np.isclose(curve[n], np.mean(shares), atol=0.01)
    assert advice.occupancy(pixels, np.zeros(32, bool), 4096)[128] == 0


def test_enough():
    """The saturation of a Poisson law agrees with a search over all counts."""
    for rate in (2e-4, 1e-3, 8e-3):
        curve = {n: 1 - np.exp(-rate * n) for n in advice._COUNTS}
        gains = [(n, curve[n] - curve[n // 2]) for n in advice._COUNTS[1:]]
        assert advice.enough(curve) == max(n for n, gain in gains if gain >= 0.05)
        spec = DatasetSpec(["egg"], num_points=1 << 20, num_photons=64)
        points, photons = advice.advise(spec, [facts(points=curve)])[2:]
        assert points.verdict == f"{advice.enough(curve):,} of {1 << 20:,}"
        assert photons.verdict == "all 64"
    assert advice.enough(dict.fromkeys(advice._COUNTS, 0.9)) == min(advice._COUNTS)


def test_coverage_is_that_of_the_area_seen(variant):
    """The measured occupancy of points is Poisson's for the area that each pixel sees."""
    spec = DatasetSpec(["egg"], "static", resolution=16, num_points=1 << 14, num_photons=64, train=0, val=0, test=3)
    found = advice._facts(spec, 0)
    render, shares = SampleRenderer(spec, 0), []
    area = sum(s.face_areas.sum() for s in render.scene.shapes.values()) * float(render.points()["area_share"])
    for view in range(3):
        sample = render.sample("test", view, only=("depth", "normal", "camera_matrix", "world_to_view"))
        # A pixel's corners on the plane through its centre: half the cross product of the diagonals.
        inverse, rotation = np.linalg.inv(sample["camera_matrix"].astype(float)), sample["world_to_view"][:3, :3]
        row, column = (x.ravel() for x in np.mgrid[:16, :16])
        rays = lambda di, dj, c=column, r=row, m=inverse: m @ np.stack([c + di, r + dj, np.ones_like(c)])
        normal = rotation @ sample["normal"].reshape(3, -1).astype(float)
        reach = (normal * rays(0.5, 0.5) * sample["depth"].ravel()).sum(0)
        corner = [rays(*o) * reach / (normal * rays(*o)).sum(0) for o in ((0, 0), (1, 1), (1, 0), (0, 1))]
        seen = np.linalg.norm(np.cross((corner[1] - corner[0]).T, (corner[3] - corner[2]).T), axis=1) / 2
        shares.append(seen[sample["depth"].ravel() > 0] / area)
    for n in (128, 512, 2048):
        assert abs(found.point_coverage[n] - np.mean([np.mean(1 - np.exp(-n * share)) for share in shares])) < 0.03


# ---- fewer points and photons ---------------------------------------------------------------------------


def test_thin():
    """The expected flux stays the same, and each emitter keeps its share of the photons."""
    torch.manual_seed(0)
    kinds = torch.repeat_interleave(torch.arange(4), torch.tensor([50, 10, 30, 10]))
    batch = {"photon_flux": torch.rand(2, 100, 3), "photon_origin": kinds.float().view(1, -1, 1).expand(2, -1, 3)}
    batch |= {"photon_hit": torch.rand(2, 100, 3), "point_position": torch.rand(2, 9, 3), "depth": torch.ones(2)}
    module = NeuralLightTransport(use_photons=True, width=2, num_points=9, max_points=4, max_photons=20)
    thin = module.subsample(batch)
    counts = np.bincount(thin["photon_origin"][0, :, 0].int().numpy())
    assert counts.tolist() == [10, 2, 6, 2]
    rows = [int((batch["photon_hit"][0] == hit).all(1).nonzero()) for hit in thin["photon_hit"][0]]
    assert len(set(rows)) == 20 and torch.equal(thin["photon_flux"], batch["photon_flux"][:, rows] * 5)
    assert torch.equal(thin["point_position"], batch["point_position"][:, :4]) and thin["depth"] is batch["depth"]
    again = module.subsample(thin)
    assert all(torch.equal(again[name], thin[name]) for name in thin)
    assert module.num_photons == 20 and module.embedding.table.weight.shape[0] == 4
    assert FeatureProjection(width=2, num_points=3, max_points=4).embedding.table.weight.shape[0] == 3


# ---- the choice -----------------------------------------------------------------------------------------


def test_paired_difference_of_one_seed():
    rng = np.random.default_rng(0)
    a, b = rng.normal(1, 0.1, (2, 1, 40)) + rng.normal(0, 5, 40)  # what images share cancels
    mean, error = paired_difference(a, b)
    assert np.isclose(mean, (a - b).mean()) and np.isclose(error, stats.sem((a - b)[0]))
    t = stats.ttest_rel(a[0], b[0])
    assert np.isclose(mean / error, t.statistic)


@pytest.mark.parametrize(("images", "seeds", "rest"), [(1.0, 0.3, 0.5), (0.1, 0.5, 1.0), (0.5, 0.0, 0.1)])
def test_paired_difference_over_seeds(images, seeds, rest):
    """The squared standard error is the variance of the mean over repeated experiments."""
    rng = np.random.default_rng(1)
    count, n = 5, 12
    means, squares = [], []
    for _ in range(4000):
        d = rng.normal(0, images, n) + rng.normal(0, seeds, (count, 1)) + rng.normal(0, rest, (count, n))
        mean, error = paired_difference(d, np.zeros_like(d))
        means.append(mean)
        squares.append(error**2)
    assert 0.93 < np.mean(squares) / np.var(means) < 1.2  # never taken as too small: the larger of the two stays


def test_choice_against_brute_force():
    rng = np.random.default_rng(2)
    disagreed = 0
    for _ in range(200):
        keys = [f"m{k}" for k in range(6)]
        shared = rng.normal(0, 1, 15)
        metrics = [{k: (rng.normal(rng.normal(0, 0.2), 0.5, 15) + shared)[None] for k in keys} for _ in range(2)]
        cost = {k: float(rng.integers(1, 6)) for k in keys}
        good = []
        for errors in metrics:
            best = sorted(keys, key=lambda k, e=errors: e[k].mean())[0]
            d = {k: errors[k][0] - errors[best][0] for k in keys}
            good.append({k for k in keys if k == best or d[k].mean() <= d[k].std(ddof=1) / np.sqrt(15)})
            assert set(within(errors)) == good[-1]
        both = good[0] & good[1]
        disagreed += not both
        assert cost[choose(metrics, cost)] == min(cost[k] for k in both or good[0])
        assert choose(metrics, cost) in (both or good[0])
    assert disagreed


def test_ranking_against_brute_force():
    """A candidate comes after all that beat it, and the Pareto front comes first."""
    rng = np.random.default_rng(3)
    for _ in range(30):
        points = {k: rng.integers(0, 5, 3) for k in range(8)}
        metrics = [{k: np.full((1, 4), float(p[m])) for k, p in points.items()} for m in (0, 1)]
        order = ranked(metrics, {k: float(p[2]) for k, p in points.items()})
        beats = lambda a, b, p=points: (p[a] <= p[b]).all() and (p[a] != p[b]).any()
        front = {k for k in points if not any(beats(other, k) for other in points)}
        assert sorted(order) == list(range(8)) and set(order[: len(front)]) == front
        for a, b in itertools.permutations(points, 2):
            assert not beats(a, b) or order.index(a) < order.index(b)


# ---- the search -----------------------------------------------------------------------------------------

SIZES = {"a": {"width": 2, "depth": 1}, "b": {"width": 3, "depth": 2}}
STEPS, EPOCH, BUDGET_S = 12, 4, 600.0


class Killed(BaseException):
    """Stands for a kill: the search does not catch it."""


class FakeTime:
    """A clock that counts steps: a training takes `setup` seconds, and a step takes `per_step` times the width."""

    def __init__(self, patch, per_step=1.0, setup=2.0):
        self.seconds, self.per_step, self.setup, self.begun, self.die = 0.0, per_step, setup, [], math.inf
        original = search.Search._fit

        def fit(this, run, candidate, seed, steps):
            self.begun.append((candidate.name, seed, steps, self.seconds))
            if len(self.begun) == self.die:  # an epoch before the end
                step = RenderingModule.training_step

                def die(module, *batch):
                    if module.global_step == steps - EPOCH:
                        raise Killed
                    return step(module, *batch)

                with pytest.MonkeyPatch.context() as dying:
                    dying.setattr(RenderingModule, "training_step", die)
                    original(this, run, candidate, seed, steps)
            done = original(this, run, candidate, seed, steps)
            width = SIZES[candidate.size.rpartition("/")[2].removesuffix(".yaml")]["width"]
            self.seconds += self.setup + done * self.per_step * width
            return done

        patch.setattr(search, "now", lambda: self.seconds)
        patch.setattr(search.Search, "_fit", fit)
        patch.setattr(search.Search, "_step_s", lambda this, module: self.per_step * module.hparams["width"])


class Here:
    """Replaces `Process` and calls the function here, where patches apply."""

    def __init__(self, function, *arguments):
        self.result = lambda: function(*arguments)


@pytest.fixture
def space(tiny, tmp_path, monkeypatch, one_thread):
    """Write the config of a space; the scene is not measured, and few frames are timed."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(advice, "measure_facts", lambda spec: [facts()])
    monkeypatch.setattr(clock, "WARM_UP", 1)
    monkeypatch.setattr(clock, "FRAMES", 3)
    monkeypatch.setattr(search, "Process", Here)
    monkeypatch.setenv(WAIT_POLICY, "passive")  # else it would be for the tests to come, too
    recipe = {"init_args": {"optimizer": "muon", "lr_schedule": "cosine"}}  # as the scales of configs/select
    scale = merge(SCALE, {"model": recipe, "trainer": {"max_steps": STEPS, "max_epochs": -1}})
    sizes = [str(write(tmp_path / f"{name}.yaml", {"model": {"init_args": size}})) for name, size in SIZES.items()]
    content = {
        "data": str(tiny.data), "scale": str(write(tmp_path / "scale.yaml", scale)), "methods": ["cnn", "nlt_photons"],
        "sizes": sizes, "point_counts": [64], "photon_counts": [32, 64], "minutes": BUDGET_S / 60, "seeds": 2,
    }  # fmt: skip
    return write(tmp_path / "space.yaml", content)


def run_select(config, *more, out="out"):
    assert main(["select", "--config", str(config), "--out", out, *more]) == 0
    return table(out, "table")


def table(out, name):
    with Path(out, f"{name}.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_end_to_end(space, tiny, monkeypatch, capsys):
    fake = FakeTime(monkeypatch)
    rows = run_select(space)
    assert len(rows) == 6 and {row["candidate"] for row in rows if row["full"] == "1"} == {
        "nlt_photons@b, 64 points, 64 photons"
    }
    said = capsys.readouterr().out
    assert "6 of 6 candidates fit" in said and "6 for 4 steps, 4 for 12 steps" in said and "nothing moves" in said
    # Rungs: every training goes on where it was, the finalists with a second seed.
    steps = [int(row["steps"]) for row in rows]
    assert sorted(steps) == [EPOCH] * 2 + [STEPS] * 4 and len(fake.begun) == 6 + 4 + 4
    (chosen,) = (row for row in rows if row["chosen"] == "1")
    finals = [row for row in rows if row["steps"] == str(STEPS)]
    assert chosen in finals and all(row["seeds"] == "2" for row in finals)
    # The rule, from the stored views alone.
    views = table("out", "views")
    good = []
    for key, sign in (("unbiased_mse", 1), ("mssim", -1)):
        errors = {row["candidate"]: np.zeros((2, 3)) for row in finals}
        for view in views:
            errors[view["candidate"]][int(view["seed"]), int(view["view"])] = sign * float(view[key])
        good.append(set(within(errors)))
    eligible = good[0] & good[1] or good[0]
    fastest = min((r for r in finals if r["candidate"] in eligible), key=lambda r: float(r["time_per_frame_s"]))
    assert fastest["candidate"] == chosen["candidate"]
    # The chosen config trains what was chosen.
    config = yaml.safe_load(Path("out/chosen.yaml").read_text())
    assert main(["fit", "--config=out/chosen.yaml", "--trainer.max_steps=1", "--trainer.default_root_dir=again"]) == 0
    assert config["trainer"]["max_steps"] == STEPS
    module = RenderingModule.load_from_checkpoint(next(Path("again").rglob("*.ckpt")))
    assert sum(p.numel() for p in module.parameters()) == int(chosen["parameters"])
    # Confirmed on the test split, by metrics computed here.
    confirmed = {row["role"]: row for row in table("out", "confirmed")}
    assert set(confirmed) == {"chosen", "full model", "best", "by parameters"}
    assert float(confirmed["full model"]["mssim_worse"]) == 0
    text = Path("out/table.md").read_text()
    ratio = float(confirmed["full model"]["time_per_frame_s"]) / float(confirmed["chosen"]["time_per_frame_s"])
    assert f"- {'holds' if ratio >= 2 else 'FAILS'}: at least 2x cheaper per frame: {ratio:.2f}x" in text
    fewest = min((r for r in finals if r["candidate"] in eligible), key=lambda r: float(r["parameters"]))
    assert confirmed["by parameters"]["candidate"] == fewest["candidate"]
    same = "gives the same model" if fewest == chosen else f"gives {fewest['candidate']}: "
    assert f"- compared: picking by the number of parameters {same}" in text
    for name in ("front.png", "front.svg", "advice.md"):
        assert Path("out", name).stat().st_size > 100
    manifest = json.loads(Path("out/manifest.json").read_text())
    assert manifest["rungs"] == [EPOCH, STEPS] and manifest["seeds"] == [0, 1]
    # Said again, nothing is trained again.
    del fake.begun[:]
    assert [row["candidate"] for row in run_select(space) if row["chosen"] == "1"] == [chosen["candidate"]]
    assert not fake.begun
    # Killed in the middle of a training and begun again, all is the same.
    (plan,) = Path("runs").rglob("plan.json")
    content = plan.read_text()
    shutil.rmtree("runs")
    write(plan.parent.mkdir(parents=True) or plan, content)
    fake.die = 8
    with pytest.raises(Killed):
        main(["select", "--config", str(space), "--out", "killed"])
    (record,) = {path for path in plan.parent.rglob("*.ckpt") if path.stat().st_mtime == newest(plan.parent)}
    assert f"step={STEPS - EPOCH}" in record.name
    assert run_select(space, out="killed") == rows


@pytest.mark.parametrize("lights", [(), ("lamp",)])
def test_advised_methods_go_to_the_end(space, monkeypatch, lights):
    """Where nothing moves, a CNN is trained to the end, although it is the slowest and the worst."""
    FakeTime(monkeypatch)
    monkeypatch.setattr(advice, "measure_facts", lambda spec: [facts(lights, lights)])
    score, race = search.Search.score, clock.Clock.time_interleaved
    worse = lambda this, candidate, *how: {
        key: [value + 9 * (candidate.method == "cnn") * (-1) ** (key == "mssim") for value in values]
        for key, values in score(this, candidate, *how).items()
    }
    slower = lambda this, modules, budget: {
        name: [{stage: t * (100 if "cnn" in name else 1) for stage, t in lap.items()} for lap in laps]
        for name, laps in race(this, modules, budget).items()
    }
    monkeypatch.setattr(search.Search, "score", worse)
    monkeypatch.setattr(clock.Clock, "time_interleaved", slower)
    finals = [row for row in run_select(space) if row["steps"] == str(STEPS)]
    assert len(finals) == 4 and any(row["full"] == "1" for row in finals)
    assert sum(row["method"] == "cnn" for row in finals) == (0 if lights else 1)


def test_the_best_goes_on_although_no_advice_names_it():
    methods = {"full": 3.0, "advised": 2.0, "also_advised": 4.0, "best": 1.0, "other": 1.5}
    candidates = {method: Candidate(method, "medium", None, None) for method in methods}
    entries = {c: SimpleNamespace(cost={"time_per_frame_s": 1.0}) for c in candidates.values()}
    errors = lambda chosen, key: {c: np.full((1, 4), methods[c.method]) for c in chosen}
    space, advised = SimpleNamespace(full=candidates["full"]), ["advised", "also_advised"]
    made = SimpleNamespace(space=space, advised=advised, entries=entries, errors=errors)
    order = [candidate.method for candidate in search.Search._order(made, list(entries))]
    assert order == ["full", "best", "advised", "also_advised", "other"]


def test_variants(space, tmp_path):
    """A method with a variant of its own, and a variant of all methods; the size still has the last word."""
    content = yaml.safe_load(space.read_text())
    content |= {"methods": ["cnn", "cnn@direct"], "variant": "demodulated"}
    read = SearchSpace.load(str(write(tmp_path / "variants.yaml", content)))
    plain, direct = (next(c for c in read.candidates if c.method == name) for name in content["methods"])
    assert direct.name == f"cnn@direct@{Path(direct.size).stem}" and plain.slug != direct.slug
    for candidate, is_direct in ((plain, False), (direct, True)):
        model = read.build(candidate)
        assert model.hparams["output"] == "demodulated" and model.hparams["direct_light"] == is_direct
    with pytest.raises(UserError, match=r"methods\.0: no variant 'dirct'"):
        SearchSpace.load(str(write(tmp_path / "variants.yaml", content | {"methods": ["cnn@dirct"]})))


def test_frames_are_timed_in_a_process(space):
    read = SearchSpace.load(str(space))
    candidates = read.candidates[:2]
    views = LightTransportDataset(generate(read.spec, read.root), read.spec, "val")
    costs = Process(search.frame_costs, read, views, candidates, 1.0).result()
    for candidate, cost in zip(candidates, costs, strict=True):
        assert cost["time_per_frame_s"] > 0 and cost["time_per_frame_p95_s"] > 0
        assert cost["parameters"] == sum(p.numel() for p in read.build(candidate).parameters())


def newest(folder):
    return max(path.stat().st_mtime for path in folder.rglob("*.ckpt"))


@pytest.mark.parametrize("slower", [1.0, 3.0])
def test_budget(space, monkeypatch, capsys, slower):
    """Less time means fewer candidates, and slower trainings exceed the budget by at most one training."""
    fake = FakeTime(monkeypatch)
    budget = 100.0
    measured = search.Search._step_s
    monkeypatch.setattr(search.Search, "_step_s", lambda this, module: measured(this, module) / slower)
    run_select(space, f"--minutes={budget / 60}")
    assert "of 6 candidates fit" in capsys.readouterr().out
    longest = fake.setup + STEPS * 3
    assert fake.seconds <= budget + longest and all(begun < budget for *_, begun in fake.begun)
    assert fake.seconds > budget / 4


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"method": ["cnn"]}, "method: unknown key"),
        ({"methods": ["cnm"]}, "methods.0: no model 'cnm'"),
        ({"methods": []}, "methods: must be a list of at least 1"),
        ({"methods": ["oidn_1"]}, "methods: oidn_1 is not trained"),
        ({"point_counts": [65]}, "point_counts: 65 is more than the 64"),
        ({"photon_counts": [0]}, "photon_counts.0: must be above 0"),
        ({"photon_counts": [8, 8]}, "photon_counts: must not have duplicates"),
        ({"minutes": 0}, "minutes: must be above 0"),
        ({"minutes": 1e-3}, "--minutes: 0.001 are too few"),
        ({"seeds": 0}, "seeds: must be above 0"),
        ({"scale": "none"}, "No such file"),
        ({"data": None}, "data: must be a text"),
    ],
)
def test_mistakes(space, tmp_path, monkeypatch, capsys, change, said):
    FakeTime(monkeypatch)
    config = write(tmp_path / "wrong.yaml", {**yaml.safe_load(space.read_text()), **change})
    assert main(["select", "--config", str(config)]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1 and "Traceback" not in error


def test_only_advice(tmp_path, monkeypatch, capsys):
    """The command measures a scene in a separate process and trains nothing."""
    content = yaml.safe_load((CONFIGS / "select/demo.yaml").read_text())
    config = write(tmp_path / "advice.yaml", {**content, "data": "builtin_egg"})
    monkeypatch.chdir(tmp_path)
    assert main(["select", "--config", str(config), "--advice"]) == 0
    said = capsys.readouterr().out
    assert "light transport: none: feature_projection" in said and "glass" in said
    assert re.search(r"points: .*\d+% of the pixels", said, re.DOTALL) and not any(tmp_path.glob("results"))
