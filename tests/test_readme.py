"""Every command of the README and of CONTRIBUTING works, and so do the recipes: run here, small, or elsewhere."""

import argparse
import json
import re
import shlex
import shutil
import subprocess
import tomllib
import types
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from bench import parser as benchmark_parser
from conftest import write_room
from tiny import TRAINER, write

import nlt.baselines
from nlt import paths
from nlt.arguments import LIGHTNING, command_parser
from nlt.cli import main
from nlt.data import generate as generation
from nlt.data.spec import load_spec
from nlt.evaluation.comparison import Comparison
from nlt.metrics import quantities
from nlt.paths import PROJECT, find_config
from nlt.rendering.renderer import Renderer
from nlt.scenes import builtin
from nlt.scenes.assembly import Scene
from nlt.scenes.builtin import rooms
from nlt.scenes.description import load_description
from nlt.scenes.state import sample_view
from nlt.select.space import SearchSpace
from nlt.stress.suites import load_suites
from nlt.training import check_configs

pytest_plugins = ["training_fixtures"]
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("one_thread")]

README, CONTRIBUTING = PROJECT / "README.md", PROJECT / "CONTRIBUTING.md"
PAGES = [README, CONTRIBUTING, *sorted((PROJECT / "docs").glob("*.md"))]

# Run here, in this order, with these arguments behind them that make them small; their files are made by `sandbox`.
RUN = {
    "nlt scenes check room/scene.xml": "",
    "nlt scenes add room/scene.xml --name room": "",
    "nlt scenes preview room -o room.png": "--views 1 --resolution 16 --spp 1",
    "nlt generate --config data/room --config scale/demo": "--config small.yaml --workers 1",
    "nlt generate --config data/demo --config scale/demo": "--config data/room --config small.yaml --workers 1",
    "nlt fit --config data/demo --config model/normals_only "
    "--config scale/demo": "--config data/room --config small.yaml --config small_fit.yaml",
}
# Too long: parsed here to the end, and run for real, small, by these tests.
ELSEWHERE = {
    "make demo": "test_compare.py::test_table",
    "make test": "test_readme.py::test_make",
    "make lint": "test_readme.py::test_make",
    "nlt compare --config demo --methods cnn nlt normals_only": "test_compare.py::test_table",
    "nlt compare --config demo --methods cnn normals_only": "test_compare.py::test_table",
    "nlt compare --config demo --data room": "test_compare.py::test_table",
    "nlt select --config demo --minutes 6": "test_select.py::test_end_to_end",
    "nlt render --demo": "test_render.py::test_demo",
    "nlt view room": "test_view.py::test_without_training",
    "nlt view --demo": "test_view.py::test_light_method_and_second_client",
}


def blocks(page, language):
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)


def commands(page):
    """Return the lines of the shell blocks without comments; for the README also commands within a line."""
    lines = "".join(blocks(page, "sh")).replace("\\\n", " ").splitlines()
    inline = re.findall(r"`(nlt \w+ [^`]+)`", page.read_text()) if page == README else []
    return list(
        dict.fromkeys(shlex.join(words) for line in lines + inline if (words := shlex.split(line, comments=True)))
    )


@pytest.fixture(scope="module")
def sandbox(tmp_path_factory):
    """A directory like the project's, after its recipes: own configs, the recipes' files, a room to add."""
    folder = tmp_path_factory.mktemp("sandbox")
    shutil.copytree(PROJECT / "configs", folder / "configs")
    write_room(folder / "room")
    for language in ("python", "yaml"):
        for text in blocks(CONTRIBUTING, language):
            if path := re.match(r"# (\S+/\S+)\n", text):
                (folder / path[1]).parent.mkdir(parents=True, exist_ok=True)
                write(folder / path[1], text)
    counts = {"num_points": 64, "num_photons": 64}
    dataset = {"resolution": 16, "train": 2, "val": 1, "test": 1, "reference_spp": 1, **counts}
    write(folder / "small.yaml", {"data": {"dataset": dataset}})
    trainer = {**TRAINER, "max_epochs": 2, "default_root_dir": "fitted"}
    write(
        folder / "small_fit.yaml", {"data": {"batch_size": 1}, "model": {"init_args": {"width": 2}}, "trainer": trainer}
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(paths, "CONFIGS", folder / "configs")
        patch.setattr(nlt.baselines, "__path__", [*nlt.baselines.__path__, str(folder / "nlt/baselines")])
        yield folder


def test_every_command_is_covered():
    covered = [*RUN, *ELSEWHERE]
    found = commands(README) + commands(CONTRIBUTING)
    assert set(found) == set(covered), "add the command to RUN, or to ELSEWHERE with the test that runs it"
    for command, test in ELSEWHERE.items():
        file, name = test.split("::")
        assert f"def {name}(" in next((PROJECT / "tests").rglob(file)).read_text(), command


@cache
def _taken(configs):
    check_configs(list(configs))


def parse(command):
    """To the end: by the command's own parser, with every config, scene and file that it names."""
    name, *arguments = shlex.split(command)[1:]
    if name in LIGHTNING:
        parser = argparse.ArgumentParser()
        parser.add_argument("--config", action="append")
        parser.add_argument("--ckpt_path")
        return _taken(tuple(parser.parse_args(arguments).config))
    options = command_parser().parse_args([name, *arguments])
    scenes = getattr(options, "names", [])
    if name == "generate":
        scenes = load_spec(options.config)[0].scenes
    elif name in ("compare", "stress"):
        comparison = Comparison.load(options.config, options.scale, options.data, options.methods)
        assert comparison.configs
        assert name == "compare" or load_suites(options.manifest)
    elif name == "select":
        assert SearchSpace.load(options.config, options.minutes).methods
    elif name == "report":
        assert (PROJECT / options.directory / "manifest.json").exists()
    for scene in set(scenes) - {"room"}:
        load_description(scene, need_source=False)
    return None


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_parse(page, sandbox):
    extras = tomllib.loads((PROJECT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for command in commands(page):
        program, *rest = shlex.split(command)
        if program == "nlt":
            parse(command)
        elif program == "python":
            assert (PROJECT / rest[0]).is_file(), command
            if rest[0] == "benchmarks/bench.py":
                options = benchmark_parser().parse_args(rest[1:])
                assert load_spec([str(find_config("data", options.data)), str(find_config("scale", options.scale))])
        elif program == "pip":
            assert rest[0] == "install" and re.fullmatch(r"nlt\[(\w+)\]", rest[1])[1] in extras, command
        else:
            assert program == "make", command  # test_make


def test_make():
    """What `make` would run: the comparison of the first, these tests, the linters."""
    for target, last in (("demo", "nlt compare --config demo"), ("test", "-m pytest -n auto"), ("lint", "mypy")):
        # `make test` runs this, and make within make says where it enters and leaves.
        command = ["make", "-n", "--no-print-directory", target]
        done = subprocess.run(command, cwd=PROJECT, capture_output=True, text=True, check=True)
        assert last in done.stdout.splitlines()[-1]
    parse("nlt compare --config demo")


def test_recipes(sandbox, monkeypatch, capsys):
    """Commands and files of CONTRIBUTING: a scene of one's own is checked, described, shown and rendered; a method of
    one's own is trained."""
    monkeypatch.setattr(generation, "_announce", lambda *_: 1)  # what it will take, which it tries out
    for command, smaller in RUN.items():
        assert main(shlex.split(f"{command} {smaller}")[1:]) == 0, command
    assert load_description("room").file == Path("scenes/room.yaml")
    assert (sandbox / "room.png").stat().st_size > 0
    (dataset,) = (sandbox / "datasets").glob("fixed_lights-room-16-*")
    assert len(list(dataset.rglob("*.safetensors"))) == 4
    (checkpoint,) = (sandbox / "fitted").rglob("*.ckpt")
    assert "normals_only.NormalsOnly" in str(torch.load(checkpoint, weights_only=True)["hyper_parameters"])


def test_recipe_of_a_builtin_scene(tmp_path, monkeypatch):
    (code,) = (text for text in blocks(CONTRIBUTING, "python") if "rooms.py" in text.splitlines()[0])
    exec(code, made := dict(vars(rooms)))
    monkeypatch.setitem(builtin.BUILTINS, "cell", made["cell"])
    camera = {"min": [-1, 1, -1], "max": [1, 1.5, 1]}
    description = load_description(str(write(tmp_path / "cell.yaml", {"source": "builtin:cell", "camera": camera})))
    view = sample_view(description, 8, np.random.default_rng(0))
    radiance = Renderer(Scene(description, "static")).radiance(view, 4, 0)
    assert np.isfinite(radiance).all() and radiance.mean() > 0.1


def test_recipe_of_a_metric(monkeypatch):
    """Its two entries, in the two files: the mean that it says, of values in sRGB by numpy."""
    entry, value = (text.partition("\n")[2] for text in blocks(CONTRIBUTING, "python") if '"mae"' in text)
    monkeypatch.setitem(quantities.METRICS, "mae", eval(f"{{{entry}}}", vars(quantities))["mae"])
    source = (PROJECT / "nlt/metrics/image_metrics.py").read_text()
    there = '            "mse": mse,\n'
    assert source.count(there) == 1
    module = types.ModuleType("with_mae")
    exec(source.replace(there, there + value), vars(module))
    metrics = module.ImageMetrics(perceptual=False)
    f, reference = 1.5 * torch.rand(2, 4, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    each = metrics.update(f, reference, reference, torch.ones(4))
    linear = np.clip(np.stack([f, reference]).astype(float), 0, 1)
    shown, target = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    expected = np.abs(shown - target).mean((1, 2, 3))
    np.testing.assert_allclose(each["mae"], expected, rtol=1e-5)
    assert float(metrics.compute()["mae"]) == pytest.approx(expected.mean(), rel=1e-5)


def test_provenance():
    """The manifests of Table 2, in the README and at 64x64, say where it comes from."""
    for name, views in (("real_living_room_256", 32), ("real_living_room", 64)):
        record = json.loads((PROJECT / f"results/{name}/manifest.json").read_text())
        assert record["command"].startswith("nlt compare") and len(record["commit"]) == 40
        assert record["n_test"] >= views and record["seeds"][0] == 0
        assert record["device"] and record["versions"]["torch"]
