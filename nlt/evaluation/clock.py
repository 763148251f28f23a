"""The one clock: a method's time per frame, stage by stage, at batch 1."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from nlt.data.datamodule import LightTransportDataset
from nlt.data.render import SampleRenderer
from nlt.models.module import RenderingModule

WARM_UP, FRAMES = 10, 40
# Rendered, then computed. A method pays for those it needs.
STAGES = ("gbuffer", "photons", "path_tracing", "transport", "projection", "synthesis")


class Clock:
    """Times methods on the same frames: test samples, each with its own state and view.

    What is charged is what a renderer would pay for a new frame: G-buffer, photon casting, path tracing of the
    pixels that the method is fed with, light transport, projection and synthesis. Not charged, being the same
    for all methods: moving the scene's objects.
    """

    def __init__(self, dataset: LightTransportDataset, device: torch.device) -> None:
        self.dataset, self.device = dataset, device
        self._renderers: dict[int, SampleRenderer] = {}

    def time(self, module: RenderingModule) -> dict[str, Any]:
        """Seconds: median and p95 by stage; `time_per_frame_s` is the sum of the stages' medians.

        Warm-up 10 frames, then 40 timed ones, the device synchronised around every stage.
        """
        module = module.to(self.device).eval()
        rows = np.linspace(0, len(self.dataset) - 1, min(len(self.dataset), WARM_UP + FRAMES)).astype(int)
        timed: list[dict[str, float]] = []
        with torch.inference_mode():
            for k in range(WARM_UP + FRAMES):
                timed.append(self._frame(module, int(rows[k % len(rows)])))
        stages = {name: np.array([frame[name] for frame in timed[WARM_UP:]]) for name in timed[0]}
        result = {f"{name}_s": float(np.median(seconds)) for name, seconds in stages.items()}
        result["time_per_frame_s"] = sum(result.values())
        result |= {f"{name}_p95_s": float(np.percentile(seconds, 95)) for name, seconds in stages.items()}
        result["time_per_frame_p95_s"] = float(np.percentile(sum(stages.values()), 95))
        return result

    def _frame(self, module: RenderingModule, index: int) -> dict[str, float]:
        scene, row = divmod(index, self.dataset.spec.count(self.dataset.split))
        if scene not in self._renderers:
            self._renderers[scene] = SampleRenderer(self.dataset.spec, scene)
        render = self._renderers[scene]
        camera = render.place(self.dataset.split, row)
        batch = {k: v[None].to(self.device) for k, v in self.dataset[index].items()}
        spec, trace = self.dataset.spec, render.renderer
        seconds: dict[str, float] = {}
        if "gbuffer" in module.stages:
            self._lap(seconds, "gbuffer", lambda: trace.gbuffer(camera))
        if "photons" in module.stages:
            self._lap(seconds, "photons", lambda: trace.photons(spec.photons, index))
        if "path_tracing" in module.stages:
            mask = module.mask(batch, camera.height, camera.width)
            pixels = None if module.pixel_fraction == 1 else mask[0, 0].flatten().nonzero()[:, 0].cpu().numpy()
            self._lap(seconds, "path_tracing", lambda: trace.radiance(camera, spec.input_spp, index, pixels))
        transported = self._lap(seconds, "transport", lambda: module.transport(batch))
        features = self._lap(seconds, "projection", lambda: module.features(batch, transported))
        self._lap(seconds, "synthesis", lambda: module.synthesize(batch, features))
        return seconds

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
