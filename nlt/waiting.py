"""The wait policy of PyTorch's OpenMP threads. OpenMP reads it once, so it must be set before torch is imported.

While a frame is rendered, Mitsuba's and PyTorch's threads alternate on the same cores, and a thread that spins while it
waits slows down the others: with the passive policy, a frame at 64x64 takes two thirds of the time. A training run does
not share its cores and is faster with spinning threads (docs/performance.md).
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager

WAIT_POLICY = "OMP_WAIT_POLICY"
_ours = False  # whether `wait_passively` set the policy


def wait_passively() -> None:
    """Set the passive policy for this process, unless the user's environment already sets a policy."""
    global _ours
    if WAIT_POLICY not in os.environ:
        os.environ[WAIT_POLICY], _ours = "passive", True


@contextmanager
def as_the_user_said() -> Iterator[None]:
    """Prevent processes started in this context from inheriting the policy that `wait_passively` set."""
    policy = os.environ.pop(WAIT_POLICY, None) if _ours else None
    try:
        yield
    finally:
        if policy is not None:
            os.environ[WAIT_POLICY] = policy
