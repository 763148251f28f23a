"""Rendering the stress suites of a dataset, and reading them: a file per ladder, severity and scene."""

from __future__ import annotations

import os
import sys
import zlib
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from nlt.data.changed_scene import MESHES, ChangedScene
from nlt.data.dataset import SampleTensors, as_batch
from nlt.data.engines import Local, cores
from nlt.data.files import AnyPath, list_files, open_path
from nlt.data.render import SampleRenderer
from nlt.data.spec import DatasetSpec
from nlt.data.stage import Stage, lacks, path
from nlt.data.store import Points, ShardReader, points_name, read_points, write_shard
from nlt.data.suites import CLEAN, FLICKER, PATHS, RENDERED, Suites
from nlt.errors import UserError
from nlt.rendering.variant import choose_variant
from nlt.scenes.camera import Camera
from nlt.scenes.pointcloud import sample_points

DRAWS, PATH = "draws", "path"
FEWER_SPP = (1, 2, 3)  # per input pixel, of the clean views
_DRAWN = ("noisy_input", "photon_origin", "photon_direction", "photon_flux", "photon_hit", "photon_valid")


@dataclass(frozen=True)
class Rung:
    """A file of views: one ladder of a suite at one severity, in one scene."""

    scene: int
    suite: str
    ladder: str
    severity: int
    change: str | None = None
    value: float = 0.0
    views: int = 0

    @property
    def name(self) -> str:
        return f"{self.scene:03d}/{self.suite}-{self.ladder}-{self.severity}.safetensors"

    @property
    def points_name(self) -> str:
        return self.name.replace(".safetensors", ".points.safetensors")

    @property
    def seed(self) -> list[int]:
        return [self.scene, zlib.crc32(f"{self.suite}/{self.ladder}".encode()), self.severity]


def rungs(spec: DatasetSpec, suites: Suites, wanted: list[str]) -> list[Rung]:
    """Everything to render for the suites `wanted`; the clean views come with any of them."""
    flicker, found = suites.content[FLICKER], []
    views = min(suites.views, spec.test)
    for scene in range(len(spec.scenes)):
        found.append(Rung(scene, CLEAN, "views", 0, views=views))
        for ladder in suites.ladders:
            if ladder.suite in RENDERED and ladder.suite in wanted and not lacks(spec, scene, ladder.change):
                found += [
                    Rung(scene, ladder.suite, ladder.name, severity, ladder.change, value, views)
                    for severity, value in enumerate(ladder.values, 1)
                ]
        if FLICKER in wanted:
            found += [Rung(scene, FLICKER, DRAWS, k + 1, views=views) for k in range(flicker["draws"])]
            for kind in PATHS:
                if not (kind == "object" and lacks(spec, scene, "object_outside")) and not (
                    kind == "light" and lacks(spec, scene, "light_lowered")
                ):
                    found.append(Rung(scene, FLICKER, kind, 0, PATH, flicker[kind], flicker["frames"]))
    return found


def render_suites(
    spec: DatasetSpec, dataset: AnyPath, suites: Suites, wanted: list[str], root: str | AnyPath
) -> AnyPath:
    """Render what is missing of the suites `wanted` and return their directory.

    Raises:
        UserError: a scene is wrong, or a worker failed twice.
    """
    directory = suites.directory(spec, root)
    there = list_files(directory) if directory.exists() else set()
    missing = [rung for rung in rungs(spec, suites, wanted) if rung.name not in there]
    if not missing:
        return directory
    total, died = sum(rung.views for rung in missing), dict[tuple[Rung, ...], str]()
    print(f"{directory}: {total} views of {len(missing)} rungs to render", flush=True)
    work = partial(_render, spec, suites, str(dataset), str(directory), choose_variant().name)
    with (
        tqdm(total=total, unit="view", desc="rendering", file=sys.stderr, mininterval=1.0) as bar,
        closing(Local(cores(), preload=(SampleTensors.__module__,)).run(work, _jobs(missing), died)) as ticks,
    ):
        for ticked in ticks:
            bar.update((ticked or 0) - bar.n)
    for job, reason in died.items():
        raise UserError(f"{directory / job[0].name}: a worker that rendered it died twice ({reason})")
    return directory


def _jobs(missing: list[Rung]) -> list[tuple[Rung, ...]]:
    """Rungs that one process renders: loading a scene costs as much as a few views.

    A scene that is changed has a process of its own, for Mitsuba cannot forget the one before.
    """
    changed = [(rung,) for rung in missing if rung.change in MESHES]
    plain: dict[int, list[Rung]] = {}
    for rung in missing:
        if rung.change not in MESHES:
            plain.setdefault(rung.scene, []).append(rung)
    shared = [tuple(mine[k :: cores()]) for mine in plain.values() for k in range(min(cores(), len(mine)))]
    return [*shared, *changed]


def _render(
    spec: DatasetSpec,
    suites: Suites,
    dataset: str,
    place: str,
    variant: str,
    job: tuple[Rung, ...],
    threads: int,
    tick: Callable[[int], None],
) -> None:
    os.environ["NLT_VARIANT"] = variant
    directory, first = open_path(place), job[0]
    spec = replace(spec, reference_spp=suites.content["reference"])
    points = read_points(open_path(dataset) / points_name(first.scene))
    seed = int(suites.content["seed"])
    if first.change in MESHES:
        build = partial(ChangedScene, change=first.change, value=first.value, points=points, seed=seed)
        render = SampleRenderer(spec, first.scene, threads, build)
    else:
        render = SampleRenderer(spec, first.scene, threads)
    stage = Stage(render, points, seed)
    for rung in job:
        seeds = np.random.SeedSequence([seed, *rung.seed]).spawn(rung.views)
        samples = []
        for sample in _samples(stage, suites, rung, seeds):
            samples.append(sample)
            tick(1)
        write_shard(directory / rung.points_name, [_points(stage, points, rung)])
        write_shard(directory / rung.name, samples)


def _samples(stage: Stage, suites: Suites, rung: Rung, seeds: list[np.random.SeedSequence]) -> Iterator[Points]:
    """A rung's views, with everything that a method may read and what methods without training are given."""
    render = stage.render
    if rung.ladder == DRAWS:
        for k, one in enumerate(seeds):
            yield render.view(stage.place(k), one, _DRAWN)
        return
    change = None if rung.change in MESHES else rung.change
    cameras: Iterator[Camera] = (stage.place(k, change, rung.value) for k in range(rung.views))
    if change == PATH:
        cameras = path(stage, rung.ladder, rung.value, rung.views)
    spp = {f"traced_{count}": count for count in suites.content["traced"]}
    if rung.suite == CLEAN:
        spp |= {f"input_{count}": count for count in FEWER_SPP}
    for camera, one in zip(cameras, seeds, strict=True):
        sample = render.view(camera, one, render.spec.fields("test"))
        for own, (name, count) in zip(one.spawn(len(spp)), spp.items(), strict=True):
            sample[name] = np.ascontiguousarray(render.radiance(camera, count, int(own.generate_state(1)[0])))
        yield sample


def _points(stage: Stage, points: Points, rung: Rung) -> Points:
    """The point cloud of a rung: training's, as the changed scene has it, or another draw."""
    if rung.ladder != DRAWS:
        return stage.scene.moved_points(points) if isinstance(stage.scene, ChangedScene) else stage.lit_points()
    spec = stage.render.spec
    return sample_points(stage.scene, spec.points, spec.seed + rung.severity)


def read_views(
    directory: AnyPath, spec: DatasetSpec, suites: Suites, rung: Rung, points: Points | None = None
) -> dict[str, Tensor]:
    """The views of a rung as a batch, with "traced_N" and, of the clean ones, "input_N"; with other points, if given.

    Of a draw, only what differs from the clean views.
    """
    names = list(_DRAWN)
    if rung.ladder != DRAWS:
        names = [*spec.fields("test"), *(f"traced_{count}" for count in suites.content["traced"])]
    if rung.suite == CLEAN:
        names += [f"input_{count}" for count in FEWER_SPP]
    reader = ShardReader()
    stored = [reader.read(directory / rung.name, k, names) for k in range(rung.views)]
    if rung.ladder == DRAWS:
        return as_batch([{name: torch.from_numpy(array) for name, array in view.items()} for view in stored])
    tensors = SampleTensors(spec, {rung.scene: points or read_points(directory / rung.points_name)})
    return as_batch([tensors(rung.scene, view, k) for k, view in enumerate(stored)])
