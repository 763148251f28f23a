"""Compares the speed of training's data loading with only reading the same bytes and their CRC on this machine.

    python benchmarks/loading.py                     # writes results/bench/loading.json

A dataset of random bytes in the format of nlt/data/sample.py is written to a temporary folder and read from the page
cache. The loader is the DataModule's own, with its shuffling, its processes and its CRCs, and its batches arrive in
this process. The ceiling is `np.fromfile` of the bytes that the method reads of a sample, and their zlib.crc32, in as
many processes. The timing is interleaved, so that other work on the machine slows both; medians and best over turns are
reported. `cpu_ms` is the processor time of one sample without worker processes, which other work affects least.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
import zlib
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from nlt.config import read_configs
from nlt.data.datamodule import LightTransportDataModule
from nlt.data.dataset import LightTransportDataset
from nlt.data.files import write_bytes
from nlt.data.sample import MATERIALS, POINT_FIELDS, Field
from nlt.data.spec import DatasetSpec
from nlt.data.store import points_name, write_manifest, write_shard
from nlt.evaluation.provenance import origin, surroundings
from nlt.models import factory
from nlt.models.method import Method
from nlt.paths import find_config


def synthetic(spec: DatasetSpec, root: str) -> Path:
    """Write a dataset of random numbers in the form of `spec` and return its directory."""
    rng, sizes, directory = np.random.default_rng(0), spec.sizes("train"), Path(str(spec.directory(root)))

    def array(field: Field) -> np.ndarray:
        shape = field.resolve(sizes)
        if field.dtype == "bool":
            return rng.random(shape) < 0.9
        return np.asarray(rng.random(shape, np.float32) * (1 if field.dtype.startswith("float") else 2), field.dtype)

    for scene in range(len(spec.scenes)):
        points = {name: array(field) for name, field in POINT_FIELDS.items()}
        points["object"] = rng.integers(-1, sizes["M"], sizes["N"], np.int32)
        points["material"] = rng.integers(0, len(MATERIALS), sizes["N"], np.uint8)
        write_shard(directory / points_name(scene), [points])
    for shard in spec.shards():
        fields = spec.fields(shard.split)
        cameras = {
            "camera_matrix": np.array([[spec.resolution, 0, spec.resolution / 2]] * 2 + [[0, 0, 1]], np.float32),
            "world_to_view": np.eye(4, dtype=np.float32),
        }
        cameras["camera_matrix"][1] = [0, spec.resolution, spec.resolution / 2]
        rows = range(shard.start, shard.stop)
        write_shard(directory / shard.name, [{n: array(f) for n, f in fields.items()} | cameras for _ in rows])
    write_manifest(directory, spec, "synthetic")
    return directory


def build(method: str, spec: DatasetSpec, width: int) -> Method:
    """Return a method with random weights."""
    file = find_config("model", method)
    sizes = {"width": width, "num_scenes": len(spec.scenes), "num_points": spec.num_points}
    return factory.build(read_configs([file]), file, **sizes)


class Bare(Dataset):
    """A dataset that reads `nbytes` of a file for every sample and returns their CRC."""

    def __init__(self, file: Path, nbytes: int, count: int) -> None:
        self.file, self.nbytes, self.count = file, nbytes, count

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> int:
        return zlib.crc32(np.fromfile(self.file, np.uint8, self.nbytes, offset=index * self.nbytes).data)


def rate(loader: DataLoader, samples: int) -> float:
    """Return the samples per second of one pass, after the processes have started."""
    iterator = iter(loader)
    next(iterator)
    start = time.perf_counter()
    batches = sum(1 for _ in iterator)
    assert loader.batch_size
    return min(batches * loader.batch_size, samples) / (time.perf_counter() - start)


def cpu_ms(dataset: LightTransportDataset, batch: int) -> float:
    """Return the least processor time of a sample in ms, read in batches in this process."""
    times = []
    for start in range(0, len(dataset) - batch + 1, batch):
        before = time.process_time()
        dataset.__getitems__(list(range(start, start + batch)))
        times.append(time.process_time() - before)
    return 1e3 * min(times) / batch


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--methods", nargs="+", default=["cnn", "nlt_photons"])
    parser.add_argument("--resolution", type=int, default=256)
    parser.add_argument("--samples", type=int, default=512)
    parser.add_argument("--batch", type=int, default=32)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--out", type=Path, default=Path("results/bench/loading.json"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    spec = DatasetSpec(["living_room"], resolution=options.resolution, train=options.samples, val=0, test=0)
    report: dict[str, Any] = {"options": {k: str(v) for k, v in vars(options).items()}, "methods": {}}
    report["manifest"] = origin() | surroundings(torch.device("cpu"))
    with tempfile.TemporaryDirectory() as folder:
        directory = synthetic(spec, folder)
        for method in options.methods:
            inputs = build(method, spec, 8).fields
            module = LightTransportDataModule(spec, folder, options.batch, options.workers)
            dataset = LightTransportDataset(directory, spec, "train", inputs)
            module.directory = directory
            module.split = partial(lambda dataset, name: dataset, dataset)  # type: ignore[method-assign]
            sizes, stored = spec.sizes("train"), spec.fields("train")
            nbytes = sum(stored[name].nbytes(sizes) for name in dataset._stored)
            file = Path(folder) / f"{method}.bin"
            file.write_bytes(np.random.default_rng(0).bytes(nbytes * options.samples))
            bare = DataLoader(Bare(file, nbytes, options.samples), options.batch, num_workers=options.workers,
                              persistent_workers=options.workers > 0)  # fmt: skip
            loader = module.train_dataloader()
            loads, ceilings = [], []
            for _ in range(options.turns):
                loads.append(rate(loader, options.samples))
                ceilings.append(rate(bare, options.samples))
            row = {
                "samples_per_second": statistics.median(loads),
                "best_samples_per_second": max(loads),
                "ceiling_samples_per_second": statistics.median(ceilings),
                "ratio_to_ceiling": statistics.median(a / b for a, b in zip(loads, ceilings, strict=True)),
                "bytes_per_sample": nbytes,
                "cpu_ms_per_sample": cpu_ms(dataset, options.batch),
            }
            report["methods"][method] = row
            print(method, ", ".join(f"{key} {value:,.4g}" for key, value in row.items()), flush=True)
            file.unlink()
    write_bytes(options.out, (json.dumps(report, indent=1) + "\n").encode())


if __name__ == "__main__":
    main()
