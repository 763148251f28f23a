"""The stress suites: what a manifest may say, what each change does to scene, points and camera."""

from __future__ import annotations

import dataclasses
import os
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh
import yaml
from generated import spec_of
from made_results import make_results, papers_numbers
from safetensors import safe_open
from synthetic import PHOTONS, POINTS, synthetic_batch
from torch import nn

from nlt.cli import main
from nlt.config import merge
from nlt.data.render import SampleRenderer
from nlt.errors import UserError
from nlt.evaluation.paper import label
from nlt.evaluation.results import read_rows, write_manifest, write_rows
from nlt.models.module import PROJECTION
from nlt.models.projection import visible_pixels
from nlt.models.transport import PointEmbedding
from nlt.paths import CONFIGS
from nlt.report.page import write_page
from nlt.stress.breaking import Stressed, breaking_point
from nlt.stress.changed_scene import MESHES, ChangedScene
from nlt.stress.inputs import INPUTS
from nlt.stress.perturber import PLACES, ViewPerturber
from nlt.stress.rendering import view_sets
from nlt.stress.report import stress_section
from nlt.stress.suites import FLICKER, PATHS, ROWS, STEADY, load_suites
from nlt.stress.views import nearest_embeddings

pytestmark = pytest.mark.slow

pytest_plugins = ["training_fixtures"]

MANIFEST = CONFIGS / "stress" / "suites.yaml"


def test_the_manifest_names_changes_that_there_are():
    suites = load_suites("suites")
    known = {*MESHES, *PLACES, *INPUTS}
    assert {ladder.change for ladder in suites.ladders.values()} == known


def test_fewer_views_are_another_set(spec, tmp_path):
    """They do not mix with what the manifest's number of views has rendered."""
    whole, fewer = load_suites("suites"), load_suites("suites", views=1)
    assert {view_set.views for view_set in view_sets(spec, fewer, ["camera"])} == {1} != {whole.views}
    assert whole.directory(spec, tmp_path) != fewer.directory(spec, tmp_path)


@pytest.mark.parametrize(
    ("near", "message"),
    [
        ({"values": []}, "camera.near.values: must be a list of at least 1, is []"),
        ({"values": ["a"]}, "camera.near.values.0: must be a number such as 0.5 or 1.0e-4, is 'a'"),
        ({"says": 3}, "camera.near.says: must be a text, is 3"),
        ({"colour": "red"}, "camera.near.colour: unknown key; known are change, values, says"),
    ],
)
def test_a_wrong_manifest(tmp_path, near, message):
    content = yaml.safe_load(MANIFEST.read_text())
    content["camera"]["near"] |= near
    (tmp_path / "suites.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(UserError) as raised:
        load_suites(str(tmp_path / "suites.yaml"))
    assert str(raised.value) == f"{tmp_path / 'suites.yaml'}: {message}"


@pytest.fixture(scope="module")
def spec():
    return dataclasses.replace(spec_of(), test=4, num_points=600, experiment="moving_lights", resolution=32)


@pytest.fixture(scope="module")
def perturber(spec):
    render = SampleRenderer(spec, 0)
    return ViewPerturber(render, render.points(), seed=0)


def centre_pixel(perturber, camera):
    """Distance along the axis and cosine to the surface of what is in the image's middle."""
    size = dataclasses.replace(camera, matrix=np.array([[1e3, 0, 0.5], [0, 1e3, 0.5], [0, 0, 1.0]]), width=1, height=1)
    buffers = perturber.render.renderer.gbuffer(size)
    cosine = abs(buffers["normal"][:, 0, 0] @ camera.rotation[:, 2])
    return float(buffers["depth"][0, 0, 0]), float(cosine)


@pytest.mark.parametrize("metres", [1.0, 0.25, 0.05])
def test_near(perturber, metres):
    depth, _ = centre_pixel(perturber, perturber.place(1, "near", metres))
    assert depth == pytest.approx(metres, rel=0.03)


@pytest.mark.parametrize("degrees", [30, 6])
def test_grazing(perturber, degrees):
    before = perturber.place(1)
    camera = perturber.place(1, "grazing", degrees)
    depth, cosine = centre_pixel(perturber, camera)
    assert not np.array_equal(camera.world_to_view, before.world_to_view)
    assert depth == pytest.approx(0.75, rel=0.03)
    assert np.degrees(np.arcsin(cosine)) == pytest.approx(degrees, abs=1)


def test_lenses(perturber):
    base = perturber.place(0)
    wide = perturber.place(0, "field_of_view", 120)
    assert wide.fov == pytest.approx(120, abs=1e-3) and np.array_equal(wide.world_to_view, base.world_to_view)
    more = perturber.place(0, "resolution", 1.5)
    assert (more.width, more.height) == (48, 48) and more.fov == pytest.approx(base.fov, abs=1e-3)
    flat = perturber.place(0, "aspect", 4)
    assert (flat.width, flat.height) == (64, 16) and flat.fov == pytest.approx(base.fov, abs=1e-3)
    # Square pixels, and the axis through the middle.
    assert flat.matrix[0, 0] == flat.matrix[1, 1] and np.allclose(flat.matrix[:2, 2], [32, 8])


def test_corner(perturber):
    low, high = perturber.render.description.room
    position = perturber.place(0, "corner", 0.5).position
    assert np.allclose(np.minimum(position - low, high - position)[[0, 2]], 0.5, atol=1e-5)


def test_turned_from_light(perturber):
    camera = perturber.place(0, "turned_from_light", 140)
    to_light = perturber.render.description.light.centre + perturber.scene.state.translation[-1] - camera.position
    level = [camera.rotation[[0, 2], 2], to_light[[0, 2]]]
    cosine = level[0] @ level[1] / np.prod([np.linalg.norm(v) for v in level])
    assert np.degrees(np.arccos(cosine)) == pytest.approx(140, abs=0.1)


def test_states_beyond_training(perturber):
    movables, up = perturber.scene.movables, 1
    perturber.place(2, "light_lowered", 0.7)
    assert perturber.scene.state.translation[-1, up] == pytest.approx(movables[-1].box[0, up] - 0.7)
    perturber.place(2, "object_outside", 0.5)
    outside = [
        max((t - m.box[1]).max(), (m.box[0] - t).max())
        for m, t, p in zip(movables, perturber.scene.state.translation, perturber.scene.state.present, strict=True)
        if p
    ]
    assert max(outside) == pytest.approx(0.5, abs=1e-5) and sorted(outside)[-2] <= 1e-5
    perturber.place(2, "objects_removed", 1.0)
    assert perturber.scene.state.present.tolist() == [False] * (len(movables) - 1) + [True]
    perturber.place(2, "objects_crowded", 0.95)
    assert perturber.scene.state.present.all()
    perturber.place(2)  # nothing of it stays
    expected = perturber.render.spec.state("test", 0, 2, ())
    assert perturber.scene.state.key == expected.key


def test_lights_of_the_same_power(perturber):
    """Photons carry it: as much of a light of any size, 4 times as much of one 4 times as bright, red of a red one."""

    def power(change=None, value=1.0):
        perturber.place(3, change, value)
        photons = perturber.render.renderer.photons(2000, 1)
        side = np.ptp(photons["photon_origin"], 0)[[0, 2]].max()
        lit = perturber.lit_points()["emission"]
        return photons["photon_flux"].sum(0), side, lit[lit.any(1)].mean(0), perturber.lit_points()["position"]

    flux, side, emission, _ = power()
    small, small_side, small_emission, points = power("light_size", 0.5)
    np.testing.assert_allclose(small, flux, rtol=0.02)
    assert small_side == pytest.approx(side / 2, rel=0.02)
    np.testing.assert_allclose(small_emission, 4 * emission, rtol=1e-5)
    lit = perturber.points["object"] == len(perturber.scene.movables) - 1
    assert np.ptp(points[lit], 0)[0] == pytest.approx(np.ptp(perturber.points["position"][lit], 0)[0] / 2, rel=1e-4)
    bright, _, bright_emission, _ = power("light_power", 4)
    np.testing.assert_allclose(bright, 4 * flux, rtol=0.02)
    np.testing.assert_allclose(bright_emission, 4 * emission, rtol=1e-5)
    red, *_ = power("light_colour", 1.0)
    np.testing.assert_allclose(red / flux, [2.4, 0.4, 0.2], rtol=0.03)
    again, *_ = power()
    np.testing.assert_allclose(again, flux, rtol=0.02)


@pytest.mark.parametrize("change", sorted(MESHES))
def test_points_of_changed_scenes(spec, perturber, change):
    """They lie on the changed meshes, row by row those of training where nothing changed, with what is known there."""
    scene = ChangedScene(perturber.render.description, spec.experiment, change, 0.5, perturber.points, seed=0)
    points = scene.moved_points()
    other = {name for name in points if not np.array_equal(points[name], perturber.points[name])}
    assert other and points.keys() == perturber.points.keys()
    assert all(points[name].shape == perturber.points[name].shape for name in points)
    assert all(points[name].dtype == perturber.points[name].dtype for name in points)
    same = (points["position"] == perturber.points["position"]).all(1)
    assert same.any()
    if change in ("mesh_replaced", "mesh_thinner", "second_light"):
        assert not same.all()
    for k, name in enumerate(scene._names):
        mine = points["position"][(points["shape"] == k) & ~same]
        if len(mine):
            mesh = trimesh.Trimesh(scene.shapes[name].vertices, scene.shapes[name].faces, process=False)
            _, distance, _ = trimesh.proximity.closest_point_naive(mesh, mine[:4])
            assert distance.max() < 1e-4
    if change == "second_light":
        assert len(scene.mi_scene.emitters()) == 2
        lit = points["emission"].any(1)
        assert np.ptp(points["position"][lit & (points["object"] == -1)], 0)[1] < 1e-5


# --- what is computed from the clean views ---


def test_frames_of_the_world():
    """Pixels of points stay as they are under a rigid motion, and are mirrored by the mirrored camera."""
    double = lambda batch: {k: v.double() if v.is_floating_point() else v for k, v in batch.items()}
    batch = double(synthetic_batch(size=13))
    up, middle = np.array([0.0, 1, 0]), np.array([1.0, 2, 3])
    pixels = lambda b: visible_pixels(b["point_position"], b["point_visible"], **{name: b[name] for name in PROJECTION})
    expected = pixels(batch)
    for change, value in ((INPUTS["shifted"], 3.0), (INPUTS["turned"], 70.0)):
        moved = change(batch, value, up, middle)
        assert not torch.allclose(moved["point_position"], batch["point_position"])
        assert torch.equal(pixels(moved), expected)
    half = INPUTS["turned"](batch, 180.0, up, middle)["point_position"]
    about = torch.tensor([2.0, 0, 6]).double() + batch["point_position"] * torch.tensor([-1, 1, -1])
    torch.testing.assert_close(half, about)
    single = batch | {"camera_matrix": batch["camera_matrix"].float()}
    flipped = pixels(double(INPUTS["mirrored"](single, 1, up, middle)))
    row, column = expected // 13, expected % 13
    assert torch.equal(flipped, torch.where(expected < 169, row * 13 + 12 - column, expected))


def test_budgets():
    batch = synthetic_batch()
    batch |= {f"input_{n}": torch.full_like(batch["noisy_input"], n) for n in (1, 2, 3)}
    quarter = batch["point_visible"] & (torch.arange(POINTS) < POINTS // 4)
    assert torch.equal(INPUTS["points"](batch, 0.25)["point_visible"], quarter)
    fewer = INPUTS["photons"](batch, 0.5)
    assert fewer["photon_hit"].shape[1] == PHOTONS // 2
    chosen = [any(torch.equal(hit, other) for other in batch["photon_hit"][0]) for hit in fewer["photon_hit"][0]]
    assert all(chosen)
    torch.testing.assert_close(fewer["photon_flux"].sum(1), batch["photon_flux"].sum(1), rtol=0.2, atol=0)
    assert INPUTS["photons"](batch, 0)["photon_flux"].shape[1] == 0
    mixed = INPUTS["spp"](batch, 2.5)["noisy_input"]
    assert set(mixed.unique().tolist()) == {2.0, 3.0} and mixed.mean().item() == pytest.approx(2.5, abs=0.15)
    assert (INPUTS["spp"](batch, 1)["noisy_input"] == 1).all()


@pytest.mark.parametrize(
    ("growth", "point"),
    [([1, 1.5, 2.5, 9, 9, 9], 1.5), ([1, 3], 0.5), ([1, 1.9, 1.2, 0.5], np.inf), ([1, 1, 2, 1], 2), ([], np.inf)],
)
def test_breaking_point(growth, point):
    assert breaking_point(np.array(growth)) == pytest.approx(point)


# --- what rows say ---


def test_interval_of_a_breaking_point(tmp_path):
    """Of two views, each alone is drawn twice in a quarter of the draws, so their breaking points are the ends."""
    growth = {"cnn": [(1, 3, 3, 3, 3, 3), (1, 1, 1, 1, 3, 3)], "nlt": [(1, 3, 3, 3, 3, 3), (1, 1, 1, 1, 1, 1)]}
    rows = [
        {"method": method, "suite": suite, "ladder": ladder, "severity": severity, "scene": 0, "view": view,
         "error": own[severity], "nonfinite": 0}
        for method, views in growth.items()
        for view, own in enumerate(views)
        for suite, ladder, severity in [("clean", "views", 0), *(("light", "brighter", k) for k in range(1, 6))]
    ]  # fmt: skip
    stressed = Stressed(tmp_path, {"manifest": yaml.safe_load(MANIFEST.read_text())}, rows, [])
    for method, views in growth.items():
        alone = [breaking_point(np.array(own)) for own in views]
        assert stressed.intervals["light", "brighter"][method] == (min(alone), max(alone))
    assert stressed.break_cell(("light", "brighter"), "nlt") == "1.0 [0.5, > 5]"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Made-up stress rows and results of a comparison are drawn; one pixel of the CNN is not finite."""
    directory = tmp_path_factory.mktemp("made")
    names = ("cnn", "nlt", "denoising_1_4")
    numbers = papers_numbers("table2")
    results = make_results(directory, {name: numbers[name] for name in names}, "table2", images=True)
    growing = {"cnn": (0.1, 1.0), "nlt": (0.2, 0.05), "denoising_1_4": (0.3, 0.0)}  # clean, and by severity
    rows = []
    for name, (clean, slope) in growing.items():
        places = [("clean", "views", 0), *(("light", "brighter", k) for k in range(1, 6))]
        places += [("budget", "points", k) for k in range(1, 6) if name == "nlt"]
        for suite, ladder, severity in places:
            grown = slope * severity if suite == "light" else (0, 1, 2, 3, 5, 4)[severity]  # worst before the highest
            errors = clean * (1 + grown) * np.array([0.5, 1.5])
            rows += [
                {"method": name, "suite": suite, "ladder": ladder, "severity": severity, "scene": 0, "view": view,
                 "error": error, "nonfinite": int((name, severity, view) == ("cnn", 5, 1))}
                for view, error in enumerate(errors)
            ]  # fmt: skip
    write_rows(directory / "stress" / "stress.csv", rows)
    record = {"command": "nlt stress", "commit": "c" * 40, "views": 2, "scenes": ["room"], "left_out": ["a thing"]}
    write_manifest(directory / "stress", record | {"manifest": yaml.safe_load(MANIFEST.read_text())})
    write_page(results, [], sections=[stress_section(directory)])
    return directory


def test_breaking_points_and_ranks(made):
    rows = {(row["method"], row["ladder"]): row for row in read_rows(made / "stress" / "breaking.csv")}
    assert rows["cnn", "brighter"]["breaks_at"] == pytest.approx(1)
    assert rows["nlt", "brighter"]["breaks_at"] == np.inf and rows["nlt", "points"]["breaks_at"] == pytest.approx(1)
    assert [rows["cnn", "brighter"][f"growth_{k}"] for k in range(6)] == pytest.approx([1, 2, 3, 4, 5, 6])
    ranks = {name: [rows[name, "brighter"][f"rank_{k}"] for k in (0, 5)] for name in ("cnn", "nlt", "denoising_1_4")}
    assert ranks == {"cnn": [1, 3], "nlt": [2, 1], "denoising_1_4": [3, 2]}


def test_sentences(made):
    """Where a method breaks, by how much, and what is better there: also one that the change does not reach."""
    text = (made / "stress" / "stress.md").read_text()
    cnn, nlt = label("cnn"), label("nlt")
    for sentence in (
        f"**{cnn}** has a clean error of 0.1. It breaks with brighter light at severity 1.0 (6 times the clean error "
        f"at severity 5; there {nlt} has 0.25 against its 0.6). **1 pixels are not finite.**",
        f"6 times the clean error at severity 4; there {cnn} has 0.1 against its 1.2). It withstands: brighter light.",
        "Left out: a thing.",
    ):
        assert sentence in text


def test_against_open_image_denoise(made, tmp_path):
    """The largest ratio of errors on a ladder, and how many severities are above 1.1."""
    rows = read_rows(made / "stress" / "stress.csv")
    like = [row for row in rows if (row["method"], row["suite"]) in (("cnn", "clean"), ("cnn", "light"))]
    rows += [row | {"method": "oidn_1", "error": 0.3} for row in like]
    write_rows(tmp_path / "stress" / "stress.csv", rows)
    shutil.copy(made / "stress" / "manifest.json", tmp_path / "stress")
    stress_section(tmp_path)
    text = (tmp_path / "stress" / "stress.md").read_text()
    table = text[text.index("## Against Open Image Denoise") : text.index("## Ranks")]
    order = [cell.strip() for cell in table.splitlines()[4].split("|")[2:-1]]
    assert sorted(order) == sorted(map(label, ("cnn", "nlt", "denoising_1_4")))
    # Errors are 0.1 (1 + severity), 0.2 (1 + severity / 20) and 0.3, against 0.3.
    expected = {
        "cnn": ("2.00", "1.33", "3 of 5"),
        "nlt": ("0.83", "0.77", "0 of 5"),
        "denoising_1_4": ("1.00", "1.00", "0 of 5"),
    }
    for number, line in zip(range(3), table.splitlines()[6:], strict=False):
        assert [cell.strip() for cell in line.split("|")[2:-1]] == [
            expected[name][number] for name in sorted(expected, key=lambda name: order.index(label(name)))
        ]
    assert "points" not in table  # Open Image Denoise has no points


def test_report(made):
    """Sentences, tables and pictures are a section of report.html."""
    page = (made / "report.html").read_text()
    section = page[page.index('<section id="stress"') :].partition("</section>")[0]
    assert f"<strong>{label('cnn')}</strong> has a clean error of 0.1." in section
    assert section.count("<figure>") == 2 and section.count("<table") == 2 and 'download="stress.csv"' in section
    assert ">1.0 [1.0, 1.0]<" in section and ">&gt; 5<" in section


# --- the command ---


@pytest.fixture(scope="module")
def stressed(tiny, tmp_path_factory):
    """`nlt stress` of three methods at a tiny scale, a ladder or none of a suite: its arguments and its directory."""
    folder = tmp_path_factory.mktemp("stress")
    content = yaml.safe_load(MANIFEST.read_text()) | {"views": 2, "traced": [1]}
    content["materials"] = {}
    for suite, name in {"light": "brighter", "geometry": "thinner", "camera": "aspect"}.items():
        content[suite] = {name: content[suite][name] | {"values": content[suite][name]["values"][-1:]}}
    content["flicker"] |= {"draws": 2, "frames": 3}
    content["training"] |= {"share": 1.0, "seeds": 2, "learning_rate": [10]}
    manifest = folder / "manifest.yaml"
    manifest.write_text(yaml.safe_dump(content))
    scale = folder / "scale.yaml"
    scale.write_text(yaml.safe_dump(merge(yaml.safe_load(tiny.scale.read_text()), {"trainer": {"max_steps": 4}})))
    config = folder / "compare.yaml"
    methods = ["denoising_1_4", "nlt_photons", "path_tracing_1"]
    config.write_text(yaml.safe_dump({"data": str(tiny.data), "scale": str(scale), "methods": methods}))
    out = folder / "results"
    command = ["stress", "--config", str(config), "--out", str(out), "--manifest", str(manifest)]
    here = os.getcwd()
    os.chdir(folder)
    try:
        assert main(command) == 0
        yield SimpleNamespace(command=command, directory=out / "stress", folder=folder, methods=methods)
    finally:
        os.chdir(here)


def test_blended_frames_of_a_path(stressed):
    """Blending takes noise away: path traced frames change less, and err less under a camera that stands still."""
    rows = read_rows(stressed.directory / ROWS)
    of = lambda ladder: [
        r for r in rows if (r["method"], r["suite"], r["ladder"]) == ("path_tracing_1", FLICKER, ladder)
    ]
    for path in PATHS:
        (alone,), (steady,) = of(path), of(path + STEADY)
        assert 0 < steady["value"] < alone["value"], path
        assert path == "camera" or 0 < steady["error"] < alone["error"], path
    assert "Steady frames" in (stressed.directory / "stress.md").read_text()


@pytest.mark.parametrize("scene", [0, 1])
def test_new_points_take_the_nearest_embedding(scene):
    """Of the same object, by brute force in float64; points of a new object, and the other scene, keep theirs."""

    class Uncopyable(nn.Module):  # as 8-bit weights are
        def __deepcopy__(self, memo: object) -> None:
            raise NotImplementedError

    count = 40
    rng = np.random.default_rng(0)
    before, after = ({"position": rng.normal(size=(count, 3)), "object": rng.integers(0, 3, count)} for _ in range(2))
    after["object"][5:9] = 7
    method = nn.Sequential(PointEmbedding(2, count, 4), Uncopyable())
    own = method[0].table.weight.detach().clone()
    expected = own.clone()
    for k in range(count):
        same = np.flatnonzero(before["object"] == after["object"][k])
        if len(same):
            distance = np.linalg.norm(before["position"][same] - after["position"][k], axis=1)
            expected[scene * count + k] = own[scene * count + same[distance.argmin()]]
    assert not torch.equal(expected, own) and torch.equal(expected[scene * count + 5], own[scene * count + 5])
    with torch.inference_mode(), nearest_embeddings(method, scene, before, after):
        assert torch.equal(method[0].table.weight, expected)
    assert torch.equal(method[0].table.weight, own)


def test_an_unknown_change(stressed, tmp_path, capsys):
    content = yaml.safe_load(MANIFEST.read_text())
    content["light"] = {"odd": {"change": "points", "values": [1], "says": "of another kind"}}
    file = tmp_path / "odd.yaml"
    file.write_text(yaml.safe_dump(content))
    assert main([*stressed.command[:-1], str(file)]) == 2
    assert "light.odd.change: must be one of roughness, " in capsys.readouterr().err


def test_rows(stressed):
    rows = read_rows(stressed.directory / "stress.csv")
    ladders = {method: {row["ladder"] for row in rows if row["method"] == method} for method in stressed.methods}
    shared = {"views", "brighter", "thinner", "aspect", "shifted", "turned", "mirrored"}
    shared |= {path + ending for path in PATHS for ending in ("", STEADY)}
    assert ladders["path_tracing_1"] == shared
    assert ladders["denoising_1_4"] == shared | {"pixels", "spp", "noise"}
    assert ladders["nlt_photons"] == shared | {"points", "photons"}
    assert all(row["nonfinite"] == 0 for row in rows)
    # A shift of the world only reaches those that are fed with positions.
    for method in stressed.methods:
        at: dict[str, list[float]] = {"views": [], "shifted": []}
        for row in rows:
            if row["method"] == method and (row["ladder"], row["severity"]) in (("views", 0), ("shifted", 5)):
                at[row["ladder"]].append(row["unbiased_mse"])
        if method == "nlt_photons":
            assert at["shifted"] != pytest.approx(at["views"], rel=1e-6)
        else:
            assert at["shifted"] == pytest.approx(at["views"], rel=1e-3)
    assert {path.name for path in stressed.directory.glob("*.*")} >= {
        "stress.csv", "training.csv", "breaking.csv", "stress.md", "manifest.json", "stress_curves.png",
        "stress_map.png", "stress_worst.webp",
    }  # fmt: skip
    text = (stressed.directory / "stress.md").read_text()
    assert "Every output is finite." in text and all(label(method) in text for method in stressed.methods)


def test_a_row_is_its_image(stressed, tiny):
    """The radiance of path tracing needs no method: its error, computed here from the stored views alone."""
    rows = read_rows(stressed.directory / "stress.csv")
    (folder,) = tiny.dataset.parent.glob("*-stress-*")
    with safe_open(folder / "000" / "light-brighter-1.safetensors", "numpy") as file:
        f, a, b = (file.get_tensor(name).astype(float) for name in ("traced_1", "reference_a", "reference_b"))
    found = [r for r in rows if (r["method"], r["ladder"]) == ("path_tracing_1", "brighter")]
    product = (f - a) * (f - b)  # the room's exposure is 1
    np.testing.assert_allclose([r["unbiased_mse"] for r in found], product.mean((1, 2, 3)), rtol=1e-5)
    relative = product / (((a + b) / 2) ** 2 + 0.01)
    np.testing.assert_allclose([r["error"] for r in found], relative.mean((1, 2, 3)), rtol=1e-5)


def test_trainings(stressed):
    rows = read_rows(stressed.directory / "training.csv")
    methods = {"denoising_1_4", "nlt_photons"}
    assert {row["method"] for row in rows} == methods
    variations = [(row["variation"], row["value"]) for row in rows if row["method"] == "nlt_photons"]
    seeds, others = [("seed", 0), ("seed", 1)], [("precision", "bf16-mixed"), ("corrupted samples", "2%")]
    assert variations == [*seeds, ("learning rate", "x10"), *others]
    assert all(row["status"] == "ok" and np.isfinite(row["error"]) for row in rows)


def test_again_changes_nothing(stressed, monkeypatch):
    """The second time nothing is rendered, trained or judged, and no byte of what is drawn changes."""
    names = ("stress.csv", "training.csv", "breaking.csv", "stress.md", "stress_curves.svg", "stress_worst.webp")
    before = {name: (stressed.directory / name).read_bytes() for name in names}
    monkeypatch.setattr("nlt.stress.rendering.Local", None)
    monkeypatch.setattr("nlt.stress.views.SuiteViews.judge", None)
    (stressed.folder / "results" / "runs.csv").touch()  # as in a clone, whose views.csv git does not keep
    assert main(stressed.command) == 0
    assert not (stressed.folder / "results" / "report.html").exists()
    assert {name: (stressed.directory / name).read_bytes() for name in names} == before
