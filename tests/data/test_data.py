"""Generated datasets: complete, of the declared form, the same bytes however often interrupted, strictly checked."""

import dataclasses
import json
import os
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import write_yaml
from generated import SIZE, content, spec_of
from safetensors.numpy import load_file

from nlt.data import store
from nlt.data.datamodule import LightTransportDataModule
from nlt.data.dataset import EpochSampler, LightTransportDataset
from nlt.data.generate import generate
from nlt.data.sample import BATCH_FIELDS, FIELDS, POINT_FIELDS, SPLITS
from nlt.data.spec import DatasetSpec
from nlt.errors import UserError
from nlt.scenes.camera import Camera


@pytest.fixture
def damaged(dataset, tmp_path):
    """A copy of the dataset that a test may damage."""
    return Path(shutil.copytree(dataset, tmp_path / dataset.name))


def samples_of(directory, split):
    spec = spec_of()
    return [dict(LightTransportDataset(directory, spec, split)[k]) for k in range(spec.count(split))]


# ---- form -----------------------------------------------------------------------------------------------


def test_fields(dataset):
    """Every array on disk has the shape and dtype that FIELDS and POINT_FIELDS give."""
    spec, reader = spec_of(), store.ShardReader()
    for shard in spec.shards():
        fields = {n: f for n, f in FIELDS.items() if shard.split in f.splits}
        for row in range(shard.stop - shard.start):
            sample = reader.read(dataset / shard.name, row, fields)
            for name, field in fields.items():
                shape = field.resolve(spec.sizes(shard.split))
                assert sample[name].shape == shape and sample[name].dtype == field.dtype, name
                assert np.isfinite(sample[name]).all(), name
    points = store.read_points(dataset / store.points_name(0))
    for name, field in POINT_FIELDS.items():
        assert points[name].shape == field.resolve(spec.sizes("test")) and points[name].dtype == field.dtype, name


def test_samples_differ_and_mean_what_they_say(dataset, demo):
    samples = samples_of(dataset, "test") + samples_of(dataset, "train")
    for name in ("noisy", "noisy_input", "target", "depth", "world_to_view", "photon_origin", "translation"):
        those = samples_of(dataset, "train") if name == "target" else samples
        values = [s[name].numpy().tobytes() for s in those]
        assert len(set(values)) == len(values), name
    for s in samples:
        assert not torch.equal(s["noisy"], s["noisy_input"])
        assert (s["translation"][~s["present"]] == 0).all() and (s["photon_hit"][~s["photon_valid"]] == 0).all()
        # The closed room's photons all carry the light's power.
        power = torch.from_numpy(demo.light.radiance * demo.light.size.prod() * np.pi).float()
        assert torch.allclose(s["photon_flux"].sum(0), power, rtol=1e-3)
    for s in samples[:4]:
        assert not torch.equal(s["reference_a"], s["reference_b"])


def test_nothing_is_pickled(dataset):
    assert {Path(name).suffix for name in content(dataset)} == {".json", ".safetensors"}
    for name, data in content(dataset).items():
        if name.endswith(".safetensors"):
            header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
            assert all(set(v) == {"dtype", "shape", "data_offsets"} for v in header.values())


@pytest.mark.parametrize(
    "change",
    [{"resolution": 0}, {"train": -1}, {"num_points": 0}, {"num_photons": 1.5}, {"shard_size": 0}, {"seed": -1},
     {"experiment": "moving"}, {"scenes": []}, {"scenes": "living_room"}, {"reference_spp": True},
     {"reference_mse": -1e-4}, {"reference_mse": "1e-4"}, {"reference_mse": True}, {"reference_mse": float("nan")},
     {"reference_mse": float("inf")}],
    ids=str,
)  # fmt: skip
def test_spec_refused(change):
    with pytest.raises(UserError, match=f"data.dataset.{next(iter(change))}"):
        DatasetSpec(**{"scenes": ["living_room"], **SIZE, **change})


def test_spec_is_written_as_ever():
    """The name of a dataset's directory is a hash of these bytes."""
    written = json.dumps(dataclasses.asdict(DatasetSpec(["living_room"], reference_mse=0)), sort_keys=True)
    assert written == (
        '{"crop": 0, "experiment": "moving_lights", "input_spp": 4, "integrator": "scene", "noisy_spp": 1, '
        '"num_photons": 10000, "num_points": 10000, "reference_mse": 0.0, "reference_spp": 64, "resolution": 64, '
        '"scenes": ["living_room"], "seed": 0, "shard_size": 64, "target_spp": 16, "test": 64, '
        '"train": 1000, "val": 16}'
    )


# ---- splits ---------------------------------------------------------------------------------------------


def states_of(spec):
    taken = {split: spec.taken(split, 0) for split in SPLITS}
    return {s: [spec.state(s, 0, k, taken[s]) for k in range(spec.count(s))] for s in SPLITS}


def test_no_state_in_two_splits(tmp_path):
    """Splits share no state, even if a fifth of all draws give the same one: a single object, removed."""
    objects = {"rug": {"shapes": ["rug"], "box": [[-0.1, 0, 0], [0.1, 0, 0]]}}
    file = write_yaml(tmp_path / "scene.yaml", objects=objects)
    for spec in (spec_of(train=300, val=40, test=40), spec_of(str(file), experiment="fixed_lights", train=300, val=40)):
        states = states_of(spec)
        keys = {split: {state.key for state in states[split]} for split in SPLITS}
        assert not (keys["train"] & keys["val"] | keys["train"] & keys["test"] | keys["val"] & keys["test"])
    assert any(not s.present.any() for split in states.values() for s in split), "nothing was forced"


def test_too_few_states_refused(tmp_path):
    """An object that can only be present or absent has two states, which are too few for three splits."""
    file = write_yaml(tmp_path / "scene.yaml", objects={"rug": {"shapes": ["rug"], "box": [[0, 0, 0], [0, 0, 0]]}})
    with pytest.raises(UserError, match=r"scene.yaml.*states"):
        states_of(spec_of(str(file), experiment="fixed_lights", train=100, val=20, test=20))


# ---- damage ---------------------------------------------------------------------------------------------


def module_of(directory, **more):
    module = LightTransportDataModule(spec_of(), str(directory.parent), batch_size=4, workers=0, **more)
    module.setup("fit")
    return module


SHARD = "test/000-0000000.safetensors"


def test_truncated_and_flipped(damaged):
    path = damaged / SHARD
    whole = path.read_bytes()
    for cut in (0, 5, 100, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:cut])
        with pytest.raises(UserError, match=SHARD):
            module_of(damaged).split("test")[0]
    header = int.from_bytes(whole[:8], "little")
    rng = np.random.default_rng(0)
    for at in rng.integers(8 + header, len(whole), 20):  # of every array's bytes, and of the checksums themselves
        broken = bytearray(whole)
        broken[at] ^= 16
        path.write_bytes(broken)
        with pytest.raises(UserError, match=rf"{SHARD}: damaged.*delete"):
            [module_of(damaged).split("test")[k] for k in range(4)]
    path.write_bytes(whole)
    module_of(damaged).split("test")[0]


def test_missing_files(damaged):
    for name in (SHARD, "points-000.safetensors"):
        (damaged / name).rename(damaged / "aside")
        with pytest.raises(UserError, match=rf"incomplete.*{Path(name).name}"):
            module_of(damaged)
        (damaged / "aside").rename(damaged / name)
    dataset = module_of(damaged).split("test")
    (damaged / SHARD).unlink()  # after it was checked
    with pytest.raises(UserError, match=rf"{SHARD}: missing"):
        dataset[0]


def test_manifest(damaged, tmp_path):
    path = damaged / "manifest.json"
    manifest = json.loads(path.read_text())
    path.write_text(path.read_text()[:50])
    with pytest.raises(UserError, match=r"manifest.json: damaged"):
        module_of(damaged)
    path.write_text(json.dumps({**manifest, "scenes": {"living_room": "0"}}))
    with pytest.raises(UserError, match=r"manifest.json: scenes"):
        module_of(damaged)
    path.unlink()
    with pytest.raises(UserError, match=r"no dataset here.*nlt generate"):
        module_of(damaged)


# ---- batches --------------------------------------------------------------------------------------------


def test_batch(dataset):
    module = module_of(dataset)
    for split, loader in (("train", module.train_dataloader()), ("test", module.test_dataloader())):
        batch = next(iter(loader))
        fields = {**spec_of().fields(split), **BATCH_FIELDS}
        assert batch.keys() == fields.keys()
        for name, field in fields.items():
            assert batch[name].shape == (4, *field.resolve(spec_of().sizes(split))), name
            kind = str(batch[name].dtype).removeprefix("torch.")
            assert kind == field.dtype.replace("float16", "float32"), name


def test_points_and_directions_of_a_batch(dataset, demo):
    points = store.read_points(dataset / store.points_name(0))
    for sample in samples_of(dataset, "test"):
        for n in range(200):
            m = points["object"][n]
            offset = sample["translation"][m].numpy() if m >= 0 else np.zeros(3)
            assert np.allclose(sample["point_position"][n].numpy(), points["position"][n] + offset, atol=1e-6)
            assert bool(sample["point_visible"][n]) == (m < 0 or bool(sample["present"][m]))
        # Pixel centres, pushed through K and T by hand, come back.
        world_to_view, matrix = sample["world_to_view"].double(), sample["camera_matrix"].double()
        view = torch.einsum("ij,jhw->ihw", world_to_view[:3, :3], sample["view_direction"].double())
        pixel = torch.einsum("ij,jhw->ihw", matrix, view / view[2])
        rows, columns = torch.meshgrid(torch.arange(16.0), torch.arange(16.0), indexing="ij")
        assert torch.allclose(pixel[:2], torch.stack([columns, rows]).double() + 0.5, atol=1e-4)
        assert sample["exposure"] == demo.exposure and sample["scene"] == 0


def test_reads_only_what_is_asked_for(dataset, monkeypatch):
    asked = []
    read = store.ShardReader.read

    def spy(self, path, row, fields):
        asked.append(set(fields))
        return read(self, path, row, fields)

    monkeypatch.setattr(store.ShardReader, "read", spy)
    spec = spec_of()
    for inputs, split, expected, given in (
        ({"depth"}, "train", {"depth", "noisy"}, {"depth", "noisy"}),
        ({"albedo"}, "test", {"albedo", "noisy", "reference_a", "reference_b"}, None),
        ({"view_direction"}, "train", {"noisy", "camera_matrix", "world_to_view"}, None),
        ({"point_position"}, "train", {"noisy", "translation", "present"}, None),
    ):
        chosen = LightTransportDataset(dataset, spec, split, inputs)
        asked.clear()  # of the points
        sample = chosen[0]
        assert asked == [expected] and set(inputs) <= set(sample)
        if given:
            assert set(sample) == given | {"scene", "index", "exposure"}


@pytest.mark.parametrize(("workers", "batch_size"), [(0, 5), (2, 5), (0, 1)])
def test_batches_hold_what_is_stored(dataset, workers, batch_size):
    """A batch equals, bit for bit, what safetensors reads and what plain formulas derive from it."""
    spec = spec_of()
    module = LightTransportDataModule(spec, str(dataset.parent), batch_size=batch_size, workers=workers)
    module.setup("fit")
    points = load_file(dataset / store.points_name(0))
    points = {name: stack[0] for name, stack in points.items() if not name.startswith(store.CRC)}
    (first, *_) = module.train_dataloader()
    assert batch_size == 1 or sorted(first["index"].tolist()) != first["index"].tolist()
    for row, index in enumerate(first["index"].tolist()):
        shard = spec.shard("train", 0, index)
        stacks = load_file(dataset / shard.name)
        stored = {name: stacks[name][index - shard.start] for name in spec.fields("train")}
        camera = Camera(stored["camera_matrix"], stored["world_to_view"], 16, 16)
        moved = np.vstack([stored["translation"], np.zeros((1, 3), np.float32)])[points["object"]]
        expected = {name: x.astype(np.float32) if x.dtype == np.float16 else x for name, x in stored.items()} | {
            "view_direction": camera.directions(camera.centres()).T.reshape(3, 16, 16).astype(np.float32),
            "point_position": points["position"] + moved,
            "point_visible": np.append(stored["present"], True)[points["object"]],
            "point_material": points["material"].astype(np.int64),
            "point_albedo": points["albedo"],
            "point_emission": points["emission"],
            "scene": np.array(0),
            "index": np.array(index),
            "exposure": np.array(spec.descriptions[0].exposure, np.float32),
        }
        assert first.keys() == expected.keys()
        for name, value in expected.items():
            ours = first[name][row].numpy()
            assert ours.dtype == value.dtype and ours.shape == value.shape, name
            if value.dtype != np.float32:
                assert np.array_equal(ours, value), name
                continue
            if name == "view_direction":  # of length one, computed in float32
                np.testing.assert_allclose(ours, value, rtol=0, atol=3e-7)
                continue
            assert np.array_equal(ours, value), name


def test_threads_read_the_same_batches_in_the_same_order(dataset):
    def batches(workers):
        module = LightTransportDataModule(spec_of(), str(dataset.parent), batch_size=1, workers=workers)
        module.setup("fit")
        loader = module.train_dataloader()
        return [batch for _ in range(2) for batch in loader]

    alone = batches(0)
    for ours, theirs in zip(batches(3), alone, strict=True):
        assert ours.keys() == theirs.keys() and all(torch.equal(ours[name], theirs[name]) for name in theirs)


def test_batches_for_a_gpu_can_be_pinned(dataset, monkeypatch):
    """PyTorch copies a tensor into pinned memory in place, which fails if its elements share memory."""
    pinned = []

    def pin(tensor):
        shares_memory = any(n > 1 and stride == 0 for n, stride in zip(tensor.shape, tensor.stride(), strict=True))
        pinned.append(shares_memory)
        return tensor

    module = LightTransportDataModule(spec_of(), str(dataset.parent), batch_size=2, workers=2)
    module.setup("fit")
    (alone, *_) = module.train_dataloader()
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.Tensor, "pin_memory", pin)
    (batch, *_) = module.train_dataloader()
    assert len(pinned) >= len(batch) and not any(pinned)
    assert all(torch.equal(batch[name], alone[name]) for name in alone)


def test_threads_end_with_the_reading(dataset):
    module = LightTransportDataModule(spec_of(), str(dataset.parent), batch_size=1, workers=2)
    module.setup("fit")
    threads, torchs = threading.active_count(), torch.get_num_threads()
    batches = iter(module.train_dataloader())
    next(batches)
    assert threading.active_count() > threads
    batches.close()
    assert threading.active_count() == threads and torch.get_num_threads() == torchs


@pytest.mark.parametrize("inputs", [{"point_material"}, {"point_albedo"}, {"point_emission"}, {"point_visible"}])
def test_every_point_field_alone(dataset, inputs):
    alone = LightTransportDataset(dataset, spec_of(), "test", inputs)[1]
    full = LightTransportDataset(dataset, spec_of(), "test")[1]
    assert all(torch.equal(alone[name], full[name]) for name in inputs)


def test_epoch_sampler():
    ranks = [EpochSampler(23, rank, 2, shuffle=False, seed=0) for rank in (0, 1)]
    assert sorted([*ranks[0], *ranks[1]]) == list(range(23)) and [len(r) for r in ranks] == [12, 11]

    orders = []
    for epoch in (0, 1, 0):
        parts = []
        for rank in (0, 1):
            sampler = EpochSampler(23, rank, 2, shuffle=True, seed=5)
            sampler.set_epoch(epoch)
            parts.append(list(sampler))
            assert len(parts[-1]) == len(sampler) == 11
        assert not set(parts[0]) & set(parts[1])
        orders.append(parts)
    assert orders[0] == orders[2] != orders[1] and orders[0][0] != sorted(orders[0][0])
    assert list(EpochSampler(23, 0, 2, True, 6)) != orders[0][0]

    order = list(EpochSampler(10, 0, 1, True, 5, distinct=4))
    assert sorted(order[:4]) == sorted(order[4:8]) == list(range(4)) and order[:4] != order[4:8]
    assert len(order) == 10 and len(set(order[8:])) == 2


def test_loader_errors(dataset):
    module = LightTransportDataModule(spec_of(), str(dataset.parent), batch_size=13, workers=0)
    module.setup("fit")
    with pytest.raises(UserError, match=r"batch_size: 13 .* 12"):
        module.train_dataloader()
    with pytest.raises(UserError, match="batch_size"):
        LightTransportDataModule(spec_of(), batch_size=0)
    module.spec.val = 0
    with pytest.raises(UserError, match=r"dataset.val: is 0"):
        module.val_dataloader()


def test_two_scenes(tmp_path):
    """Each scene has its own index, exposure and points; a scene with fewer movable objects is padded."""
    one = write_yaml(tmp_path / "one.yaml", name="one", exposure=2.0)
    objects = {"rug": {"shapes": ["rug"], "box": [[-0.1, 0, 0], [0.1, 0, 0]]}}
    two = write_yaml(tmp_path / "two.yaml", name="two", exposure=0.5, objects=objects)
    more = {"experiment": "fixed_lights", "train": 2, "val": 1, "test": 1, "shard_size": 2}
    spec = spec_of(str(one), str(two), **more)
    generate(spec, tmp_path, workers=1)
    module = LightTransportDataModule(spec, str(tmp_path), batch_size=4, workers=0)
    module.setup("fit")
    (batch,) = module.train_dataloader()
    order = batch["index"].argsort()
    assert batch["scene"][order].tolist() == [0, 0, 1, 1] and batch["exposure"][order].tolist() == [2, 2, 0.5, 0.5]
    assert batch["translation"].shape == (4, 1, 3) and not batch["present"][order][:2].any()
    assert module.num_scenes == 2 and "one+two" in str(module.directory)

    few = LightTransportDataModule(spec, str(tmp_path), batch_size=4, workers=0, train_images=1)
    few.setup("fit")
    (again,) = few.train_dataloader()  # as many steps; the first sample of each scene, twice
    first = {0: order[0], 1: order[2]}
    assert sorted(again["scene"].tolist()) == [0, 0, 1, 1]
    for scene, noisy in zip(again["scene"].tolist(), again["noisy"], strict=True):
        assert torch.equal(noisy, batch["noisy"][first[scene]])
    assert len(few.split("val")) == 2


@pytest.mark.parametrize("more", [{"train_images": 0}, {"train_images": 13}, {"train_images": 4, "online": True}])
def test_train_images_that_are_not_there(more):
    with pytest.raises(UserError, match=r"data.train_images: must be 1 to data.dataset.train \(12\)"):
        LightTransportDataModule(spec_of(), **more)


def test_readers_leave_the_cores_to_the_training():
    """The readers compute with one thread each; the thread that trains keeps all of its own."""
    program = (
        "import torch; from nlt.data.datamodule import ThreadLoader\n"
        "dataset = torch.utils.data.Subset([1.0, 2.0], [0, 1])\n"
        "list(ThreadLoader(dataset, num_workers=1)); print(torch.get_num_threads())"
    )
    command = [sys.executable, "-c", program]  # a new process: this one may have set its number of threads already
    # PyTorch obeys MKL's number before OpenMP's, and Dask may have set both in the environment of these tests.
    environment = {**os.environ, "OMP_NUM_THREADS": "2", "MKL_NUM_THREADS": "2"}
    assert subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout == "2\n"
