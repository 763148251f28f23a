"""`nlt data verify`: reads every byte of a dataset and reports everything that is wrong with it."""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import combinations

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load
from tqdm import tqdm

from nlt.data.engines import available_cpus
from nlt.data.files import AnyPath, list_files, open_path
from nlt.data.sample import POINT_FIELDS, SPLITS, Field
from nlt.data.spec import DatasetSpec, Shard
from nlt.data.store import (
    CRC,
    MANIFEST,
    checksums,
    dataset_files,
    pilot_name,
    points_name,
    read_manifest,
    read_pilot,
    read_spec,
)
from nlt.errors import UserError
from nlt.scenes.state import SceneState


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
    findings = list(_check_manifest(directory, spec, existing))
    findings += [f"{name}: missing" for name in expected if name not in existing]
    findings += [f"{name}: not part of the dataset" for name in sorted(existing - {MANIFEST, *expected})]
    files = [_File(points_name(k), POINT_FIELDS, 1) for k in range(len(spec.scenes))]
    files += [_File(shard.name, spec.fields(shard.split), shard.size, shard) for shard in spec.shards()]
    files = [file for file in files if file.name in existing]
    states: dict[tuple[int, str], set[bytes]] = defaultdict(set)
    with ThreadPoolExecutor(available_cpus()) as pool:
        checks = pool.map(partial(_check_file, directory, spec), files)
        for file, (problems, keys) in zip(files, tqdm(checks, "verifying", len(files), unit="file"), strict=True):
            findings += [f"{file.name}: {problem}" for problem in problems]
            if file.shard:
                states[file.shard.scene, file.shard.split] |= keys
    findings += _check_splits(spec, states)
    print(*findings, f"{directory}: {len(files)} files read, {len(findings)} findings", sep="\n", flush=True)
    if findings:
        raise UserError(f"{directory}: {len(findings)} findings; delete the files named and run `nlt generate` again")


def _check_manifest(directory: AnyPath, spec: DatasetSpec, existing: set[str]) -> Iterable[str]:
    """Check the manifest and the pilot results that exist."""
    manifest, now = read_manifest(directory), spec.manifest
    for key in ("format", "scenes", "exposure", "shards"):
        if manifest.get(key) != now[key]:
            yield f"{MANIFEST}: {key}: does not match the spec and the current scene files"
    for scene in range(len(spec.scenes)):
        if spec.has_pilots and pilot_name(scene) in existing:
            try:
                read_pilot(directory, scene)
            except UserError as error:
                yield str(error)


@dataclass(frozen=True)
class _File:
    """A file of points or samples and what it should hold."""

    name: str
    fields: Mapping[str, Field]
    count: int  # of samples
    shard: Shard | None = None


def _check_file(directory: AnyPath, spec: DatasetSpec, file: _File) -> tuple[list[str], set[bytes]]:
    """Read a file and return its problems and the states of its samples."""
    try:
        arrays = load((directory / file.name).read_bytes())
    except (OSError, SafetensorError) as error:
        return [f"cannot be read: {error}"], set()
    sizes = spec.sizes(file.shard.split if file.shard else "test")
    declared = {name: ((file.count, *f.resolve(sizes)), f.dtype) for name, f in file.fields.items()}
    declared |= {CRC + name: ((file.count,), "uint32") for name in file.fields}
    actual = {name: (array.shape, array.dtype.name) for name, array in arrays.items()}
    wrong = [name for name in {**declared, **actual} if declared.get(name) != actual.get(name)]
    problems = [f"{name}: is {actual.get(name, 'missing')}, not {declared.get(name, 'declared')}" for name in wrong]
    masks = []  # name, which of the samples (n,) are wrong, and why
    for name in [name for name in file.fields if name not in wrong and CRC + name not in wrong]:
        masks.append((name, checksums(arrays[name]) != arrays[CRC + name], "fails its CRC"))
        masks.append((name, ~np.isfinite(arrays[name].reshape(file.count, -1)).all(1), "not finite"))
    keys: set[bytes] = set()
    if file.shard and not wrong:
        if sizes == spec.sizes("test"):  # a crop may show nothing but sky
            masks += _check_images(arrays)
        rows = zip(arrays["translation"], arrays["present"], strict=True)
        keys = {SceneState(moved, present).key for moved, present in rows}
    problems += [
        f"{name}: sample {', '.join(map(str, np.flatnonzero(mask)))}: {why}" for name, mask, why in masks if mask.any()
    ]
    return problems, keys


def _check_images(arrays: Mapping[str, np.ndarray]) -> Iterator[tuple[str, np.ndarray, str]]:
    """Check that the images are not black or constant and that the camera sees a surface.

    With few samples per pixel, one noisy image may miss every light, so a sample fails only if both of its noisy images
    do.
    """
    constant = {name: (array == array[..., :1, :1]).all((1, 2, 3)) for name, array in arrays.items() if array.ndim == 4}
    yield from (
        (name, constant[name], "black or constant") for name in ("reference_a", "reference_b") if name in arrays
    )
    yield "noisy, noisy_input", constant["noisy"] & constant["noisy_input"], "both black or constant"
    yield "depth", (arrays["depth"] == 0).all((1, 2, 3)), "the camera sees no surface"


def _check_splits(spec: DatasetSpec, states: Mapping[tuple[int, str], set[bytes]]) -> Iterable[str]:
    for scene, description in enumerate(spec.descriptions):
        if not description.movables(spec.experiment):
            continue  # without movable objects there is only one state
        for first, second in combinations(SPLITS, 2):
            if shared := states[scene, first] & states[scene, second]:
                yield f"{description.name}: {len(shared)} states are in {first} and in {second}"
