"""What a frame costs: time, stage by stage, at batch 1; floating-point operations; memory."""

from __future__ import annotations

import time
import weakref
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import scipy.stats
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import FlopCounterMode

from nlt.evaluation.frames import Frames
from nlt.models.method import Batch, Method
from nlt.models.module import RenderingModule

WARM_UP, FRAMES = 10, 40


class Clock:
    """Measures methods on the same frames: test samples, each with its own state and view.

    What is charged is what a renderer would pay for a new frame: G-buffer, photon casting, path tracing of the
    pixels that the method is fed with, light transport, projection and synthesis or denoising. Not charged,
    being the same for all methods: moving the scene's objects.
    """

    def __init__(self, frames: Frames, device: torch.device) -> None:
        self.frames, self.dataset, self.device = frames, frames.dataset, device

    def time(self, method: Method) -> dict[str, Any]:
        """Seconds: median and p95 by stage; `time_per_frame_s` is the sum of the stages' medians.

        Warm-up 10 frames, then 40 timed ones, the device synchronised around every stage.
        `time_per_frame_error_s` is its standard error, bootstrapped over the frames.
        """
        method = method.to(self.device).eval()
        rows = np.linspace(0, len(self.dataset) - 1, min(len(self.dataset), WARM_UP + FRAMES)).astype(int)
        timed: list[dict[str, float]] = []
        with torch.inference_mode():
            for k in range(WARM_UP + FRAMES):
                timed.append(self._frame(method, int(rows[k % len(rows)])))
        stages = {name: np.array([frame[name] for frame in timed[WARM_UP:]]) for name in timed[0]}
        result = {f"{name}_s": float(np.median(seconds)) for name, seconds in stages.items()}
        result["time_per_frame_s"] = sum(result.values())
        total = lambda *seconds, axis: sum(np.median(s, axis=axis) for s in seconds)
        spread = scipy.stats.bootstrap(
            tuple(stages.values()), total, paired=True, n_resamples=200, method="basic", rng=np.random.default_rng(0)
        )
        result["time_per_frame_error_s"] = float(spread.standard_error)
        result |= {f"{name}_p95_s": float(np.percentile(seconds, 95)) for name, seconds in stages.items()}
        result["time_per_frame_p95_s"] = float(np.percentile(sum(stages.values()), 95))
        return result

    def _frame(self, method: Method, index: int) -> dict[str, float]:
        renderer, camera = self.frames.place(index)
        batch, spec = self._batch(index), self.dataset.spec
        seconds: dict[str, float] = {}
        if "gbuffer" in method.stages:
            self._lap(seconds, "gbuffer", lambda: renderer.gbuffer(camera))
        if "photons" in method.stages:
            self._lap(seconds, "photons", lambda: renderer.photons(spec.photons, index))
        if "path_tracing" in method.stages:
            mask = method.mask(batch, camera.height, camera.width)
            pixels = None if method.pixel_fraction == 1 else mask[0, 0].flatten().nonzero()[:, 0].cpu().numpy()
            spp = method.spp or spec.input_spp
            traced = self._lap(seconds, "path_tracing", lambda: renderer.radiance(camera, spp, index, pixels))
            if "traced" in method.inputs:
                batch["traced"] = torch.from_numpy(traced)[None].to(self.device)
        result: Any = None
        for name, step in method.steps().items():
            result = self._lap(seconds, name, partial(step, batch, result))
        return seconds

    def _batch(self, index: int) -> Batch:
        return {k: v[None].to(self.device) for k, v in self.dataset[index].items()}

    def _lap(self, seconds: dict[str, float], stage: str, work: Callable[[], Any]) -> Any:
        self._synchronize()
        start = time.perf_counter()
        result = work()
        self._synchronize()
        seconds[stage] = time.perf_counter() - start
        return result

    def _synchronize(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)

    def size(self, method: Method) -> dict[str, Any]:
        """Parameters; FLOPs of a frame's convolutions and matrix products; peak memory of its computation.

        The renderer's share is not in it, so a method that computes nothing by PyTorch has neither of the latter.
        The memory is that of parameters, inputs and, of what is computed, the most that is alive at once; on
        CUDA by the allocator, elsewhere by the tensors, without what an operator needs only within itself.
        """
        parameters = list(method.parameters())
        sizes: dict[str, Any] = {"parameters": sum(p.numel() for p in parameters)}
        if not isinstance(method, RenderingModule):
            return sizes
        method = method.to(self.device).eval()
        batch = {name: value for name, value in self._batch(0).items() if name in (*method.inputs, "exposure", "scene")}
        flops, memory = FlopCounterMode(display=False), _AliveMemory()
        batch["index"] = torch.zeros_like(batch["scene"])
        with torch.no_grad(), flops:
            method(batch)
        cuda = self.device.type == "cuda"
        if cuda:
            torch.cuda.reset_peak_memory_stats(self.device)
            before = torch.cuda.memory_allocated(self.device)
        with torch.no_grad(), memory:
            method(batch)
        peak = torch.cuda.max_memory_allocated(self.device) - before if cuda else memory.peak
        held = sum(t.numel() * t.element_size() for t in [*parameters, *batch.values()])
        return sizes | {"flops": flops.get_total_flops(), "peak_memory_bytes": held + peak}


class _AliveMemory(TorchDispatchMode):
    """The most bytes of tensors that are alive at once, of those that are made within."""

    def __init__(self) -> None:
        super().__init__()
        self.now = self.peak = 0
        self._known: set[int] = set()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        given = {leaf.untyped_storage().data_ptr() for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)}
        result = func(*args, **(kwargs or {}))
        for leaf in tree_leaves(result):
            if isinstance(leaf, Tensor) and leaf.untyped_storage().data_ptr() not in given | self._known:
                storage = leaf.untyped_storage()
                self._known.add(storage.data_ptr())
                self.now += storage.nbytes()
                weakref.finalize(storage, self._freed, storage.data_ptr(), storage.nbytes())
        self.peak = max(self.peak, self.now)
        return result

    def _freed(self, pointer: int, size: int) -> None:
        self._known.discard(pointer)
        self.now -= size
