"""`nlt data verify`: reads every byte of a dataset and reports everything that is wrong with it."""

from __future__ import annotations

import sys
import zlib
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load
from tqdm import tqdm

from nlt.data.engines import available_cpus
from nlt.data.files import AnyPath, list_files, open_path
from nlt.data.sample import POINT_FIELDS, SPLITS, Field
from nlt.data.spec import DatasetSpec, Shard
from nlt.data.store import CRC, MANIFEST, dataset_files, pilot_name, points_name, read_manifest, read_pilot, read_spec
from nlt.errors import UserError
from nlt.scenes.state import SceneState

_RADIANCE = ("noisy", "noisy_input", "reference_a", "reference_b")


def verify(place: str) -> None:
    """Check a dataset and print one line per finding; nothing is changed.

    Findings are missing and unexpected files, CRC failures, wrong field names, shapes or dtypes, values that are not
    finite, black or constant images, and states that two splits share.

    Raises:
        UserError: there is no dataset, or there are findings; the message gives their number.
    """
    directory = open_path(place)
    spec, existing = read_spec(directory), list_files(directory)
    expected = dataset_files(spec)
    findings = _check_manifest(directory, spec)
    findings += [f"{name}: missing" for name in expected if name not in existing]
    findings += [f"{name}: not part of the dataset" for name in sorted(existing - {MANIFEST, *expected})]
    findings += _check_pilots(directory, spec, existing)
    tasks: list[Shard | int] = [k for k in range(len(spec.scenes)) if points_name(k) in existing]
    tasks += [shard for shard in spec.shards() if shard.name in existing]
    states: dict[tuple[int, str], set[bytes]] = {}
    with ThreadPoolExecutor(available_cpus()) as pool:
        check = lambda task: _check_shard(directory, spec, task)
        for task, file in zip(tasks, tqdm(pool.map(check, tasks), "verifying", len(tasks), unit="file"), strict=True):
            findings += file.findings
            if isinstance(task, Shard):
                states.setdefault((task.scene, task.split), set()).update(file.states)
    findings += _check_splits(spec, states)
    print(*findings, f"{directory}: {len(tasks)} files read, {len(findings)} findings", sep="\n")
    sys.stdout.flush()
    if findings:
        raise UserError(f"{directory}: {len(findings)} findings; delete the files named and run `nlt generate` again")


def _check_manifest(directory: AnyPath, spec: DatasetSpec) -> list[str]:
    manifest, now = read_manifest(directory), spec.manifest
    return [
        f"{MANIFEST}: {key}: does not match the spec and the current scene files"
        for key in ("format", "scenes", "exposure", "shards")
        if manifest.get(key) != now[key]
    ]


def _check_pilots(directory: AnyPath, spec: DatasetSpec, existing: set[str]) -> Iterable[str]:
    for scene in range(len(spec.scenes)):
        if spec.has_pilots and pilot_name(scene) in existing:
            try:
                read_pilot(directory, scene)
            except UserError as error:
                yield str(error)


@dataclass
class _File:
    """A file's arrays and findings, and the states of its samples."""

    name: str
    arrays: dict[str, np.ndarray] = field(default_factory=dict)
    findings: list[str] = field(default_factory=list)
    states: set[bytes] = field(default_factory=set)

    def report(self, name: str, wrong: np.ndarray, problem: str) -> None:
        """Add a finding about the samples that the mask `wrong` (n,) selects."""
        if wrong.any():
            self.findings.append(f"{self.name}: {name}: sample {', '.join(map(str, np.flatnonzero(wrong)))}: {problem}")


def _check_shard(directory: AnyPath, spec: DatasetSpec, task: Shard | int) -> _File:
    """Check a shard or, if `task` is a scene's index, that scene's points."""
    points = isinstance(task, int)
    file = _File(points_name(task) if isinstance(task, int) else task.name)
    try:
        file.arrays = load((directory / file.name).read_bytes())
    except (OSError, SafetensorError) as error:
        file.findings.append(f"{file.name}: cannot be read: {error}")
        return file
    count = 1 if isinstance(task, int) else task.stop - task.start
    fields = POINT_FIELDS if isinstance(task, int) else spec.fields(task.split)
    if _check_form(file, fields, count, spec.sizes) and not points:
        _check_images(file)
        rows = zip(file.arrays["translation"], file.arrays["present"], strict=True)
        file.states = {SceneState(moved, present).key for moved, present in rows}
    return file


def _check_form(file: _File, fields: Mapping[str, Field], count: int, sizes: dict[str, int]) -> bool:
    """Check names, shapes, dtypes, CRCs and finite values; return whether every array has its declared form."""
    declared = {name: ((count, *f.resolve(sizes)), f.dtype) for name, f in fields.items()}
    declared |= {CRC + name: ((count,), "uint32") for name in fields}
    actual = {name: (array.shape, array.dtype.name) for name, array in file.arrays.items()}
    wrong = [name for name in {**declared, **actual} if declared.get(name) != actual.get(name)]
    file.findings += [
        f"{file.name}: {name}: is {actual.get(name, 'missing')}, not {declared.get(name, 'declared')}" for name in wrong
    ]
    for name in [name for name in fields if name not in wrong and CRC + name not in wrong]:
        array = file.arrays[name]
        sums = np.array([zlib.crc32(row.tobytes()) for row in array], np.uint32)
        file.report(name, sums != file.arrays[CRC + name], "fails its CRC")
        file.report(name, ~np.isfinite(array.reshape(count, -1)).all(1), "not finite")
    return not wrong


def _check_images(file: _File) -> None:
    """Check that the images are not black or constant and that the camera sees a surface.

    With few samples per pixel, one noisy image may miss every light, so a sample fails only if both of its noisy images
    do.
    """
    flat = {
        name: (image == image[..., :1, :1]).reshape(len(image), -1).all(1)
        for name, image in file.arrays.items()
        if name in _RADIANCE
    }
    for name in sorted(flat.keys() - {"noisy", "noisy_input"}):
        file.report(name, flat[name], "black or constant")
    file.report("noisy, noisy_input", flat["noisy"] & flat["noisy_input"], "both black or constant")
    depth = file.arrays["depth"]
    file.report("depth", (depth == 0).reshape(len(depth), -1).all(1), "the camera sees no surface")


def _check_splits(spec: DatasetSpec, states: Mapping[tuple[int, str], set[bytes]]) -> Iterable[str]:
    for scene, description in enumerate(spec.descriptions):
        if not description.movables(spec.experiment):
            continue  # without movable objects there is only one state
        for first, second in combinations(SPLITS, 2):
            if shared := states.get((scene, first), set()) & states.get((scene, second), set()):
                yield f"{description.name}: {len(shared)} states are in {first} and in {second}"
