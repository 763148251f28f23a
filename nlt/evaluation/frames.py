"""Test samples put before the renderer again: for the clock, and for methods that path trace."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import torch
from torch import Tensor

from nlt.data.dataset import LightTransportDataset
from nlt.data.render import SampleRenderer
from nlt.rendering.renderer import Renderer, choose_teacher
from nlt.rendering.variant import use_variant
from nlt.scenes.camera import Camera


class Frames:
    """The samples of a dataset's split; a scene is loaded when one of its samples is first asked for.

    `renderer`: what gives the renderer of a scene in place of loading it.
    """

    def __init__(self, dataset: LightTransportDataset, renderer: Callable[[int], SampleRenderer] | None = None) -> None:
        self.dataset = dataset
        self._renderer = renderer or cache(lambda scene: SampleRenderer(dataset.spec, scene))
        self.traced = cache(self._traced)

    def teachers(self) -> dict[str, str]:
        """The integrator that traces radiance in each scene, on this machine."""
        use_variant()
        spec = self.dataset.spec
        return {scene.name: choose_teacher(scene.teacher, spec.teacher) for scene in spec.descriptions}

    def place(self, index: int) -> tuple[Renderer, Camera]:
        """Put a sample's scene into its state; what renders it, and its camera."""
        scene, row = divmod(index, self.dataset.spec.count(self.dataset.split))
        render = self._renderer(scene)
        return render.renderer, render.place(self.dataset.split, row)

    def _traced(self, index: int, spp: int) -> Tensor:
        """Path-traced radiance (3, H, W) of a sample; seeds of its own, that no stored image has."""
        renderer, camera = self.place(index)
        spec, split = self.dataset.spec, self.dataset.split
        scene, row = divmod(index, spec.count(split))
        (seed,) = spec.seeds(split, scene, row).spawn(2 + spp)[-1].generate_state(1)  # 0 and 1: state and view
        return torch.from_numpy(renderer.radiance(camera, spp, int(seed)))
