"""Compares the speed of generation with a bare loop of `mi.render` that traces the same rays on this machine.

    python benchmarks/generation.py                  # writes results/bench/generation.json and .md

For every sample, both move the objects (`Scene.set_state`, which is Mitsuba's own `params.update`) and render a
path-traced image at 1 spp, another at 4 spp and, for evaluated samples, two at 64 spp. They trace one ray per pixel for
depth, normal and albedo (the `aov` integrator) and one ray per photon from the emitters (`scene.sample_emitter_ray`).
Scene, states, views, resolution, variant and threads are the same. The bare loop is given its states and views, keeps
its images only until they are copied to numpy, and writes nothing; generation samples states and views, checks, stacks,
checksums, writes and syncs. Both run in the same parallel processes, with interleaved timing of one shard at a time, so
that other work on the machine slows both.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import torch
from costs.bare import Bare

from nlt.data.engines import Process, available_cpus
from nlt.data.files import write_bytes
from nlt.data.generate import generate, render_shard
from nlt.data.render import SampleRenderer
from nlt.data.spec import DatasetSpec, Shard
from nlt.evaluation.provenance import origin, surroundings
from nlt.paths import PROJECT
from nlt.report.table_writer import grid
from nlt.scenes.assembly import load_source
from nlt.scenes.description import MOVING_LIGHT

SPLITS = ("train", "test")


def contest(spec: DatasetSpec, rounds: int, barrier: Any, folder: str) -> dict[str, Any]:
    """Return the seconds per sample of every turn, by split and contestant, and kernels compiled after round one."""
    render = SampleRenderer(spec, 0, max(1, available_cpus() // barrier.parties))
    bare = {"bare": Bare(render, frozen=False), "frozen": Bare(render, frozen=True)}
    compiled = dict.fromkeys((*bare, "generation"), 0)
    seconds: dict[str, list[float]] = {f"{split} {who}": [] for split in SPLITS for who in compiled}
    for turn in range(rounds + 1):
        for split in SPLITS:
            shard = spec.shard(split, 0, turn * spec.shard_size)
            views = []
            for index in range(shard.start, shard.stop):
                camera = render.place(split, index)
                views.append((render.scene.state, camera))

            def plain(loop: Bare, shard: Shard = shard, views: list = views) -> None:
                for k, (state, camera) in enumerate(views):
                    loop.sample(state, camera, shard.split, shard.start + k)

            def ours(shard: Shard = shard) -> None:
                render_shard(render, Path(folder) / f"{id(render)}.safetensors", shard, lambda *_: None)

            turns: dict[str, Callable[[], None]] = {who: partial(plain, loop) for who, loop in bare.items()}
            turns["generation"] = ours
            for who, work in turns.items():
                barrier.wait()
                duration, kernels = _timed(work)
                if turn:  # the first turn warms up
                    seconds[f"{split} {who}"].append(duration / (shard.stop - shard.start))
                    compiled[who] += kernels
    return {"seconds": seconds, "compiled": compiled}


def _timed(work: Callable[[], None]) -> tuple[float, int]:
    """Return the seconds of `work` and the number of kernels compiled meanwhile."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, dr.is_jit_v(mi.Float)):
        if dr.is_jit_v(mi.Float):
            dr.kernel_history_clear()
        start = time.perf_counter()
        work()
        duration = time.perf_counter() - start
        kernels = dr.kernel_history((dr.KernelType.JIT,)) if dr.is_jit_v(mi.Float) else []
    return duration, sum(not kernel["cache_hit"] or bool(kernel["cache_disk"]) for kernel in kernels)


def moving(spec: DatasetSpec, rounds: int) -> dict[str, float]:
    """Return the median seconds to move every object until a ray hits it: our instances, and Mitsuba's scene."""
    render = SampleRenderer(spec, 0)
    scene, plain = render.scene, load_source(render.description)
    parameters = mi.traverse(plain)
    keys = {shape: f"{shape}.vertex_positions" for m in scene.movables if m.name != MOVING_LIGHT for shape in m.shapes}
    parameters.keep(sorted(keys.values()))
    rest = {shape: np.array(parameters[key]).reshape(-1, 3) for shape, key in keys.items()}
    units = render.description.units_per_metre
    seconds: dict[str, list[float]] = {"instances": [], "meshes": []}
    states = [spec.state("train", 0, index, ()) for index in range(rounds)]

    def see(mi_scene: Any) -> None:
        np.array(mi_scene.ray_test(mi.Ray3f(mi.Point3f(0, 1, 0), mi.Vector3f(0, 0, 1))))

    for state in states:
        start = time.perf_counter()
        scene.set_state(state)
        see(scene.mi_scene)
        seconds["instances"].append(time.perf_counter() - start)
        start = time.perf_counter()
        for movable, translation in zip(scene.movables, state.translation, strict=True):
            if movable.name != MOVING_LIGHT:
                for shape in movable.shapes:
                    moved = (rest[shape] + translation * units).astype(np.float32).ravel()
                    parameters[keys[shape]] = mi.Float(moved) if dr.is_jit_v(mi.Float) else moved.tolist()
        parameters.update()
        see(plain)
        seconds["meshes"].append(time.perf_counter() - start)
    return {name: statistics.median(values) for name, values in seconds.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description="Generation against a bare loop of mi.render.")
    parser.add_argument("--scene", default="living_room")
    parser.add_argument("--experiment", default="moving_lights")
    parser.add_argument("--resolution", type=int, default=64)
    parser.add_argument("--rounds", type=int, default=8)
    parser.add_argument("--shard", type=int, default=16, help="samples in a turn")
    parser.add_argument("--end-to-end", type=int, default=512, help="training samples of the whole command")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, default=PROJECT / "results" / "bench")
    options = parser.parse_args()
    manifest = origin()
    count = options.shard * (options.rounds + 1)
    sizes = {"train": count, "val": 0, "test": count, "shard_size": options.shard}
    spec = DatasetSpec([options.scene], options.experiment, options.resolution, **sizes)
    manifest |= surroundings(torch.device("cpu"))
    barrier = multiprocessing.get_context("spawn").Barrier(options.workers)
    with tempfile.TemporaryDirectory() as folder:
        parts = [
            Process(contest, replace(spec, seed=k), options.rounds, barrier, folder) for k in range(options.workers)
        ]
        results = [part.result() for part in parts]
        whole = replace(spec, train=options.end_to_end, test=0, shard_size=64)
        start = time.perf_counter()
        generate(whole, folder, workers=options.workers)
        span = time.perf_counter() - start
    rates = {
        key: options.workers / statistics.median(s for result in results for s in result["seconds"][key])
        for key in results[0]["seconds"]
    }
    report = {
        "samples_per_second": rates,
        "ratio": {
            f"{split} {who}": rates[f"{split} generation"] / rates[f"{split} {who}"]
            for split in SPLITS
            for who in ("bare", "frozen")
        },
        "kernels_compiled_after_the_first_turn": {
            who: sum(result["compiled"][who] for result in results) for who in results[0]["compiled"]
        },
        "end_to_end": {"samples": options.end_to_end, "seconds": span, "samples_per_second": options.end_to_end / span},
        "seconds_to_move_all_objects": Process(moving, spec, 20).result(),
        "options": {k: str(v) if isinstance(v, Path) else v for k, v in vars(options).items()},
        "turns": [result["seconds"] for result in results],
        "manifest": manifest,
    }
    write_bytes(options.out / "generation.json", (json.dumps(report, indent=1) + "\n").encode())
    text = markdown(report)
    write_bytes(options.out / "generation.md", text.encode())
    print(text)


def markdown(report: dict[str, Any]) -> str:
    options, rates, moved = report["options"], report["samples_per_second"], report["seconds_to_move_all_objects"]
    rate = lambda split, who: f"{rates[f'{split} {who}']:.2f}"
    ratio = lambda split, who: f"{report['ratio'][f'{split} {who}']:.2f}"
    names = ("generation", "bare", "frozen")
    rows = [[s, *(rate(s, who) for who in names), ratio(s, "bare"), ratio(s, "frozen")] for s in SPLITS]
    contestants = ("generation", "bare loop of mi.render", "the same under dr.freeze")
    whole, compiled = report["end_to_end"], report["kernels_compiled_after_the_first_turn"]
    return "\n".join([
        f"Generation of {options['scene']}, {options['experiment']}, {options['resolution']}x{options['resolution']}, "
        f"{options['workers']} processes; {report['manifest']['device']}, {report['manifest']['mitsuba_variant']}.",
        "",
        *grid(["samples per second", *contestants, "ratio to bare", "ratio to frozen"], rows),
        f"Whole command, including startup: {whole['samples']} training samples in {whole['seconds']:.1f} s, "
        f"{whole['samples_per_second']:.2f} per second. Kernels compiled after the first turn: generation "
        f"{compiled['generation']}, bare loop {compiled['bare']}, frozen {compiled['frozen']}. "
        "Moving all objects until a ray hits them: instances "
        f"{1e3 * moved['instances']:.1f} ms, the scene's own meshes {1e3 * moved['meshes']:.1f} ms.",
        "",
        f"`{report['manifest']['command']}`, medians over turns of {options['shard']} samples; for the rays, see "
        "benchmarks/generation.py.",
        "",
    ])  # fmt: skip


if __name__ == "__main__":
    main()
