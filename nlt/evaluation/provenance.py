"""The provenance of results: command, commit, device, versions."""

import importlib.metadata
import os
import platform
import shlex
import subprocess
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from nlt.metrics.inception import find_weights
from nlt.models.policy import Policy
from nlt.paths import PROJECT
from nlt.rendering.variant import choose_variant
from nlt.waiting import WAIT_POLICY

_PACKAGES = (
    "nlt", "torch", "lightning", "torchmetrics", "mitsuba", "drjit", "numpy", "safetensors", "flip-evaluator",
    "mitsuba-oidn",
)  # fmt: skip

_CODE = ("nlt", "configs", "scripts", "benchmarks", "pyproject.toml")  # files that determine results


def origin() -> dict[str, Any]:
    """Return command, commit and time; call it at the start, because the checkout may change during the run."""
    is_script = Path(sys.argv[0]).parent.name in ("benchmarks", "scripts")
    return {
        "command": shlex.join(["python", *sys.argv] if is_script else ["nlt", *sys.argv[1:]]),
        "commit": _git("rev-parse", "HEAD"),
        "uncommitted_changes": bool(_git("status", "--porcelain", "--", *_CODE)),  # including untracked files
        "started": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }


def surroundings(device: torch.device, policy: Policy | None = None) -> dict[str, Any]:
    """Return what else determines a result: device, versions, clock settings, policy."""
    from nlt.evaluation.clock import FRAMES, WARM_UP  # here, because it imports Mitsuba (see `trainings.train`)

    variant, weights = choose_variant(), find_weights()
    return {
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else _processor(),
        "threads": torch.get_num_threads(),
        "wait_policy": os.environ.get(WAIT_POLICY),
        "platform": platform.platform(),
        "python": platform.python_version(),
        "versions": {name: _version(name) for name in _PACKAGES},
        "mitsuba_variant": f"{variant.name}: {variant.reason}",
        "inception_weights": Path(weights).name if weights else None,
        "clock": {"batch": 1, "warm_up_frames": WARM_UP, "timed_frames": FRAMES},
        "policy": asdict(policy or Policy.for_device(device)),
    }


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:  # nothing but OIDN's rows needs mitsuba-oidn
        return None


def _git(*arguments: str) -> str | None:
    try:
        process = subprocess.run(["git", *arguments], cwd=PROJECT, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return process.stdout.strip()


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    names = [line.partition(":")[2].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line] if (
        cpuinfo.exists()
    ) else []  # fmt: skip
    return f"CPU, {names[0] if names else platform.processor()}, {os.cpu_count()} cores"
