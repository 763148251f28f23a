"""Measures how long the evaluation of a whole table takes, stage by stage, without training.

    python benchmarks/evaluation.py                          # nine methods, 4 x 64 views at 64x64, all metrics
    python benchmarks/evaluation.py --methods cnn nlt --views 64     # a part, extrapolated to the whole

Writes results/bench/evaluation.json. Weights and samples are random, which does not change the computation. The
cache of reference features starts empty; `references_cached_s` is the time of the first method when it is evaluated
again with the cache on disk filled, as in a later run. A stage's seconds are those of its calls; "rest" is the time
outside all stages.
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import torch
import torch.nn.functional as F
from loading import build, synthetic
from torch import Tensor
from torchmetrics.image.fid import FrechetInceptionDistance

from nlt.data.dataset import LightTransportDataset
from nlt.data.files import write_bytes
from nlt.data.spec import DatasetSpec, load_spec
from nlt.evaluation import judge
from nlt.evaluation.frames import Frames
from nlt.evaluation.paper import published
from nlt.evaluation.provenance import origin, surroundings
from nlt.metrics import image_metrics, inception
from nlt.metrics.inception import EPSILON, Inception, find_weights, load_inception, read_weights
from nlt.metrics.jackknife import frechet_distance
from nlt.models.module import RenderingModule
from nlt.models.policy import Policy, default_device
from nlt.paths import config_names, find_config

STAGES = {
    "loading": (LightTransportDataset, "__getitems__"),
    "network": (RenderingModule, "forward"),
    "inception": (Inception, "__call__"),
    "flip": (image_metrics, "flip"),
    "mssim": (image_metrics, "structural_similarity_index_measure"),
    "feature_l1": (image_metrics, "feature_l1"),
    "fid": (image_metrics, "frechet_distance"),
    "kid": (image_metrics, "kernel_distance"),
    "jackknife": (judge, "fid_and_kid_without"),
    "cache_write": (inception, "write_shard"),
}


def record(seconds: dict[str, float]) -> None:
    """Make every stage add the time of its calls to `seconds` from now on."""
    for stage, (owner, name) in STAGES.items():
        function = getattr(owner, name)

        def timed(*args: Any, function: Any = function, stage: str = stage, **kwargs: Any) -> Any:
            start = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                seconds[stage] += time.perf_counter() - start

        setattr(owner, name, functools.wraps(function)(timed))


class PlainInception(Inception):
    """Inception as loaded: its normalisations are not folded into the convolutions."""

    def __init__(self, weights: dict[str, tuple[Tensor, ...]]) -> None:
        self._weights = weights

    def conv(self, x: Tensor, name: str, stride: int = 1, padding: int | str = "same") -> Tensor:
        kernel, mean, variance, scale, offset = self._weights[name]
        x = F.conv2d(x, kernel, None, stride, padding)
        return F.batch_norm(x, mean, variance, scale, offset, eps=EPSILON).relu_()


def before_and_after(turns: int = 2) -> dict[str, float]:
    """Return the least seconds of Inception, as loaded and as used, on 16 images, and of FID, torchmetrics' and ours.

    The timing is interleaved, in one thread. Also return the relative differences of the pooled features and distances.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    file, images = find_weights(), torch.rand(16, 3, 64, 64)
    used = load_inception(images.device)
    assert file is not None and used is not None
    plain = PlainInception(read_weights(file))
    features = torch.rand(256, 2048, dtype=torch.float64), torch.rand(256, 2048, dtype=torch.float64) ** 2
    pooled = torch.nn.Identity()
    pooled.num_features = 2048  # type: ignore[assignment]
    theirs = FrechetInceptionDistance(feature=pooled)
    theirs.update(features[0], real=True)
    theirs.update(features[1], real=False)

    def uncached() -> Any:
        theirs._computed = None
        return theirs.compute()

    work = {
        "inception_plain_s": lambda: plain(images)["pool"],
        "inception_s": lambda: used(images)["pool"],
        "fid_torchmetrics_s": uncached,
        "fid_s": lambda: frechet_distance(features[1], features[0]),
    }
    best, result = dict.fromkeys(work, float("inf")), {}
    with torch.inference_mode():
        for _ in range(turns):
            for name, function in work.items():
                start = time.perf_counter()
                result[name] = function()
                best[name] = min(best[name], time.perf_counter() - start)
    a, b = result["inception_plain_s"], result["inception_s"]
    f, g = result["fid_torchmetrics_s"], result["fid_s"]
    torch.set_num_threads(threads)
    difference = float((a - b).abs().max() / a.max())
    return best | {"inception_difference": difference, "fid_difference": float(abs(f - g) / f)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    nine = [name for name in config_names("model") if published("table1", name)]
    parser.add_argument("--methods", nargs="+", default=nine, help="default: the paper's nine")
    parser.add_argument("--views", type=int, default=256)
    parser.add_argument("--resolution", type=int, default=64)
    parser.add_argument("--width", type=int, default=16)
    parser.add_argument("--out", type=Path, default=Path("results/bench/evaluation.json"))
    options = parser.parse_args()
    device = default_device()
    scenes = load_spec([str(find_config("data", "builtin_fixed_lights"))])[0].scenes
    if options.views % len(scenes):
        parser.error(f"--views: must be a multiple of Table 1's {len(scenes)} scenes, is {options.views}")
    test = options.views // len(scenes)
    spec = DatasetSpec(scenes, resolution=options.resolution, train=0, val=0, test=test)
    report: dict[str, Any] = {"options": {k: str(v) for k, v in vars(options).items()}, "methods": {}}
    report["manifest"] = origin() | surroundings(device)
    report["before_and_after"] = before_and_after()
    print(", ".join(f"{k} {v:.3g}" for k, v in report["before_and_after"].items()), flush=True)
    seconds: dict[str, float] = defaultdict(float)
    record(seconds)
    with tempfile.TemporaryDirectory() as folder:
        os.environ["NLT_CACHE"] = str(Path(folder) / "cache")
        directory = synthetic(spec, folder)
        # Only methods with path tracing need more of it.
        frames = cast(Frames, SimpleNamespace(dataset=LightTransportDataset(directory, spec, "test")))
        policy = Policy.for_device(device)
        evaluation = judge.Evaluation(frames, device, policy)

        def evaluate(method: str) -> dict[str, float]:
            module = build(method, spec, options.width)
            seconds.clear()
            start = time.perf_counter()
            evaluation.evaluate(module)
            total = time.perf_counter() - start
            return {**seconds, "rest": total - sum(seconds.values()), "total": total}

        for method in options.methods:
            report["methods"][method] = evaluate(method)
            print(method, ", ".join(f"{k} {v:.2f}" for k, v in report["methods"][method].items()), flush=True)
        evaluation = judge.Evaluation(frames, device, policy)
        report["references_cached_s"] = evaluate(options.methods[0])["total"]
    rows = list(report["methods"].values())
    report["total_s"] = sum(row["total"] for row in rows)
    # An estimate by the number of views and methods; only the first method computes the references.
    others = rows[1:] or rows
    mean = sum(row["total"] for row in others) / len(others)
    report["nine_methods_256_views_s"] = (rows[0]["total"] + 8 * mean) * 256 / options.views
    report["is_extrapolated"] = options.views != 256 or len(rows) != 9
    print(f"total {report['total_s']:.1f} s; nine methods and 256 views: {report['nine_methods_256_views_s']:.0f} s"
          + (" (extrapolated)" if report["is_extrapolated"] else ""))  # fmt: skip
    write_bytes(options.out, (json.dumps(report, indent=1) + "\n").encode())


if __name__ == "__main__":
    main()
