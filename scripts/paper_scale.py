"""Estimates the cost of the paper's scale from measured rates: `python scripts/paper_scale.py [results/bench/NAME]`.

Everything is read from results of benchmarks/bench.py and the configs, except the prices and a GPU's rate, which are
assumed and marked as such. Prints the tables of docs/cluster.md.
"""

import json
import sys
from pathlib import Path

from nlt.config import read_configs
from nlt.data.sample import SPLITS
from nlt.data.spec import load_spec
from nlt.paths import PROJECT, find_config

METHODS = 9  # in the paper's Table 2
CORE_HOUR, GPU_HOUR = 0.04, 3.0  # dollars, assumed
TFLOPS = (20, 100)  # sustained by one GPU, assumed
BACKWARD = 3  # a training step's work, in forward passes


def _rates(bench: Path) -> tuple[dict, dict, dict, dict]:
    results = json.loads((bench / "bench.json").read_text())
    kinds = {part["kind"]: part for part in results["parts"]}
    return results["manifest"], kinds["generation"], kinds["training"], kinds["frame"]


def tables(bench: Path = PROJECT / "results/bench/target") -> str:
    """Return the measured rates and the cost of the paper's Table 2 at these rates, as Markdown."""
    manifest, generation, training, frame = _rates(bench)
    files = [str(find_config("data", "builtin_moving_lights")), str(find_config("scale", "paper"))]
    (spec, _), scale = load_spec(files), read_configs(files)
    scenes, judged, cores = len(spec.scenes), spec.val + spec.test, manifest["threads"]
    images = scale["trainer"]["max_steps"] * scale["data"]["batch_size"]

    rendering = (
        scenes
        * cores
        / 3600
        * (spec.train / generation["train_per_second"] + judged / generation["evaluated_per_second"])
    )
    disk = scenes * sum(spec.count(split) * spec.nbytes(split) for split in SPLITS)
    steps = cores / 3600 * images / training["images_per_second"]
    work = BACKWARD * frame["flops"] * images
    lines = [
        "| rate | measured |",
        "|---|---|",
        f"| rendering a training sample | {generation['train_per_second']:.2f} a second on {cores} cores |",
        f"| rendering an evaluated sample, with its reference | {generation['evaluated_per_second']:.3f} a second |",
        f"| training the largest method, `{training['method']}`, {frame['precision']} "
        f"| {training['images_per_second']:.2f} images a second |",
        f"| its network | {frame['flops'] / 1e9:.1f} GFLOP a frame |",
        "",
        "| the paper's Table 2 | amount | follows from | cost |",
        "|---|---:|---|---:|",
        f"| rendering | {rendering:,.0f} core-hours | {scenes} rooms x ({spec.train:,} + {judged:,}) samples / rates "
        f"| ${rendering * CORE_HOUR:,.0f} |",
        f"| disk | {disk / 1e12:.2f} TB | {spec.nbytes('train') / 1e6:.2f} MB a training sample, "
        f"{spec.nbytes('test') / 1e6:.2f} MB a test sample | |",
        f"| a training on CPU | {steps:,.0f} core-hours | {images:,} images / rate: out of reach "
        f"| ${steps * CORE_HOUR:,.0f} |",
    ]
    for tflops in TFLOPS:
        hours = work / (tflops * 1e12) / 3600
        for what, count in ((f"a training on a GPU of {tflops} TFLOP/s", 1), (f"{METHODS} methods there", METHODS)):
            follows = f"{BACKWARD} x FLOPs x images" if count == 1 else "none is above the largest"
            lines.append(f"| {what} | {count * hours:,.0f} GPU-hours | {follows} | ${count * hours * GPU_HOUR:,.0f} |")
    note = (
        f"At {spec.resolution}x{spec.resolution}, in {', '.join(manifest['scenes'])}, on {manifest['device']}: "
        f"`{manifest['command']}` at commit {manifest['commit'][:8]}. "
        f"Prices are assumed: ${CORE_HOUR} a core-hour, ${GPU_HOUR:.0f} a GPU-hour."
    )
    return "\n".join([*lines, "", note])


if __name__ == "__main__":
    print(tables(*map(Path, sys.argv[1:2])))
