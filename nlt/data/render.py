"""Renders the samples of a dataset, one at a time, each from its own seeds."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from nlt.data.spec import DatasetSpec
from nlt.errors import UserError
from nlt.rendering.renderer import Renderer
from nlt.rendering.variant import use_variant
from nlt.scenes.assembly import Scene
from nlt.scenes.camera import Camera
from nlt.scenes.pointcloud import sample_points
from nlt.scenes.state import rest_state, sample_view

_TRIES = 3


class SampleRenderer:
    """Renders the samples of one scene of a dataset, each from its own seeds."""

    def __init__(self, spec: DatasetSpec, scene: int, threads: int | None = None) -> None:
        use_variant()
        self.spec, self.index = spec, scene
        self.description = spec.descriptions[scene]
        self.scene = Scene(self.description, spec.experiment)
        self.renderer = Renderer(self.scene)
        self._states: dict[str, Any] | None = None
        if threads:
            dr.set_thread_count(threads)  # not earlier: with one thread, loading a scene waits for ever

    def points(self) -> dict[str, np.ndarray]:
        """The scene's point cloud."""
        return sample_points(self.scene, self.spec.points, self.spec.seed)

    def place(self, split: str, index: int, rest: bool = False) -> Camera:
        """Put the scene into the state of a sample and return the sample's camera."""
        spec = self.spec
        if rest:
            state = rest_state(self.description, spec.experiment)
        else:
            self._states = self._states or spec.states(self.index)
            state = self._states[split][index]
        self.scene.set_state(state)
        rng = np.random.default_rng(spec.seeds(split, self.index, index).spawn(2)[1])
        return sample_view(self.description, spec.resolution, rng)

    def sample(self, split: str, index: int, rest: bool = False) -> dict[str, np.ndarray]:
        """One sample, all fields of its split. `rest`: in the rest state, for trying out the speed."""
        spec = self.spec
        camera = self.place(split, index, rest)
        state = self.scene.state
        seeds = spec.seeds(split, self.index, index).generate_state(5)
        noisy, noisy_input, half_a, half_b, photons = (int(seed) for seed in seeds)
        fields, sizes = spec.fields(split), spec.sizes
        moved = np.zeros((sizes["M"], 3), np.float32)
        present = np.zeros(sizes["M"], bool)
        moved[: len(state.present)], present[: len(state.present)] = state.translation, state.present
        sample: dict[str, np.ndarray] = {
            "noisy": self._radiance(camera, spec.noisy_spp, noisy),
            "noisy_input": self._radiance(camera, spec.input_spp, noisy_input),
            **self.renderer.gbuffer(camera),
            **self.renderer.photons(spec.photons, photons),
            "camera_matrix": camera.matrix,
            "world_to_view": camera.world_to_view,
            "translation": moved,
            "present": present,
        }
        if "reference_a" in fields:
            sample["reference_a"] = self._radiance(camera, spec.reference_spp, half_a)
            sample["reference_b"] = self._radiance(camera, spec.reference_spp, half_b)
        return {
            name: np.ascontiguousarray(sample[name], field.dtype).reshape(field.resolve(sizes))
            for name, field in fields.items()
        }

    def _radiance(self, camera: Any, spp: int, seed: int) -> np.ndarray:
        for attempt in range(_TRIES):
            image = self.renderer.radiance(camera, spp, (seed + attempt) % 2**32)
            if np.isfinite(image).all():
                return image
        raise UserError(f"{self.description.source}: the path tracer gives non-finite radiance at seed {seed}")
