"""Rendering and reading the stress suites of a dataset, in a file per ladder, severity and scene."""

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

from nlt.data.dataset import SampleTensors, collate
from nlt.data.engines import Local, available_cpus
from nlt.data.files import AnyPath, list_files, open_path
from nlt.data.render import SampleRenderer
from nlt.data.spec import DatasetSpec
from nlt.data.store import Points, ShardReader, points_name, read_points, write_shard
from nlt.errors import UserError
from nlt.rendering.variant import choose_variant
from nlt.scenes.camera import Camera
from nlt.scenes.pointcloud import sample_points
from nlt.stress.changed_scene import MESHES, ChangedScene
from nlt.stress.perturber import ViewPerturber, lacks, path
from nlt.stress.suites import CLEAN, FLICKER, PATHS, RENDERED, Suites

DRAWS, PATH = "draws", "path"
FEWER_SPP = (1, 2, 3)  # samples per input pixel that the clean views are also rendered at
_DRAWN = ("noisy_input", "photon_origin", "photon_direction", "photon_flux", "photon_hit", "photon_valid")


@dataclass(frozen=True)
class ViewSet:
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


def view_sets(spec: DatasetSpec, suites: Suites, wanted: list[str]) -> list[ViewSet]:
    """Return everything to render for the suites `wanted`, always with the clean views."""
    flicker, sets = suites.content[FLICKER], []
    views = min(suites.views, spec.test)
    for scene in range(len(spec.scenes)):
        sets.append(ViewSet(scene, CLEAN, "views", 0, views=views))
        for ladder in suites.ladders:
            if ladder.suite in RENDERED and ladder.suite in wanted and not lacks(spec, scene, ladder.change):
                sets += [
                    ViewSet(scene, ladder.suite, ladder.name, severity, ladder.change, value, views)
                    for severity, value in enumerate(ladder.values, 1)
                ]
        if FLICKER in wanted:
            sets += [ViewSet(scene, FLICKER, DRAWS, k + 1, views=views) for k in range(flicker["draws"])]
            for kind in PATHS:
                if not (kind == "object" and lacks(spec, scene, "object_outside")) and not (
                    kind == "light" and lacks(spec, scene, "light_lowered")
                ):
                    sets.append(ViewSet(scene, FLICKER, kind, 0, PATH, flicker[kind], flicker["frames"]))
    return sets


def render_suites(
    spec: DatasetSpec, dataset: AnyPath, suites: Suites, wanted: list[str], root: str | AnyPath
) -> AnyPath:
    """Render the missing views of the suites `wanted` and return their directory.

    Raises:
        UserError: a scene is wrong, or a worker failed twice.
    """
    directory = suites.directory(spec, root)
    existing = list_files(directory) if directory.exists() else set()
    missing = [view_set for view_set in view_sets(spec, suites, wanted) if view_set.name not in existing]
    if not missing:
        return directory
    total, failures = sum(view_set.views for view_set in missing), dict[tuple[ViewSet, ...], str]()
    print(f"{directory}: {total} views of {len(missing)} sets to render", flush=True)
    work = partial(_render, spec, suites, str(dataset), str(directory), choose_variant().name)
    with (
        tqdm(total=total, unit="view", desc="rendering", file=sys.stderr, mininterval=1.0) as bar,
        closing(
            Local(available_cpus(), preload=(SampleTensors.__module__,)).run(work, _jobs(missing), failures)
        ) as ticks,
    ):
        for ticked in ticks:
            bar.update((ticked or 0) - bar.n)
    for job, reason in failures.items():
        raise UserError(f"{directory / job[0].name}: the worker that rendered it died twice ({reason})")
    return directory


def _jobs(missing: list[ViewSet]) -> list[tuple[ViewSet, ...]]:
    """Group the view sets by process, because loading a scene costs as much as a few views.

    A changed scene has a process of its own, because Mitsuba does not release the scene before it.
    """
    changed = [(view_set,) for view_set in missing if view_set.change in MESHES]
    plain: dict[int, list[ViewSet]] = {}
    for view_set in missing:
        if view_set.change not in MESHES:
            plain.setdefault(view_set.scene, []).append(view_set)
    shared = [
        tuple(mine[k :: available_cpus()]) for mine in plain.values() for k in range(min(available_cpus(), len(mine)))
    ]
    return [*shared, *changed]


def _render(
    spec: DatasetSpec,
    suites: Suites,
    dataset: str,
    place: str,
    variant: str,
    job: tuple[ViewSet, ...],
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
    perturber = ViewPerturber(render, points, seed)
    for view_set in job:
        seeds = np.random.SeedSequence([seed, *view_set.seed]).spawn(view_set.views)
        samples = []
        for sample in _samples(perturber, suites, view_set, seeds):
            samples.append(sample)
            tick(1)
        write_shard(directory / view_set.points_name, [_points(perturber, points, view_set)])
        write_shard(directory / view_set.name, samples)


def _samples(
    perturber: ViewPerturber, suites: Suites, view_set: ViewSet, seeds: list[np.random.SeedSequence]
) -> Iterator[Points]:
    """Yield the views of a set, with all fields that methods read and the renderings for methods without training."""
    render = perturber.render
    if view_set.ladder == DRAWS:
        for k, view_seed in enumerate(seeds):
            yield render.view(perturber.place(k), view_seed, _DRAWN)
        return
    change = None if view_set.change in MESHES else view_set.change
    cameras: Iterator[Camera] = (perturber.place(k, change, view_set.value) for k in range(view_set.views))
    if change == PATH:
        cameras = path(perturber, view_set.ladder, view_set.value, view_set.views)
    spp = {f"traced_{count}": count for count in suites.content["traced"]}
    if view_set.suite == CLEAN:
        spp |= {f"input_{count}": count for count in FEWER_SPP}
    for camera, view_seed in zip(cameras, seeds, strict=True):
        sample = render.view(camera, view_seed, render.spec.fields("test"))
        for spp_seed, (name, count) in zip(view_seed.spawn(len(spp)), spp.items(), strict=True):
            sample[name] = np.ascontiguousarray(render.radiance(camera, count, int(spp_seed.generate_state(1)[0])))
        yield sample


def _points(perturber: ViewPerturber, points: Points, view_set: ViewSet) -> Points:
    """Return the point cloud of a set: training's in the changed scene, or another draw."""
    if view_set.ladder != DRAWS:
        return (
            perturber.scene.moved_points(points)
            if isinstance(perturber.scene, ChangedScene)
            else perturber.lit_points()
        )
    spec = perturber.render.spec
    return sample_points(perturber.scene, spec.points, spec.seed + view_set.severity)


def read_views(
    directory: AnyPath, spec: DatasetSpec, suites: Suites, view_set: ViewSet, points: Points | None = None
) -> dict[str, Tensor]:
    """Read the views of a set as a batch, with "traced_N" and, in the clean set, "input_N".

    `points` replaces the set's points. A draw has only the fields that differ from the clean views.
    """
    names = list(_DRAWN)
    if view_set.ladder != DRAWS:
        names = [*spec.fields("test"), *(f"traced_{count}" for count in suites.content["traced"])]
    if view_set.suite == CLEAN:
        names += [f"input_{count}" for count in FEWER_SPP]
    reader = ShardReader()
    stored = [reader.read(directory / view_set.name, k, names) for k in range(view_set.views)]
    if view_set.ladder == DRAWS:
        return collate([{name: torch.from_numpy(array) for name, array in view.items()} for view in stored])
    tensors = SampleTensors(spec, {view_set.scene: points or read_points(directory / view_set.points_name)})
    return collate([tensors(view_set.scene, view, k) for k, view in enumerate(stored)])
