"""One kernel, two ways to run it: vectorised in Mitsuba's JIT variants, in a loop in the scalar one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np


def is_jit() -> bool:
    """Whether the active Mitsuba variant computes on arrays."""
    return bool(dr.is_jit_v(mi.Float))


def owned(values: np.ndarray) -> Any:
    """Flat float32 or uint32 values for a mesh parameter, in memory of Dr.Jit's own.

    With numpy's, Embree was seen to read freed memory under frozen kernels.
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
        kernel: returns a tuple of Mitsuba values; written once for scalars and arrays alike.
        lanes: name -> (Mitsuba type name such as "Point3f", array of shape (n,) or (n, k)).
        fixed: passed to the kernel as they are.

    Returns:
        One array (n,) or (n, k) per value that the kernel returns.
    """
    count = len(next(iter(lanes.values()))[1])
    types = {name: getattr(mi, kind) for name, (kind, _) in lanes.items()}
    if is_jit():
        values = {name: types[name](np.ascontiguousarray(array.T)) for name, (_, array) in lanes.items()}
        # An unevaluated array may be a literal, and literals are compiled into kernels.
        dr.make_opaque(values)
        columns = [np.moveaxis(np.array(out), 0, -1) for out in kernel(**fixed, **values)]
        # A value that is the same for all lanes comes back once.
        return tuple(np.broadcast_to(column, (count, *column.shape[1:])) for column in columns)
    rows = zip(*(array.tolist() for _, array in lanes.values()), strict=True)
    results = [kernel(**fixed, **{n: t(v) for (n, t), v in zip(types.items(), row, strict=True)}) for row in rows]
    return tuple(np.array([np.array(value) for value in column]) for column in zip(*results, strict=True))
