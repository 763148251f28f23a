"""Rendering of the stress suites of a dataset, in a file per ladder, severity and scene."""

import os
import sys
import zlib
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from tqdm import tqdm

from nlt.data.dataset import SampleTensors
from nlt.data.engines import Local, available_cpus
from nlt.data.files import AnyPath, list_files, open_path
from nlt.data.render import SampleRenderer
from nlt.data.sample import TRACED
from nlt.data.spec import DatasetSpec
from nlt.data.store import points_name, read_points, write_shard
from nlt.errors import UserError
from nlt.rendering.variant import choose_variant
from nlt.scenes.assembly import Scene
from nlt.scenes.camera import Camera
from nlt.scenes.pointcloud import sample_points
from nlt.stress.changed_scene import MESHES, ChangedScene
from nlt.stress.perturber import ViewPerturber, lacks, path
from nlt.stress.suites import CLEAN, FLICKER, PATHS, RENDERED, Suites

DRAWS = "draws"
_FEWER_SPP = (1, 2, 3)  # samples per input pixel that the clean views are also rendered at
_DRAWN = (*TRACED, "photon_origin", "photon_direction", "photon_flux", "photon_hit", "photon_valid")


@dataclass(frozen=True)
class ViewSet:
    """A file of views: one ladder of a suite at one severity, in one scene."""

    scene: int
    suite: str
    ladder: str
    severity: int
    views: int
    change: str | None = None
    value: float = 0.0  # of the change; for a path, its length

    @property
    def name(self) -> str:
        return f"{self.scene:03d}/{self.suite}-{self.ladder}-{self.severity}.safetensors"

    @property
    def points_name(self) -> str:
        return self.name.replace(".safetensors", ".points.safetensors")

    @property
    def is_path(self) -> bool:
        return self.suite == FLICKER and self.ladder in PATHS

    def fields(self, spec: DatasetSpec) -> list[str]:
        """Return the stored fields of `nlt.data.sample`; a draw has only those that differ from the clean views."""
        return [*_DRAWN] if self.ladder == DRAWS else [*spec.fields("test")]

    def path_traced(self, suites: Suites) -> dict[str, int]:
        """Return the samples per pixel of the other stored images: "traced_N" and, in the clean set, "input_N"."""
        traced = () if self.ladder == DRAWS else suites.traced
        fewer = _FEWER_SPP if self.suite == CLEAN else ()
        return {f"traced_{spp}": spp for spp in traced} | {f"input_{spp}": spp for spp in fewer}


def view_sets(spec: DatasetSpec, suites: Suites, wanted: list[str]) -> list[ViewSet]:
    """Return everything to render for the suites `wanted`, always with the clean views."""
    flicker, sets = suites.flicker, []
    views = min(suites.views, spec.test)
    for scene in range(len(spec.scenes)):
        sets.append(ViewSet(scene, CLEAN, "views", 0, views))
        for (suite, name), ladder in suites.ladders.items():
            if suite in RENDERED and suite in wanted and not lacks(spec, scene, ladder.change):
                sets += [
                    ViewSet(scene, suite, name, severity, views, ladder.change, value)
                    for severity, value in enumerate(ladder.values, 1)
                ]
        if FLICKER in wanted:
            sets += [ViewSet(scene, FLICKER, DRAWS, k + 1, views) for k in range(flicker.draws)]
            needs = {"camera": "", "light": "light_lowered", "object": "object_outside"}
            sets += [
                ViewSet(scene, FLICKER, moving, 0, flicker.frames, value=getattr(flicker, moving))
                for moving in PATHS
                if not lacks(spec, scene, needs[moving])
            ]
    return sets


def render_suites(spec: DatasetSpec, dataset: AnyPath, suites: Suites, sets: list[ViewSet], directory: AnyPath) -> None:
    """Render the missing view sets into a directory.

    Raises:
        UserError: a scene is wrong, or a worker failed twice.
    """
    existing = list_files(directory) if directory.exists() else set()
    missing = [view_set for view_set in sets if view_set.name not in existing]
    if not missing:
        return
    # Each job is a process. A changed scene has one of its own, because Mitsuba does not release the scene before it.
    # The other view sets of a scene share some, because loading a scene costs as much as a few views.
    jobs, cpus = list[tuple[ViewSet, ...]](), available_cpus()
    for scene in range(len(spec.scenes)):
        plain = [view_set for view_set in missing if view_set.scene == scene and view_set.change not in MESHES]
        jobs += [tuple(plain[k::cpus]) for k in range(min(cpus, len(plain)))]
    jobs += [(view_set,) for view_set in missing if view_set.change in MESHES]
    total, failures = sum(view_set.views for view_set in missing), dict[tuple[ViewSet, ...], str]()
    print(f"{directory}: {total} views of {len(missing)} sets to render", flush=True)
    work = partial(_render, spec, suites, str(dataset), str(directory), choose_variant().name)
    engine = Local(cpus, preload=(SampleTensors.__module__,))
    with (
        tqdm(total=total, unit="view", desc="rendering", file=sys.stderr, mininterval=1.0) as bar,
        closing(engine.run(work, jobs, failures)) as ticks,
    ):
        for ticked in ticks:
            bar.update((ticked or 0) - bar.n)
    for job, reason in failures.items():
        raise UserError(f"{directory / job[0].name}: the worker that rendered it died twice ({reason})")


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
    """Render the view sets of a job in its own process."""
    os.environ["NLT_VARIANT"] = variant
    directory, first = open_path(place), job[0]
    points = read_points(open_path(dataset) / points_name(first.scene))
    build: Callable[..., Scene] = Scene
    if first.change in MESHES:
        build = partial(ChangedScene, change=first.change, value=first.value, points=points, seed=suites.seed)
    render = SampleRenderer(replace(spec, reference_spp=suites.reference), first.scene, threads, build)
    perturber = ViewPerturber(render, points, suites.seed)
    for view_set in job:
        ladder = zlib.crc32(f"{view_set.suite}/{view_set.ladder}".encode())
        seeds = np.random.SeedSequence([suites.seed, view_set.scene, ladder, view_set.severity]).spawn(view_set.views)
        cameras: Iterator[Camera] = (perturber.place(k, view_set.change, view_set.value) for k in range(view_set.views))
        if view_set.is_path:
            cameras = path(perturber, view_set.ladder, view_set.value, view_set.views)
        samples, images = [], view_set.path_traced(suites)
        for camera, seed in zip(cameras, seeds, strict=True):
            sample = render.view(camera, seed, view_set.fields(render.spec))
            for image_seed, (name, spp) in zip(seed.spawn(len(images)), images.items(), strict=True):
                radiance = render.radiance(camera, spp, int(image_seed.generate_state(1)[0]))
                sample[name] = np.ascontiguousarray(radiance)
            samples.append(sample)
            tick(1)
        if view_set.ladder == DRAWS:
            cloud = sample_points(render.scene, spec.num_points, spec.seed + view_set.severity)
        elif isinstance(render.scene, ChangedScene):
            cloud = render.scene.moved_points()
        else:
            cloud = perturber.lit_points()
        write_shard(directory / view_set.points_name, [cloud])
        write_shard(directory / view_set.name, samples)
