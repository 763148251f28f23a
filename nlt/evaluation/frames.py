"""Samples of a dataset that can be rendered again, for the clock and for methods that path trace."""

from collections.abc import Callable
from functools import cache

import torch
from torch import Tensor

from nlt.data.dataset import LightTransportDataset
from nlt.data.render import SampleRenderer
from nlt.rendering.renderer import Renderer, choose_integrator
from nlt.rendering.variant import use_variant
from nlt.scenes.camera import Camera


class Frames:
    """The samples of a dataset's split, ready to render; a scene is loaded when one of its samples is first needed.

    `renderer` returns the renderer of a scene, by the scene's index, instead of loading it.
    """

    def __init__(self, dataset: LightTransportDataset, renderer: Callable[[int], SampleRenderer] | None = None) -> None:
        self.dataset = dataset
        self._renderer = renderer or cache(lambda scene: SampleRenderer(dataset.spec, scene))
        self.traced = cache(self._traced)

    def integrators(self) -> dict[str, str]:
        """Return the integrator that traces radiance on this machine, by scene."""
        use_variant()
        spec = self.dataset.spec
        return {scene.name: choose_integrator(scene.integrator, spec.integrator) for scene in spec.descriptions}

    def place(self, index: int) -> tuple[Renderer, Camera]:
        """Set a sample's scene to its state; return its renderer and its camera."""
        scene, row = divmod(index, self.dataset.spec.count(self.dataset.split))
        sample_renderer = self._renderer(scene)
        return sample_renderer.renderer, sample_renderer.place(self.dataset.split, row)

    def _traced(self, index: int, spp: int) -> Tensor:
        """Return path-traced radiance (3, H, W) of a sample, with a seed that no stored image has."""
        renderer, camera = self.place(index)
        spec, split = self.dataset.spec, self.dataset.split
        scene, row = divmod(index, spec.count(split))
        (seed,) = spec.seeds(split, scene, row).spawn(2 + spp)[-1].generate_state(1)  # 0 and 1 seed state and view
        return torch.from_numpy(renderer.radiance(camera, spp, int(seed)))
