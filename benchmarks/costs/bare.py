"""The renderer's ceiling: a plain loop of Mitsuba's own calls that traces the rays of a sample."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from nlt.data.render import SampleRenderer
from nlt.rendering.renderer import sensor_to_world
from nlt.scenes.camera import Camera


class Bare:
    """A plain loop of Mitsuba's own calls; our code only moves the objects.

    Without `frozen`, as a user would first write it, every call records its kernel again before it finds the compiled
    one, which takes most of the time at small sizes. `frozen` avoids that by `dr.freeze`.
    """

    def __init__(self, render: SampleRenderer, frozen: bool) -> None:
        freeze: Callable = dr.freeze if frozen and dr.is_jit_v(mi.Float) else lambda function: function
        self._image, self._cast = freeze(_image), freeze(_cast)
        self.spec, self.scene = render.spec, render.scene
        self.path = render.renderer.integrator
        self.aov = mi.load_dict({"type": "aov", "aovs": "depth:depth,normal:sh_normal,albedo:albedo"})
        size = render.spec.resolution
        film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
        fov = render.description.fov
        self.sensor = mi.load_dict({"type": "perspective", "near_clip": 1e-4, "fov": fov, "film": film})
        self.view = mi.traverse(self.sensor)

    def sample(self, state: Any, camera: Camera, split: str, seed: int) -> None:
        """Render the images and trace the photons of one sample of a split."""
        self.scene.set_state(state)
        self.view["to_world"] = sensor_to_world(camera, self.scene.description.units_per_metre)
        self.view.update()
        references = [] if split == "train" else [self.spec.reference_spp] * 2
        for k, spp in enumerate((self.spec.noisy_spp, self.spec.input_spp, self.spec.target_spp, *references)):
            self.render(self.path, spp, seed * 8 + k)
        self.render(self.aov, 1, seed)
        self.photons(seed)

    def render(self, integrator: Any, spp: int, seed: int) -> np.ndarray:
        """Render the last sample's view with the integrator `path` or, for depth, normal and albedo, `aov`."""
        seeds = dr.opaque(mi.UInt32, seed) if dr.is_jit_v(mi.Float) else seed
        return np.array(self._image(self.scene.mi_scene, self.sensor, integrator, spp, seeds))

    def photons(self, seed: int) -> None:
        """Trace as many photons as the spec has."""
        count = self.spec.num_photons if dr.is_jit_v(mi.Float) else 1
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(seed, count)
        for _ in range(self.spec.num_photons // count):
            for value in self._cast(self.scene.mi_scene, sampler):
                np.array(value)


def _image(scene: Any, sensor: Any, integrator: Any, spp: int, seed: Any) -> Any:
    return mi.render(scene, sensor=sensor, integrator=integrator, spp=spp, seed=seed)


def _cast(scene: Any, sampler: Any) -> tuple:
    ray, weight, _ = scene.sample_emitter_ray(
        mi.Float(0), sampler.next_1d(), sampler.next_2d(), sampler.next_2d(), True
    )
    hit = scene.ray_intersect(ray)
    return ray.o, ray.d, weight, hit.p, hit.is_valid()
