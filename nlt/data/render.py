"""Rendering of a dataset's samples, one at a time, each from its own seeds."""

from collections.abc import Callable, Collection

import drjit as dr
import numpy as np

from nlt.data.sample import BUFFERS, DIRECT, FIELDS
from nlt.data.spec import DatasetSpec
from nlt.errors import UserError
from nlt.rendering.renderer import Renderer
from nlt.rendering.variant import use_variant
from nlt.scenes.assembly import Scene
from nlt.scenes.camera import Camera
from nlt.scenes.description import SceneDescription
from nlt.scenes.pointcloud import sample_points
from nlt.scenes.views import Views

_ATTEMPTS = 3


class SampleRenderer:
    """Renders the samples of one scene of a dataset, each from its own seeds."""

    def __init__(
        self,
        spec: DatasetSpec,
        scene: int,
        threads: int | None = None,
        build: Callable[[SceneDescription, str], Scene] = Scene,
    ) -> None:
        """Load the scene; `build` makes it from its description and the experiment."""
        use_variant()
        self.spec, self.index = spec, scene
        self.description = spec.descriptions[scene]
        self.scene = build(self.description, spec.experiment)
        self.renderer = Renderer(self.scene, spec.integrator)
        self.views = Views(self.scene)
        self._taken: dict[str, set[bytes]] = {}  # keys of the states that each split avoids
        if threads:
            dr.set_thread_count(threads)  # must not come earlier: see `use_variant`

    def points(self) -> dict[str, np.ndarray]:
        """Return the scene's point cloud."""
        points = sample_points(self.scene, self.spec.num_points, self.spec.seed)
        share = float(points["area_share"])
        print(f"{self.description.name}: points lie on the {share:.1%} of the surface that can be seen", flush=True)
        return points

    def place(self, split: str, index: int) -> Camera:
        """Put the scene into a sample's state and return the sample's camera.

        An index beyond the spec's count gives a further sample.
        """
        spec = self.spec
        if split not in self._taken:
            self._taken[split] = spec.taken(split, self.index)
        self.scene.set_state(spec.state(split, self.index, index, self._taken[split]))
        rng = np.random.default_rng(spec.seeds(split, self.index, index).spawn(2)[1])
        camera = self.views.sample(spec.resolution, rng)
        if split == "train" and spec.crop:
            column, row = rng.integers(spec.resolution - spec.crop + 1, size=2)
            camera = camera.window(column, row, spec.crop)
        return camera

    def sample(self, split: str, index: int, only: Collection[str] | None = None) -> dict[str, np.ndarray]:
        """Return one sample: all fields of its split, or those in `only`."""
        camera = self.place(split, index)
        fields = {name for name in self.spec.fields(split) if only is None or name in only}
        return self.view(camera, self.spec.seeds(split, self.index, index), fields)

    def view(self, camera: Camera, seeds: np.random.SeedSequence, names: Collection[str]) -> dict[str, np.ndarray]:
        """Return the fields `names` of any view of the scene in its current state, at the camera's resolution."""
        spec, state = self.spec, self.scene.state
        noisy, noisy_input, half_a, half_b, photons, target = (int(seed) for seed in seeds.generate_state(6))
        sizes = spec.sizes("test") | {"H": camera.height, "W": camera.width}
        fields = {name: field for name, field in FIELDS.items() if name in names}
        absent = sizes["M"] - len(state.present)  # another scene of the dataset has more movable objects
        sample: dict[str, np.ndarray] = {
            "camera_matrix": camera.matrix,
            "world_to_view": camera.world_to_view,
            "translation": np.pad(state.translation, ((0, absent), (0, 0))),
            "present": np.pad(state.present, (0, absent)),
        }
        images = {
            "noisy": (spec.noisy_spp, noisy),
            "noisy_input": (spec.input_spp, noisy_input),
            "target": (spec.target_spp, target),
            "reference_a": (spec.reference_spp, half_a),
            "reference_b": (spec.reference_spp, half_b),
        }
        sample |= {name: self.radiance(camera, *image) for name, image in images.items() if name in fields}
        if not fields.keys().isdisjoint((*BUFFERS, *DIRECT)):
            sample |= self.renderer.gbuffer(camera, not fields.keys().isdisjoint(DIRECT))
        if any(name.startswith("photon_") for name in fields):
            sample |= self.renderer.photons(spec.num_photons, photons)
        return {
            name: np.ascontiguousarray(sample[name], field.dtype).reshape(field.resolve(sizes))
            for name, field in fields.items()
        }

    def radiance(self, camera: Camera, spp: int, seed: int, pixels: np.ndarray | None = None) -> np.ndarray:
        """Return path-traced radiance (3, H, W), W·sr⁻¹·m⁻², or (3, n) for the flat indices `pixels` (n,).

        Raises:
            UserError: three attempts with different seeds gave values that are not finite.
        """
        for attempt in range(_ATTEMPTS):
            image = self.renderer.radiance(camera, spp, (seed + attempt) % 2**32, pixels)
            if np.isfinite(image).all():
                return image
        raise UserError(f"{self.description.source}: the integrator gives non-finite radiance at seed {seed}")
