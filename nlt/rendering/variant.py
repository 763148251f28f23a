"""Choose the Mitsuba variant: cuda, else llvm, else scalar. Each is tried once, in a separate process."""

import ctypes.util
import functools
import glob
import logging
import os
import re
import subprocess
import sys
from typing import NamedTuple

from nlt.errors import UserError

log = logging.getLogger(__name__)

VARIANTS = ("cuda_ad_rgb", "llvm_ad_rgb", "scalar_rgb")
_PROBE = "import mitsuba as mi; mi.set_variant({!r}); import drjit as dr; print(dr.sum(mi.Float([1, 2])))"
_TIMEOUT_S = 300  # of a probe, which takes a second; on an overloaded machine, a minute was not enough
_LIBRARY = "DRJIT_LIBLLVM_PATH"
_LIBRARIES = (
    "/usr/lib/*/libLLVM*.so*", "/usr/lib/llvm-*/lib/libLLVM*.so*", "/usr/lib64/libLLVM*.so*",
    "/opt/homebrew/opt/llvm/lib/libLLVM*.dylib",
)  # fmt: skip


class Variant(NamedTuple):
    """The chosen variant, with the reason in one line."""

    name: str
    reason: str


@functools.cache
def use_variant() -> Variant:
    """Choose, activate and log a Mitsuba variant. `NLT_VARIANT` names a variant to use without probing."""
    import drjit as dr  # here, because importing Dr.Jit initialises CUDA, and then a process can no longer be forked
    import mitsuba as mi

    variant = choose_variant()
    mi.set_variant(variant.name)
    dr.set_thread_count(max(2, dr.thread_count()))  # with one thread on one core, loading some scenes hangs
    # Mitsuba's warnings concern cases that nlt handles itself; errors still raise exceptions.
    mi.set_log_level(mi.LogLevel.Error)
    log.info("Mitsuba variant %s: %s", variant.name, variant.reason)
    return variant


@functools.cache
def choose_variant() -> Variant:
    """Return the first variant that works. Subprocesses try, because a wrong LLVM aborts the process that loads it.

    Raises:
        UserError: `NLT_VARIANT` names no variant.
    """
    if name := os.environ.get("NLT_VARIANT"):
        if name not in VARIANTS:
            raise UserError(f"NLT_VARIANT: must be one of {', '.join(VARIANTS)} or unset, is {name!r}")
        if name.startswith("llvm") and (library := next(iter(_llvm_libraries()), None)):
            os.environ[_LIBRARY] = library
        return Variant(name, "set by NLT_VARIANT")
    failed: list[str] = []
    for name in VARIANTS[:-1]:
        for library in _llvm_libraries() if name.startswith("llvm") else [None]:
            if _works(name, library):
                os.environ["NLT_VARIANT"] = name  # worker processes inherit this choice and do not probe again
                if library:
                    os.environ[_LIBRARY] = library
                works = f"works with {library}" if library else "works"
                return Variant(name, f"{works}; {', '.join(failed) or 'first choice'}")
        failed.append(f"{name} does not work here")
    os.environ["NLT_VARIANT"] = VARIANTS[-1]
    return Variant(VARIANTS[-1], "; ".join(failed))


def _llvm_libraries() -> list[str | None]:
    """Return candidate libraries, the newest first; None stands for Dr.Jit's own search."""
    if _LIBRARY in os.environ:
        return [None]
    newest: dict[int, str] = {}  # by version
    for path in sorted(path for pattern in _LIBRARIES for path in glob.glob(pattern)):
        first_numbers = re.findall(r"\d+", os.path.basename(path))[:1] + re.findall(r"\d+", path)[:1]
        newest[max(map(int, first_numbers), default=0)] = path
    paths: list[str | None] = [newest[version] for version in sorted(newest, reverse=True) if version >= 16]
    return paths or ([None] if ctypes.util.find_library("LLVM") else [])


def _works(variant: str, library: str | None) -> bool:
    environment = dict(os.environ, **({_LIBRARY: library} if library else {}))
    probe = [sys.executable, "-c", _PROBE.format(variant)]
    try:
        return (
            subprocess.run(probe, env=environment, capture_output=True, timeout=_TIMEOUT_S, check=False).returncode == 0
        )
    except subprocess.TimeoutExpired:
        return False
