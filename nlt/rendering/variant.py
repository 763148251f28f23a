"""Which Mitsuba variant renders: cuda, else llvm, else scalar, each tried once in a process of its own."""

from __future__ import annotations

import ctypes.util
import functools
import glob
import logging
import os
import subprocess
import sys
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from nlt.errors import UserError

log = logging.getLogger(__name__)

VARIANTS = ("cuda_ad_rgb", "llvm_ad_rgb", "scalar_rgb")
_PROBE = "import mitsuba as mi; mi.set_variant({!r}); import drjit as dr; print(dr.sum(mi.Float([1, 2])))"
_LIBRARY = "DRJIT_LIBLLVM_PATH"


@dataclass(frozen=True)
class Variant:
    """The variant chosen, and why in one line."""

    name: str
    reason: str


@functools.cache
def use_variant() -> Variant:
    """Choose, activate and log a Mitsuba variant; `NLT_VARIANT` names one to use without probing."""
    variant = choose_variant()
    mi.set_variant(variant.name)
    dr.set_thread_count(max(2, dr.thread_count()))  # with one, on one core, loading some scenes waits for ever
    # Quiet about what we handle ourselves; errors still come as exceptions.
    mi.set_log_level(mi.LogLevel.Error)
    log.info("Mitsuba variant %s: %s", variant.name, variant.reason)
    return variant


@functools.cache
def choose_variant() -> Variant:
    """The first variant that works. A wrong LLVM aborts the process that loads it, so subprocesses try."""
    if "NLT_VARIANT" in os.environ:
        name = os.environ["NLT_VARIANT"]
        if name not in VARIANTS:
            raise UserError(f"NLT_VARIANT: must be one of {', '.join(VARIANTS)} or unset, is {name!r}")
        if name.startswith("llvm") and (library := next(iter(_llvm_libraries()), None)):
            os.environ[_LIBRARY] = library
        return Variant(name, "set by NLT_VARIANT")
    failed: list[str] = []
    for name in VARIANTS[:-1]:
        for library in _llvm_libraries() if name.startswith("llvm") else [None]:
            if _works(name, library):
                if library:
                    os.environ[_LIBRARY] = library
                why = f"works{f' with {library}' if library else ''}; {', '.join(failed) or 'first choice'}"
                return _chosen(name, why)
        failed.append(f"{name} does not work here")
    return _chosen(VARIANTS[-1], "; ".join(failed))


def _chosen(name: str, reason: str) -> Variant:
    # Worker processes inherit the choice and do not probe again.
    os.environ["NLT_VARIANT"] = name
    return Variant(name, reason)


def _llvm_libraries() -> list[str | None]:
    """Candidates, the newest first; None is Dr.Jit's own search."""
    if _LIBRARY in os.environ:
        return [None]
    found = {
        path
        for pattern in ("/usr/lib/*/libLLVM*.so*", "/usr/lib/llvm-*/lib/libLLVM*.so*", "/usr/lib64/libLLVM*.so*",
                        "/opt/homebrew/opt/llvm/lib/libLLVM*.dylib")
        for path in glob.glob(pattern)
    }  # fmt: skip
    version = lambda path: max((int(d) for d in _digits(os.path.basename(path)) + _digits(path)), default=0)
    newest = {version(path): path for path in sorted(found)}
    paths: list[str | None] = [newest[v] for v in sorted(newest, reverse=True) if v >= 16]
    return paths or ([None] if ctypes.util.find_library("LLVM") else [])


def _digits(text: str) -> list[str]:
    return "".join(c if c.isdigit() else " " for c in text).split()[:1]


def _works(variant: str, library: str | None) -> bool:
    environment = dict(os.environ, **({_LIBRARY: library} if library else {}))
    probe = [sys.executable, "-c", _PROBE.format(variant)]
    try:
        done = subprocess.run(probe, env=environment, capture_output=True, timeout=60, check=False)
    except subprocess.TimeoutExpired:
        return False
    return done.returncode == 0
