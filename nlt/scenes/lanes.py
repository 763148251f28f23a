"""Run one kernel in any variant: vectorised in Mitsuba's JIT variants, in a Python loop in the scalar variant."""

import logging
from collections.abc import Callable, Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

log = logging.getLogger(__name__)


def is_jit() -> bool:
    """Return whether the active Mitsuba variant computes on arrays."""
    return bool(dr.is_jit_v(mi.Float))


def freeze(kernel: Callable) -> Callable:
    """Wrap a kernel so that Dr.Jit traces it only once: 6 ms instead of 300 ms for a 64x64 image at 1 spp.

    A kernel that Dr.Jit cannot freeze is traced at every call, with a warning. This happens with lights of textured
    radiance, because Mitsuba samples them by tracing rays in a separate scene of their texture coordinates.
    """
    if not is_jit():
        return kernel
    run = dr.freeze(kernel)

    def call(**values: Any) -> Any:
        nonlocal run
        if run is not kernel:
            try:
                return run(**values)
            except RuntimeError as error:
                if "record()" not in str(error):
                    raise
                run = kernel
                log.warning("rendering is slow: Dr.Jit cannot freeze %s (%s)", kernel.__name__, error.__cause__)
        return kernel(**values)

    return call


def owned(values: np.ndarray) -> Any:
    """Return values for a mesh parameter, flat, as float32 or uint32, in memory that Dr.Jit owns.

    With memory owned by numpy, Embree read freed memory under frozen kernels.
    """
    if not is_jit():
        return values.ravel().tolist()
    kind = mi.Float if values.dtype.kind == "f" else mi.UInt32
    array: Any = kind(values.ravel()) + dr.opaque(kind, 0)  # type: ignore[operator]
    dr.eval(array)
    return array


def launch(kernel: Callable, lanes: Mapping[str, tuple[str, np.ndarray]], **fixed: Any) -> tuple[np.ndarray, ...]:
    """Run `kernel(**fixed, **lanes)` over all lanes.

    Args:
        kernel: returns a tuple of Mitsuba values; it must work on scalars and on arrays.
        lanes: name -> (name of a Mitsuba type, for example "Point3f"; array of shape (n,) or (n, k)).
        fixed: passed to the kernel unchanged.

    Returns:
        One array (n,) or (n, k) per value that the kernel returns; each of the k columns is contiguous in memory.
    """
    count = len(next(iter(lanes.values()))[1])
    types = {name: getattr(mi, kind) for name, (kind, _) in lanes.items()}
    if is_jit():
        values = {name: _upload(types[name], array) for name, (_, array) in lanes.items()}
        # An unevaluated array may be a literal, and literals are compiled into kernels.
        dr.make_opaque(values)
        results = kernel(**fixed, **values)
        dr.eval(results)
        return tuple(_download(result, count) for result in results)
    rows = zip(*(array.tolist() for _, array in lanes.values()), strict=True)
    results = [kernel(**fixed, **{n: t(v) for (n, t), v in zip(types.items(), row, strict=True)}) for row in rows]
    return tuple(np.array([np.array(value) for value in column]) for column in zip(*results, strict=True))


# Arrays are converted by component: Dr.Jit's conversions of whole vectors compile a kernel for every number of lanes.


def _upload(kind: Any, array: np.ndarray) -> Any:
    columns = np.ascontiguousarray(array.T, np.float32)
    return owned(columns) if array.ndim == 1 else kind(*map(owned, columns))


def _download(value: Any, count: int) -> np.ndarray:
    if dr.depth_v(value) > 1:
        return np.stack([_download(component, count) for component in value]).T
    # A value that is the same for all lanes has a width of one.
    return np.broadcast_to(np.array(value), count)
