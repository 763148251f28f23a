"""Online training: its samples are those of an endless stored dataset, each used once or a set number of times."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from conftest import write_yaml
from generated import spec_of
from tiny import DATASET, TRAINER, write

from nlt.cli import main
from nlt.data.datamodule import LightTransportDataModule
from nlt.data.dataset import EpochSampler, OnlineSampler
from nlt.data.online import OnlineDataset
from nlt.data.render import SampleRenderer
from nlt.data.spec import DatasetSpec, load_spec
from nlt.errors import UserError
from nlt.paths import CONFIGS

pytestmark = pytest.mark.slow

pytest_plugins = ["training_fixtures"]


@pytest.fixture(scope="module")
def online(tmp_path_factory):
    """Return a config of online training, its spec, and the directory that `nlt generate` fills for it."""
    folder = tmp_path_factory.mktemp("online")
    data = {"dataset": {**DATASET, "train": 4}, "root": str(folder / "datasets"), "batch_size": 2, "online": True}
    file = write(folder / "data.yaml", {"data": data})
    assert main(["generate", f"--config={file}", "--workers=1"]) == 0
    spec, root = load_spec([str(file)])
    return file, DatasetSpec(**data["dataset"]), spec.directory(root)


def module_of(online, **more):
    _, spec, directory = online
    module = LightTransportDataModule(spec, str(directory.parent), batch_size=2, online=True, **more)
    module.setup("fit")
    return module


def test_nothing_is_stored_for_training(online):
    _, spec, directory = online
    assert {path.name for path in directory.iterdir()} == {"manifest.json", "points-000.safetensors", "test", "val"}
    assert json.loads((directory / "manifest.json").read_text())["spec"]["train"] == 0
    assert directory != spec.directory(directory.parent), "a stored set lies elsewhere"


def test_batches_are_those_of_a_stored_set_without_end(online):
    """Two passes of two processes give the samples that a larger stored dataset would have."""
    loader = module_of(online, workers=2).train_dataloader()
    batches = [batch for _ in range(2) for batch in loader]
    assert [batch["index"].tolist() for batch in batches] == [[0, 1], [2, 3], [4, 5], [6, 7]]
    together = {name: torch.cat([batch[name] for batch in batches]) for name in batches[0]}
    assert len({image.numpy().tobytes() for image in together["noisy"]}) == 8
    render = SampleRenderer(DatasetSpec(**{**DATASET, "train": 8}), 0)
    for k in range(8):
        for name, array in render.sample("train", k).items():
            assert np.array_equal(together[name][k].numpy(), array.astype(together[name].numpy().dtype)), (k, name)


def test_uses(online):
    """With two uses every other sample is one that the process has shown before, of few at first and of many later."""
    _, spec, directory = online
    samples = OnlineDataset(directory, spec.without_train(), {"normal"}, 40, 2, uses=2)
    shown = [samples[index]["noisy"].numpy().tobytes() for index in range(40)]
    render = SampleRenderer(spec, 0)
    for k in (0, 38):
        noisy = torch.from_numpy(render.sample("train", k, only={"noisy"})["noisy"]).float().numpy()
        assert shown[k] == noisy.tobytes(), "rendered samples are those of the stored set"
    fresh, again = shown[::2], shown[1::2]
    assert len(set(fresh)) == 20 and len(set(again)) > 8
    assert all(image in fresh[: k + 1] for k, image in enumerate(again)) and again != fresh
    twice = OnlineDataset(directory, spec.without_train(), {"normal"}, 40, 2, uses=2)
    assert [twice[index]["noisy"].numpy().tobytes() for index in range(6)] == shown[:6]


@pytest.mark.parametrize(
    ("device", "devices", "workers", "rendering", "training"),
    [("cpu", 1, 1, 3, 3), ("cpu", 1, 2, 1, 3), ("cpu", 3, 1, 1, 1), ("cuda", 1, 1, 6, 6)],
)
def test_training_and_rendering_share_no_cpu(online, monkeypatch, device, devices, workers, rendering, training):
    monkeypatch.setattr("nlt.data.datamodule.available_cpus", lambda: 6)
    module, before = module_of(online, workers=workers), torch.get_num_threads()
    root = SimpleNamespace(root_device=torch.device(device))
    module.batch_size = 1
    module.trainer = SimpleNamespace(num_devices=devices, global_rank=0, world_size=devices, strategy=root)
    torch.set_num_threads(6)
    try:
        assert module.train_dataloader().dataset._threads == rendering
        assert torch.get_num_threads() == training
    finally:
        torch.set_num_threads(before)


def test_only_what_the_method_reads_is_rendered(online, monkeypatch):
    _, spec, directory = online
    asked = []
    sample = SampleRenderer.sample
    spy = lambda self, *place, only: asked.append(set(only)) or sample(self, *place, only=only)
    monkeypatch.setattr(SampleRenderer, "sample", spy)
    full = OnlineDataset(directory, spec.without_train(), None, 4, 2)[7]
    some = OnlineDataset(directory, spec.without_train(), {"normal", "point_visible"}, 4, 2)[7]
    assert asked[1] == {"noisy", "normal", "translation", "present"} < asked[0]
    assert set(some) == asked[1] | {"point_visible", "scene", "index", "exposure"}
    assert all(torch.equal(some[name], full[name]) for name in some)


def numbers(module, passes, rank=0, processes=1, length=7):
    sampler = OnlineSampler(length, rank, processes, module.seed, module.next_pass)
    return [list(sampler) for _ in range(passes)]


def test_no_number_comes_twice(online):
    """No sample comes twice in passes, ranks, seeds or after resuming; epochs of a stored dataset repeat theirs."""
    ranks = [numbers(module_of(online), 3, rank, 2) for rank in (0, 1)]
    assert all(len(one) == 3 for rank in ranks for one in rank)
    other = numbers(module_of(online, seed=1), 3)
    first = module_of(online)
    begun = numbers(first, 2)
    resumed = module_of(online)
    resumed.load_state_dict(first.state_dict())
    gone_on = numbers(resumed, 2)
    for parts in ([*ranks[0], *ranks[1]], [*begun, *gone_on, *other]):
        flat = [number for part in parts for number in part]
        assert len(set(flat)) == len(flat)
    assert [*begun, *gone_on] == numbers(module_of(online), 4), "as if it had not been interrupted"
    stored = EpochSampler(7, 0, 1, True, 0)
    assert sorted(stored) == sorted(stored)


def test_states_of_the_evaluated_splits_are_left_out(tmp_path):
    """If there are two states and the test split has one of them, training uses only the other."""
    file = write_yaml(tmp_path / "scene.yaml", objects={"rug": {"shapes": ["rug"], "box": [[0, 0, 0], [0, 0, 0]]}})
    spec = spec_of(str(file), experiment="fixed_lights", train=3, val=0, test=1).without_train()
    render = SampleRenderer(spec, 0)
    render.place("test", 0)
    taken = render.scene.state.key
    states = [(render.place("train", number), render.scene.state.key)[1] for number in (*range(20), 5 << 32)]
    assert set(states) == set(states[:1]) and taken not in states
    free = {spec.state("train", 0, number, ()).key for number in range(20)}
    assert taken in free, "the test cannot tell: no draw met the taken state"


def test_mistakes(online, tmp_path):
    with pytest.raises(UserError, match=r"data.workers: must be at least 1, is 0: with data.online"):
        module_of(online, workers=0)
    with pytest.raises(UserError, match=r"data.uses: must be at least 1, and 1 without data.online, is 0"):
        module_of(online, uses=0)
    with pytest.raises(UserError, match=r"data.uses: must be at least 1, and 1 without data.online, is 2"):
        LightTransportDataModule(online[1], uses=2)
    odd = write(tmp_path / "odd.yaml", {"data": {"dataset": DATASET, "online": "yes please"}})
    with pytest.raises(UserError, match=r"odd.yaml: data.online: must be true or false"):
        load_spec([str(odd)])
    stored = LightTransportDataModule(online[1].without_train(), str(online[2].parent), batch_size=2)
    stored.setup("fit")
    with pytest.raises(UserError, match=r"data.dataset.train: is 0"):
        stored.train_dataloader()


def test_fit(online, tmp_path, monkeypatch, one_thread):
    """A run of `nlt fit` that is stopped within an epoch and resumed trains on no sample twice."""
    monkeypatch.chdir(tmp_path)
    seen = []
    for run, (steps, *more) in enumerate([(3,), (5, "--ckpt_path")]):
        folder = tmp_path / str(run)
        folder.mkdir()
        recorder = {"class_path": "tiny.Recorder", "init_args": {"directory": str(folder)}}
        trainer = {**TRAINER, "max_epochs": -1, "max_steps": steps, "limit_val_batches": 0, "callbacks": [recorder]}
        config = write(folder / "scale.yaml", {"model": {"init_args": {"width": 2}}, "trainer": trainer})
        files = [online[0], CONFIGS / "model/cnn.yaml", config]
        arguments = ["fit", *(f"--config={file}" for file in files), f"--trainer.default_root_dir={folder}"]
        if more:
            (checkpoint,) = (tmp_path / "0").glob("lightning_logs/version_0/checkpoints/*.ckpt")
            arguments.append(f"--ckpt_path={checkpoint}")
        assert main(arguments) == 0
        seen += [int(line) for file in folder.glob("*-0") for line in file.read_text().split()]
    assert len(seen) == 2 * 5 and len(set(seen)) == len(seen)
