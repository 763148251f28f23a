"""Samples on disk: stacked safetensors shards with a CRC per sample and field, written atomically."""

from __future__ import annotations

import json
import zlib
from collections.abc import Collection
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from nlt.data.files import AnyPath, list_files, local_copy, write_bytes
from nlt.data.sample import POINT_FIELDS
from nlt.data.spec import DatasetSpec
from nlt.errors import UserError

MANIFEST = "manifest.json"
CRC = "crc:"
_OPEN_FILES = 128
Points = dict[str, np.ndarray]  # a scene's point cloud, by field


def write_shard(path: AnyPath, samples: list[dict[str, np.ndarray]]) -> None:
    """Write samples to one file, stacked field by field."""
    arrays = {name: np.stack([sample[name] for sample in samples]) for name in samples[0]}
    write_bytes(path, save(arrays | {CRC + name: checksums(stack) for name, stack in arrays.items()}))


def checksums(stack: np.ndarray) -> np.ndarray:
    """Return the CRC-32 of each sample's bytes in a stack, (n,) uint32."""
    return np.array([zlib.crc32(sample.tobytes()) for sample in stack], np.uint32)


def _open(path: AnyPath) -> dict[str, np.ndarray]:
    with safe_open(local_copy(path), framework="pt") as file:  # copies nothing, unlike "numpy"
        return {name: file.get_tensor(name).numpy() for name in file.keys()}  # noqa: SIM118


class ShardReader:
    """Random access to samples through memory-mapped files. It works in threads and after a fork."""

    def __init__(self) -> None:
        self._open = lru_cache(_OPEN_FILES)(_open)

    def __reduce__(self) -> tuple[type[ShardReader], tuple[()]]:
        return ShardReader, ()

    def read(self, path: AnyPath, row: int, fields: Collection[str]) -> dict[str, np.ndarray]:
        """Return fields of one sample of a shard as views of the mapped file.

        Raise UserError if the shard is missing, truncated, or fails its CRC; a damaged local copy of a remote file is
        first downloaded once more.
        """
        try:
            return self._read(path, row, fields)
        except UserError:
            if isinstance(path, Path):
                raise
        self._open.cache_clear()
        with suppress(FileNotFoundError):  # the next line reports it
            local_copy(path, fresh=True)
        return self._read(path, row, fields)

    def _read(self, path: AnyPath, row: int, fields: Collection[str]) -> dict[str, np.ndarray]:
        advice = "delete the file and run `nlt generate` again"
        try:
            stacks = self._open(path)
            sample = {}
            for name in fields:
                array = stacks[name][row, ...]
                if zlib.crc32(array.data) != stacks[CRC + name][row]:
                    raise UserError(f"{path}: damaged shard: sample {row}, field {name} fails its CRC; {advice}")
                sample[name] = array
            return sample
        except FileNotFoundError:
            raise UserError(f"{path}: missing shard; run `nlt generate` again") from None
        except (SafetensorError, KeyError) as error:
            raise UserError(f"{path}: damaged shard ({error}); {advice}") from None


def read_points(path: AnyPath) -> Points:
    """Return the point cloud of a scene, with all `POINT_FIELDS`."""
    return ShardReader().read(path, 0, POINT_FIELDS)


def points_name(scene: int) -> str:
    """Return the name of the file with a scene's points, relative to the dataset's directory."""
    return f"points-{scene:03d}.safetensors"


def pilot_name(scene: int) -> str:
    """Return the name of the file with a scene's pilot result, relative to the dataset's directory."""
    return f"pilot-{scene:03d}.json"


def read_pilot(directory: AnyPath, scene: int) -> dict[str, Any]:
    """Return a scene's pilot result: `spp`, and the `predicted_mse` between the reference's halves.

    Raise UserError if the file is missing or damaged.
    """
    path = directory / pilot_name(scene)
    try:
        content = json.loads(path.read_text())
        return {"spp": int(content["spp"]), "predicted_mse": float(content["predicted_mse"])}
    except FileNotFoundError:
        raise UserError(f"{path}: missing; run `nlt generate` again") from None
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path}: damaged ({error}); delete the file and run `nlt generate` again") from None


def references(directory: AnyPath, spec: DatasetSpec) -> list[dict[str, Any]]:
    """Return, by scene, the samples per pixel `spp` of each reference half; with pilot views, also `predicted_mse`."""
    scenes = range(len(spec.scenes))
    return [read_pilot(directory, k) if spec.has_pilots else {"spp": spec.reference_spp} for k in scenes]


def write_manifest(directory: AnyPath, spec: DatasetSpec, variant: str) -> None:
    """Write the dataset's content and the Mitsuba variant; equal arguments write equal bytes."""
    write_bytes(directory / MANIFEST, json.dumps(spec.manifest | {"variant": variant}, indent=1).encode())


def dataset_files(spec: DatasetSpec) -> list[str]:
    """Return the names of all pilot results, point clouds and shards of a dataset, relative to its directory."""
    scenes = range(len(spec.scenes))
    pilots = [pilot_name(k) for k in scenes] if spec.has_pilots else []
    return pilots + [points_name(k) for k in scenes] + [shard.name for shard in spec.shards()]


def missing_files(directory: AnyPath, spec: DatasetSpec) -> list[str]:
    """Return those of `dataset_files` that do not exist yet."""
    existing = list_files(directory)
    return [name for name in dataset_files(spec) if name not in existing]


def read_manifest(directory: AnyPath) -> dict[str, Any]:
    """Return the content of a dataset's manifest; raise UserError if it is missing or damaged."""
    path = directory / MANIFEST
    advice = "run `nlt generate` with the same --config files"
    try:
        return dict(json.loads(path.read_text()))
    except (FileNotFoundError, NotADirectoryError):
        raise UserError(f"{directory}: no dataset here; {advice}, which prints the directory that it fills") from None
    except (ValueError, TypeError) as error:
        raise UserError(f"{path}: damaged manifest ({error}); delete it and {advice}") from None


def read_spec(directory: AnyPath) -> DatasetSpec:
    """Return the spec in a dataset's manifest; raise UserError if this version cannot read it."""
    try:
        return DatasetSpec(**read_manifest(directory)["spec"])
    except (KeyError, TypeError) as error:
        raise UserError(f"{directory / MANIFEST}: spec: not of this version ({error}); generate it again") from None


def check_dataset(directory: AnyPath, spec: DatasetSpec) -> None:
    """Raise UserError if a directory does not hold the complete dataset of `spec`."""
    manifest, advice = read_manifest(directory), "run `nlt generate` with the same --config files"
    for key, value in spec.manifest.items():
        if key != "nlt" and manifest.get(key) != value:
            place = directory / MANIFEST
            raise UserError(f"{place}: {key}: does not match the config; delete {directory} and {advice}")
    missing = missing_files(directory, spec)
    if missing:
        raise UserError(f"{directory}: incomplete, {len(missing)} files missing, such as {missing[0]}; {advice}")
