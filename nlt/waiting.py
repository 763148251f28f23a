"""How PyTorch's threads wait for one another. OpenMP reads it once, so it is set before torch is imported.

In a frame Mitsuba's threads and PyTorch's take turns on the same cores, and there whoever spins while waiting keeps the
others from their work: passively, a frame at 64x64 takes two thirds of the time. A training is alone on its cores, and
faster if it spins (docs/performance.md).
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

WAIT_POLICY = "OMP_WAIT_POLICY"
_ours = False


def wait_passively() -> None:
    """For this process, unless the user's environment says otherwise."""
    global _ours
    if WAIT_POLICY not in os.environ:
        os.environ[WAIT_POLICY], _ours = "passive", True


@contextmanager
def as_the_user_said() -> Iterator[None]:
    """Processes that are started within do not inherit what `wait_passively` set."""
    kept = os.environ.pop(WAIT_POLICY, None) if _ours else None
    try:
        yield
    finally:
        if kept is not None:
            os.environ[WAIT_POLICY] = kept
