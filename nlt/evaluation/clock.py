"""The cost of a frame: time per stage at batch 1, floating-point operations, memory."""

import math
import time
import weakref
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import scipy.stats
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.data import default_collate
from torch.utils.flop_counter import FlopCounterMode

from nlt.evaluation.frames import Frames
from nlt.metrics.quantities import STATE_STAGES
from nlt.models.method import Batch, Method
from nlt.models.module import RenderingModule
from nlt.models.policy import Policy, accelerate

WARM_UP, FRAMES, LEAST_FRAMES = 10, 40, 3
_WARM_UP_SHARE = 0.2  # of the time limit


class Clock:
    """Measures the cost of methods on the same frames: a dataset's samples, each with its own state and view.

    A frame's cost includes all that a renderer does for a new frame: G-buffer with direct light, photons, path tracing
    of the method's input pixels, light transport, projection, and synthesis or denoising. Moving the scene's objects is
    left out, because it costs the same for all methods.

    `batch` is the number of frames computed at once; `policy` is None for the device's default.
    """

    def __init__(self, frames: Frames, device: torch.device, batch: int = 1, policy: Policy | None = None) -> None:
        self.frames, self.dataset, self.device, self.batch = frames, frames.dataset, device, batch
        self.policy = policy or Policy.for_device(device)

    def time(self, method: Method) -> dict[str, Any]:
        """Return the seconds per stage and per frame (see `summary`) over 40 frames, after 10 warm-up frames."""
        return summary(self.time_interleaved({"": self._accelerated(method)})[""])

    def time_interleaved(
        self, methods: Mapping[str, Method], seconds: float = math.inf
    ) -> dict[str, list[dict[str, float]]]:
        """Return the seconds per stage of every timed frame, by method, from interleaved timing.

        The methods are on the clock's device already, accelerated or not.

        The methods take turns on each frame, so that other load on the machine slows all of them alike. The device is
        synchronised around every stage. There are 10 warm-up and 40 timed frames, fewer if `seconds` run out, but at
        least 2 and 3.
        """
        rows = np.linspace(0, len(self.dataset) - 1, min(len(self.dataset), WARM_UP + FRAMES)).astype(int)
        # The scenes are interleaved, so that the warm-up compiles the kernels of each.
        stride = math.ceil(len(rows) / len(self.dataset.spec.scenes))
        rows = np.concatenate([rows[first::stride] for first in range(stride)])
        timed: dict[str, list[dict[str, float]]] = {name: [] for name in methods}
        start, row_number = time.perf_counter(), 0
        with torch.inference_mode():
            for maximum, minimum, share in ((WARM_UP, min(WARM_UP, 2), _WARM_UP_SHARE), (FRAMES, LEAST_FRAMES, 1)):
                for laps in timed.values():
                    laps.clear()
                for k in range(maximum):
                    if k >= minimum and time.perf_counter() - start > share * seconds:
                        break
                    indices = [int(rows[(row_number + j) % len(rows)]) for j in range(self.batch)]
                    row_number += self.batch
                    for name, method in methods.items():
                        timed[name].append(self._frame(method, indices))
        return timed

    def _frame(self, method: Method, indices: Sequence[int]) -> dict[str, float]:
        batch, spec = method.subsample(self._batch(indices)), self.dataset.spec
        seconds: dict[str, float] = {}
        mask = method.mask(batch, spec.resolution, spec.resolution)
        traced = []
        for row, index in enumerate(indices):
            renderer, camera = self.frames.place(index)
            if "gbuffer" in method.stages:
                self._timed(seconds, "gbuffer", partial(renderer.gbuffer, camera, method.reads_direct_light))
            if "photons" in method.stages:
                count = method.num_photons or spec.num_photons
                self._timed(seconds, "photons", partial(renderer.photons, count, index))
            if "path_tracing" in method.stages:
                pixels = None if method.pixel_fraction == 1 else mask[row, 0].flatten().nonzero()[:, 0].cpu().numpy()
                spp = method.spp or spec.samples(method.fields)
                work = partial(renderer.radiance, camera, spp, index, pixels)
                traced.append(self._timed(seconds, "path_tracing", work))
        if "traced" in method.fields:
            batch["traced"] = torch.from_numpy(np.stack(traced)).to(self.device)
        result: Any = None
        for name, step in method.steps().items():
            result = self._timed(seconds, name, partial(step, batch, result))
        return seconds

    def _accelerated(self, method: Method) -> Method:
        return accelerate(method, self.policy, self.device)

    def _batch(self, indices: Sequence[int]) -> Batch:
        return {k: v.to(self.device) for k, v in default_collate([self.dataset[index] for index in indices]).items()}

    def _timed(self, seconds: dict[str, float], stage: str, work: Callable[[], Any]) -> Any:
        self._synchronize()
        start = time.perf_counter()
        result = work()
        self._synchronize()
        seconds[stage] = seconds.get(stage, 0.0) + time.perf_counter() - start
        return result

    def _synchronize(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)

    def size(self, method: Method) -> dict[str, Any]:
        """Return the number of parameters, a batch's FLOPs, and the peak memory of its computation in bytes.

        FLOPs are those of convolutions and matrix products. Rendering is not counted, so a method that computes
        nothing in PyTorch has no FLOPs and no memory. Peak memory includes parameters, inputs and the largest amount
        of results alive at once: on CUDA as the allocator counts it, elsewhere without operators' internal buffers.
        """
        parameters = list(method.parameters())
        sizes: dict[str, Any] = {"parameters": sum(p.numel() for p in parameters)}
        if not isinstance(method, RenderingModule):
            return sizes
        flops = sum(self.flops(method).values())
        method = self._accelerated(method)
        batch = self._inputs(method)
        memory = _AliveMemory()
        cuda = self.device.type == "cuda"
        if cuda:
            torch.cuda.reset_peak_memory_stats(self.device)
            before = torch.cuda.memory_allocated(self.device)
        with torch.no_grad(), memory:
            method(batch)
        peak = torch.cuda.max_memory_allocated(self.device) - before if cuda else memory.peak
        held_bytes = sum(t.numel() * t.element_size() for t in [*parameters, *batch.values()])
        return sizes | {"flops": flops, "peak_memory_bytes": held_bytes + peak}

    @torch.no_grad()
    def flops(self, method: RenderingModule) -> dict[str, int]:
        """Return the FLOPs of a batch's convolutions and matrix products by step, without sparse or int8 shortcuts."""
        batch, result, flops = self._inputs(method), None, {}
        dense = accelerate(method, replace(self.policy, sparse=False, int8=False), self.device)
        for name, step in dense.steps().items():
            with FlopCounterMode(display=False) as counter:
                result = step(batch, result)
            flops[name] = counter.get_total_flops()
        return flops

    def _inputs(self, method: Method) -> Batch:
        """Return a batch of only the fields that the method reads."""
        full_batch = self._batch([k % len(self.dataset) for k in range(self.batch)])
        batch = {name: value for name, value in full_batch.items() if name in (*method.fields, "exposure", "scene")}
        return method.subsample(batch | {"index": torch.zeros_like(batch["scene"])})


def summary(laps: list[dict[str, float]]) -> dict[str, Any]:
    """Return the median and 95th percentile of timed frames by stage, in seconds.

    `time_per_frame_s` is the sum of the stages' medians, and `time_per_frame_error_s` its standard error, bootstrapped
    over the frames. `moving_camera_s` leaves out the stages that do not depend on the camera.
    """
    stages = {name: np.array([frame[name] for frame in laps]) for name in laps[0]}
    result = {f"{name}_s": float(np.median(seconds)) for name, seconds in stages.items()}
    moving = sum(value for name, value in result.items() if name.removesuffix("_s") not in STATE_STAGES)
    result |= {"time_per_frame_s": sum(result.values()), "moving_camera_s": moving}
    total = lambda *seconds, axis: sum(np.median(s, axis=axis) for s in seconds)
    bootstrap = scipy.stats.bootstrap(
        tuple(stages.values()), total, paired=True, n_resamples=200, method="basic", rng=np.random.default_rng(0)
    )
    result["time_per_frame_error_s"] = float(bootstrap.standard_error)
    result |= {f"{name}_p95_s": float(np.percentile(seconds, 95)) for name, seconds in stages.items()}
    result["time_per_frame_p95_s"] = float(np.percentile(sum(stages.values()), 95))
    return result


class _AliveMemory(TorchDispatchMode):
    """Tracks the peak memory, in bytes, of the tensors created within the context that are alive at once."""

    def __init__(self) -> None:
        super().__init__()
        self.now = self.peak = 0
        self._known: set[int] = set()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        given = {storage.data_ptr() for storage in _storages((args, kwargs))}
        result = func(*args, **(kwargs or {}))
        for storage in _storages(result):
            if storage.data_ptr() not in given | self._known:
                self._known.add(storage.data_ptr())
                self.now += storage.nbytes()
                weakref.finalize(storage, self._freed, storage.data_ptr(), storage.nbytes())
        self.peak = max(self.peak, self.now)
        return result

    def _freed(self, pointer: int, size: int) -> None:
        self._known.discard(pointer)
        self.now -= size


def _storages(tree: Any) -> list[Any]:
    """Return the storages of the tensors in a tree, except weights packed by oneDNN, which expose none."""
    leaves = (leaf for leaf in tree_leaves(tree) if isinstance(leaf, Tensor) and leaf.layout == torch.strided)
    return [leaf.untyped_storage() for leaf in leaves]
