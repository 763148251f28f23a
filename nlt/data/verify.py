"""`nlt data verify`: reads every byte of a dataset and says all that is wrong with it."""

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
    """Check a dataset and print what is wrong, a line each: files that are missing, that do not belong there, that
    fail a CRC or are not of the declared form; values that are not finite; images that show nothing; states that
    two splits share. Changes nothing.

    Raises:
        UserError: something is wrong; a summary of what was printed.
    """
    directory = open_path(place)
    spec, there = read_spec(directory), list_files(directory)
    wanted = dataset_files(spec)
    findings = _check_manifest(directory, spec)
    findings += [f"{name}: missing" for name in wanted if name not in there]
    findings += [f"{name}: not part of the dataset" for name in sorted(there - {MANIFEST, *wanted})]
    findings += _check_pilots(directory, spec, there)
    tasks: list[Shard | int] = [k for k in range(len(spec.scenes)) if points_name(k) in there]
    tasks += [shard for shard in spec.shards() if shard.name in there]
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
        f"{MANIFEST}: {key}: is not what its spec and the scenes' files give now"
        for key in ("format", "scenes", "exposure", "shards")
        if manifest.get(key) != now[key]
    ]


def _check_pilots(directory: AnyPath, spec: DatasetSpec, there: set[str]) -> Iterable[str]:
    for scene in range(len(spec.scenes)):
        if spec.has_pilots and pilot_name(scene) in there:
            try:
                read_pilot(directory, scene)
            except UserError as error:
                yield str(error)


@dataclass
class _File:
    """What is wrong with a file, and the states of its samples."""

    name: str
    arrays: dict[str, np.ndarray] = field(default_factory=dict)
    findings: list[str] = field(default_factory=list)
    states: set[bytes] = field(default_factory=set)

    def say(self, name: str, wrong: np.ndarray, what: str) -> None:
        """`wrong` (n,) bool: which samples."""
        if wrong.any():
            self.findings.append(f"{self.name}: {name}: sample {', '.join(map(str, np.flatnonzero(wrong)))}: {what}")


def _check_shard(directory: AnyPath, spec: DatasetSpec, task: Shard | int) -> _File:
    """Of a shard, or of the points of a scene."""
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
    """Names, shapes, dtypes, CRCs, finite values. Whether all fields are there in their form."""
    declared = {name: ((count, *f.resolve(sizes)), f.dtype) for name, f in fields.items()}
    declared |= {CRC + name: ((count,), "uint32") for name in fields}
    found = {name: (array.shape, array.dtype.name) for name, array in file.arrays.items()}
    wrong = [name for name in {**declared, **found} if declared.get(name) != found.get(name)]
    file.findings += [f"{file.name}: {n}: is {found.get(n, 'missing')}, not {declared.get(n, 'there')}" for n in wrong]
    for name in [name for name in fields if name not in wrong and CRC + name not in wrong]:
        array = file.arrays[name]
        sums = np.array([zlib.crc32(row.tobytes()) for row in array], np.uint32)
        file.say(name, sums != file.arrays[CRC + name], "fails its CRC")
        file.say(name, ~np.isfinite(array.reshape(count, -1)).all(1), "not finite")
    return not wrong


def _check_images(file: _File) -> None:
    """A reference shows something, and so do the noisy images of a sample together: one with few samples per pixel
    may miss every light by itself. A camera in the room sees the room."""
    flat = {
        name: (image == image[..., :1, :1]).reshape(len(image), -1).all(1)
        for name, image in file.arrays.items()
        if name in _RADIANCE
    }
    for name in sorted(flat.keys() - {"noisy", "noisy_input"}):
        file.say(name, flat[name], "black or constant")
    file.say("noisy, noisy_input", flat["noisy"] & flat["noisy_input"], "both black or constant")
    depth = file.arrays["depth"]
    file.say("depth", (depth == 0).reshape(len(depth), -1).all(1), "the camera sees no surface")


def _check_splits(spec: DatasetSpec, states: Mapping[tuple[int, str], set[bytes]]) -> Iterable[str]:
    for scene, description in enumerate(spec.descriptions):
        if not description.movables(spec.experiment):
            continue  # nothing moves: there is one state
        for one, other in combinations(SPLITS, 2):
            if shared := states.get((scene, one), set()) & states.get((scene, other), set()):
                yield f"{description.name}: {len(shared)} states are in {one} and in {other}"
