"""The command line: light to start, and every mistake is one line that names file, field and remedy."""

import inspect
import os
import subprocess
import sys
from collections import namedtuple

import pytest
import yaml
from conftest import write_room, write_yaml
from tiny import DATASET, SCALE, copy_dataset, write

from nlt import waiting
from nlt.arguments import LIGHTNING, command_parser
from nlt.cli import _COMMANDS, main
from nlt.config import merge
from nlt.data import generate as generation
from nlt.data.datamodule import LightTransportDataModule
from nlt.data.spec import DataSection

pytest_plugins = ["training_fixtures"]
pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    """In an empty directory, as if the shell had been given arguments."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["nlt", "fit", "--config=x.yaml"])


@pytest.mark.parametrize(("given", "inherited"), [(None, None), ("active", "active"), ("passive", "passive")])
def test_threads_wait_passively_where_the_user_says_nothing(monkeypatch, given, inherited):
    """A frame's process; the trainings that it starts wait as they would without it."""
    monkeypatch.setattr(waiting, "_ours", False)
    monkeypatch.setenv(waiting.WAIT_POLICY, given or "")
    if given is None:
        monkeypatch.delenv(waiting.WAIT_POLICY)
    for _ in range(2):
        waiting.wait_passively()
        assert os.environ[waiting.WAIT_POLICY] == (given or "passive")
        with waiting.as_the_user_said():
            assert os.environ.get(waiting.WAIT_POLICY) == inherited
        assert os.environ[waiting.WAIT_POLICY] == (given or "passive")


def test_help_imports_nothing_heavy():
    code = """if True:
        import sys
        from nlt.cli import main
        try:
            main(["--help"])
        except SystemExit as done:
            assert done.code == 0
        print(*sorted(sys.modules), sep="\\n", file=sys.stderr)
    """
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert {"generate", "fit", "validate", "test", "predict", "compare"} <= set(done.stdout.split())
    modules = set(done.stderr.split())
    assert "nlt.cli" in modules
    assert not modules & {"torch", "mitsuba", "drjit", "lightning", "numpy", "jsonargparse", "matplotlib", "yaml"}


def test_every_word_of_help():
    """Every command says what it does, as the list of commands does; every argument what it is."""

    def look(parser, path):
        for action in parser._actions:
            assert action.help or hasattr(action, "_choices_actions"), (path, action.dest)
            for choice in getattr(action, "_choices_actions", ()):
                command = action.choices[choice.dest]
                assert command.description.lower() == f"{choice.help.lower()}." and choice.help[0].islower()
                look(command, f"{path} {choice.dest}")

    look(command_parser(), "nlt")


def test_every_command_does_something():
    commands = next(action for action in command_parser()._actions if action.dest == "command")
    assert commands.choices.keys() == _COMMANDS.keys() | LIGHTNING.keys()


def test_help_of_fit(capfd):
    with pytest.raises(SystemExit) as done:
        main(["fit", "--help"])
    out, error = capfd.readouterr()
    assert done.value.code == 0 and error == ""
    assert "--data.dataset.resolution" in out and "--ckpt_path" in out and "--trainer.max_steps" in out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], ["command", "nlt --help"]),
        (["nope"], ["nope", "generate", "compare"]),
        (["generate"], ["--config", "nlt generate --help"]),
        (["generate", "--config=x.yaml", "--workers=0"], ["--workers", "at least 1"]),
        (["generate", "--config=x.yaml", "--workers=two"], ["--workers", "whole number", "two"]),
        (["scenes", "preview", "egg", "--seed=-1"], ["--seed", "at least 0"]),
        (["scenes", "preview", "egg", "-o", "egg.xyz"], ["--output", "egg.xyz", ".png"]),
        (["generate", "--config=x.yaml", "--nope"], ["--nope", "nlt generate --help"]),
        (["generate", "--config=x.yaml", "nope"], ["KEY=VALUE", "nope", "nlt generate --help"]),
        (["compare", "--config=demo", "--methods", "nope"], ["--methods: no model 'nope'", "cnn"]),
        (["generate", "--config=x.yaml", "--slurm=time"], ["--slurm", "KEY=VALUE", "time"]),
        (["compare", "--config"], ["--config", "nlt compare --help"]),
        (["fit"], ["data.dataset.scenes", "model", "nlt fit --help"]),
        (["fit", "--nope=1"], ["--nope=1", "nlt fit --help"]),
        (["fit", "--config"], ["--config", "nlt fit --help"]),
    ],
)
def test_arguments(refused, arguments, words):
    refused(arguments, *words)


# ---- configs: in generate, fit and compare alike --------------------------------------------------------


@pytest.fixture
def with_config(tiny, tmp_path):
    """The arguments of a command whose last config is `bad.yaml`, holding this besides what it needs."""

    def command(name, content):
        bad = tmp_path / "bad.yaml"
        if content is not None:
            write(bad, content if isinstance(content, str) else merge(SCALE, content))
        if name == "generate":
            return ["generate", f"--config={tiny.data}", f"--config={bad}"]
        if name == "fit":
            return tiny.command("fit", "cnn", f"--config={bad}")
        content = {"data": str(tiny.data), "scale": str(bad), "methods": ["cnn"]}
        return ["compare", f"--config={write(tmp_path / 'comparison.yaml', content)}", "--out=out"]

    return command


@pytest.mark.parametrize("command", ["generate", "fit", "compare"])
@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"data": {"dataset": {"resolution": 0}}}, ["data.dataset.resolution", "at least 8", "0"]),
        ({"data": {"dataset": {"nope": 1}}}, ["bad.yaml", "data.dataset.nope"]),
        ({"data": {"nope": 1}}, ["bad.yaml", "data.nope"]),
        ({"nope": {"a": 1}}, ["bad.yaml", "nope"]),
        (None, ["bad.yaml", "No such file"]),
        ("a: [1,\n b: {", ["bad.yaml", "not valid YAML", "line 2"]),
        ("[1, 2]", ["bad.yaml", "must be a mapping"]),
    ],
    ids=["resolution", "dataset", "data", "top", "missing", "yaml", "list"],
)
def test_configs(refused, with_config, command, content, words):
    refused(with_config(command, content), *words)


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("data.dataset.train=x", ["data.dataset.train: must be a whole number", "data.dataset.train=x"]),
        ("data.dataset.nope=1", ["data.dataset.nope: unknown key"]),
        ("data.dataset.train=[", ["data.dataset.train=[: not valid YAML"]),
        ("data.dataset.num_points=100000000000", ["no space left on disk", "4500.0 GB"]),
    ],
)
def test_settings_of_generate(refused, with_config, tmp_path, monkeypatch, setting, words):
    monkeypatch.chdir(tmp_path)
    refused([*with_config("generate", {}), "data.root=new", setting], *words)
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("command", ["fit", "compare"])
@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"model": {"init_args": {"nope": 1}}}, ["bad.yaml", "'nope'", "CNN", "nlt fit --help"]),
        ({"model": {"init_args": {"width": "wide"}}}, ["bad.yaml", "width: must be a whole number", "wide"]),
        ({"model": {"init_args": {"width": 0}}}, ["model.init_args.width", "at least 1"]),
        ({"model": {"class_path": "nlt.nope.Nope"}}, ["bad.yaml", "nlt.nope.Nope"]),
        ({"trainer": {"nope": 1}}, ["bad.yaml", "trainer.nope", "nlt fit --help"]),
        ({"trainer": {"accelerator": "abacus"}}, ["accelerator", "abacus", "cpu"]),
        ({"data": {"batch_size": 100}}, ["data.batch_size", "100", "8"]),
    ],
    ids=["init_args", "type", "width", "class", "trainer", "accelerator", "batch"],
)
def test_configs_of_training(refused, with_config, command, content, words):
    refused(with_config(command, content), *words)


def test_known_keys_are_the_datamodules():
    assert set(DataSection.model_fields) == set(inspect.signature(LightTransportDataModule).parameters)


def test_scale_without_a_model(refused, tiny):
    refused(["fit", f"--config={tiny.data}", f"--config={tiny.scale}"], "scale.yaml", "class_path", "configs/model")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"nope": 1}, ["comparison.yaml", "nope", "known are"]),
        ({"table": "table3"}, ["comparison.yaml", "table", "table1", "table3"]),
        ({"methods": ["nope"]}, ["comparison.yaml", "methods", "nope", "nlt_photons"]),
        ({"methods": ["cnn@nope"]}, ["comparison.yaml", "methods", "nope", "tiny", "paper"]),
        ({"scale": "nope"}, ["nope.yaml", "No such file"]),
        ({"data": "nope"}, ["nope.yaml", "No such file"]),
        ({"scale": None}, ["comparison.yaml", "scale", "must be a text"]),
        ({"seed": -1}, ["comparison.yaml", "seed", "-1"]),
    ],
)
def test_comparisons(refused, tiny, tmp_path, content, words):
    content = {"data": str(tiny.data), "scale": str(tiny.scale)} | content
    refused(["compare", "--config", write(tmp_path / "comparison.yaml", content)], *words)


def test_unknown_comparison(refused):
    refused(["compare", "--config=nope"], "compare/nope.yaml", "No such file")


def test_order_of_configs_and_spelling_of_settings_are_free(tiny, tmp_path, capsys):
    def printed(*arguments):
        with pytest.raises(SystemExit):
            main(["fit", *arguments, "--print_config"])
        return yaml.safe_load(capsys.readouterr().out)

    files = [f"--config={tiny.scale}", "--config=model/cnn", f"--config={tiny.data}"]
    config = printed(*files, "model.init_args.width=4")
    assert config["model"]["class_path"] == "nlt.baselines.cnn.CNN" and config["model"]["init_args"]["width"] == 4
    for setting in (["--model.init_args.width=4"], ["--model.init_args.width", "4"]):
        assert printed(*setting, *reversed(files)) == config


# ---- scenes, datasets -----------------------------------------------------------------------------------


def room_without(what, folder):
    """A scene.yaml with a mistake, and what is to be said about it."""
    if what == "source":
        return write_yaml(folder / "scene.yaml", source="gone.xml"), ["gone.xml"]
    if what == "emitters":
        return write_room(folder, light=False), ["scene.xml", "emit"]
    objects = {"crate": {"shapes": ["grate"], "box": [[0, 0, 0], [1, 0, 0]]}}
    return write_room(folder, objects=objects), ["scene.yaml", "objects.crate", "grate", "crate", "lamp"]


@pytest.mark.parametrize("what", ["source", "emitters", "shape"])
def test_scenes(refused, tmp_path, what):
    file, words = room_without(what, tmp_path)
    dataset = {**DATASET, "scenes": [str(file)], "experiment": "fixed_lights"}
    config = write(tmp_path / "data.yaml", {"data": {"dataset": dataset}})
    refused(["generate", "--config", config, "--workers=1"], *words)


def test_no_space(refused, tiny, tmp_path, monkeypatch):
    """What was there stays; once there is room, the same command goes on."""
    directory, config = copy_dataset(tiny, tmp_path)
    content = {path: path.read_bytes() for path in directory.rglob("*.safetensors")}
    gone = directory / "train/000-0000004.safetensors"
    gone.unlink()
    usage = namedtuple("usage", "total used free")
    with monkeypatch.context() as patch:
        patch.setattr(generation.shutil, "disk_usage", lambda _: usage(1, 1, 10))
        refused(["generate", "--config", config, "--workers=1"], directory, "no space left on disk")
    assert {path: path.read_bytes() for path in directory.rglob("*.safetensors")} == {
        path: data for path, data in content.items() if path != gone
    }
    assert main(["generate", "--config", str(config), "--workers=1"]) == 0
    assert gone.read_bytes() == content[gone]


def test_no_permission(refused, tiny, tmp_path):
    write(tmp_path / "taken", "a file where a directory should be")
    content = merge(yaml.safe_load(tiny.data.read_text()), {"data": {"root": str(tmp_path / "taken")}})
    refused(["generate", "--config", write(tmp_path / "data.yaml", content)], tmp_path / "taken")


def test_dataset_not_generated(refused, tiny):
    refused(tiny.command("fit", "cnn", "--data.dataset.seed=7"), "datasets", "no dataset here", "nlt generate")


@pytest.mark.parametrize("workers", [0, 1])
def test_truncated_shard(refused, tiny, tmp_path, workers):
    """Said in one line although a loader process found it."""
    directory, config = copy_dataset(tiny, tmp_path)
    shard = directory / "train/000-0000004.safetensors"
    os.truncate(shard, shard.stat().st_size - 100)
    arguments = tiny.command("fit", "cnn", f"--config={config}", f"--data.workers={workers}")
    refused(arguments, shard, "damaged shard", "delete the file", "nlt generate")


# ---- checkpoints ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", ["fit", "test"])
def test_checkpoints(refused, tiny, checkpoint, tmp_path, command):
    def run(path, *words, method="cnn"):
        refused(tiny.command(command, method, f"--ckpt_path={path}"), path, *words)

    run("gone.ckpt", "--ckpt_path", "No such file")
    run(write(tmp_path / "garbage.ckpt", "garbage"), "--ckpt_path", "not a checkpoint")
    (tmp_path / "half.ckpt").write_bytes(checkpoint.read_bytes()[:-1000])
    run(tmp_path / "half.ckpt", "--ckpt_path", "damaged")
    run(checkpoint, "checkpoint is of CNN, not NeuralLightTransport", "configuration", method="nlt")
    # Same method, another size.
    bigger = tiny.command(command, "cnn", "--model.init_args.width=4", f"--ckpt_path={checkpoint}")
    refused(bigger, checkpoint, "width=2", "width=4")


@pytest.mark.parametrize("command", ["validate", "test", "predict"])
def test_evaluation_needs_a_checkpoint(refused, tiny, command):
    refused(tiny.command(command, "cnn"), "--ckpt_path", "missing", "nlt fit")
