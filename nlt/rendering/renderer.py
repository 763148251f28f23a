"""Trace rays through a scene: radiance of any set of pixels, the G-buffer, photons.

All results are numpy arrays in metres, world coordinates and linear, unclamped RGB.
"""

import logging
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from nlt.errors import UserError
from nlt.rendering.gbuffer import GBufferTracer
from nlt.rendering.photons import PhotonCaster
from nlt.rendering.rays import camera_ray, camera_values
from nlt.scenes.assembly import Scene
from nlt.scenes.camera import Camera
from nlt.scenes.lanes import freeze, is_jit, launch

log = logging.getLogger(__name__)

# Lanes traced at once; this bounds memory, at about 1 kB per lane.
_MAX_LANES = 1 << 20


class Renderer:
    """Traces rays through a scene in its current state (`scene.set_state`).

    Args:
        integrator: "path" or "bdpt", which estimates radiance; "scene" stands for the one in scene.yaml, if the active
            Mitsuba variant can run it. Both have the same expectation.

    Raises:
        UserError: the active variant cannot run `integrator`.
    """

    def __init__(self, scene: Scene, integrator: str = "scene") -> None:
        self.scene = scene
        self.integrator_name = choose_integrator(scene.description.integrator, integrator)
        is_path = self.integrator_name == "path"
        # Infinite depth with Russian roulette, because a maximum depth would bias the result.
        self.integrator = mi.load_dict({"type": "path", "max_depth": -1} if is_path else {"type": "bdpt"})
        self._radiance = freeze(_radiance if is_path else _bidirectional)
        self._gbuffer, self._photons = GBufferTracer(scene), PhotonCaster(scene)

    def radiance(self, camera: Camera, spp: int, seed: int, pixels: np.ndarray | None = None) -> np.ndarray:
        """Estimate radiance with the integrator; only the requested pixels are traced.

        Args:
            pixels: (n,) flat indices, row by row; None for the whole image.

        Returns:
            (3, H, W) float32 for the whole image, else (3, n).
        """
        shape = (3, camera.height, camera.width) if pixels is None else (3, -1)
        if pixels is None:
            if not is_jit():
                # A Python loop over paths takes longer than a whole image in C++, unless few pixels are requested.
                return self._scalar_image(camera, spp, seed)
            pixels = np.arange(camera.width * camera.height)
        corners = camera.corners()[pixels]
        total = np.zeros((3, len(pixels)))
        batch = max(1, min(spp, _MAX_LANES // max(len(pixels), 1)))
        fixed = camera_values(self.scene, camera)
        if self.integrator_name == "bdpt":
            fixed["image"] = mi.Vector3f(camera.width, camera.height, len(pixels))
            dr.make_opaque(fixed["image"])
        for k, start in enumerate(range(0, spp, batch)):
            count = min(batch, spp - start)
            sampler = mi.load_dict({"type": "independent"})
            sub_seed = int(np.random.SeedSequence([seed, k]).generate_state(1)[0])
            width = len(pixels) * count if is_jit() else 1
            sampler.seed(dr.opaque(mi.UInt32, sub_seed) if is_jit() else sub_seed, width)
            lanes = {"corner": ("Point2f", np.repeat(corners.T, count, axis=1).T)}
            fixed |= {"integrator": self.integrator, "sampler": sampler}
            values, *splats = launch(self._radiance, lanes, **fixed)
            # Samples of a pixel are contiguous. Adding them here is deterministic; an atomic add is not. The loop
            # takes less time than `sum` over so short an axis.
            for sample in range(count):
                total += values.T[:, sample::count]
            for pixel, value in zip(splats[::2], splats[1::2], strict=True):
                lit = value.any(1)
                image = [np.bincount(pixel[lit], channel, camera.width * camera.height) for channel in value[lit].T]
                total += np.stack(image)[:, pixels] / len(pixels)
        return (total / spp).astype(np.float32).reshape(shape)

    def _scalar_image(self, camera: Camera, spp: int, seed: int) -> np.ndarray:
        sensor = mi.load_dict({
            "type": "perspective",
            "fov": camera.fov,
            "principal_point_offset_x": 0.5 - float(camera.matrix[0, 2]) / camera.width,
            "principal_point_offset_y": 0.5 - float(camera.matrix[1, 2]) / camera.height,
            "near_clip": 1e-4,
            "to_world": sensor_to_world(camera, self.scene.description.units_per_metre),
            "film": {"type": "hdrfilm", "width": camera.width, "height": camera.height, "rfilter": {"type": "box"}},
        })  # fmt: skip
        image = mi.render(self.scene.mi_scene, sensor=sensor, integrator=self.integrator, spp=spp, seed=mi.UInt32(seed))
        return np.moveaxis(np.array(image)[..., :3], 2, 0).astype(np.float32)

    def gbuffer(self, camera: Camera, direct: bool = False) -> dict[str, np.ndarray]:
        """Trace primary rays, and shadow rays if `direct`. They pass through the transparent parts of opacity masks.

        Shadow rays start at eight places in each pixel, in images of some 200 pixels or more at four, or at the surface
        that at most two mirrors or sides of a pane show there. They go to 16 fixed points of each lamp and of the
        environment, two or four from each place; in such large images one from each place, if all lamps have at most
        two triangles and none face away. So there is no noise, and a penumbra has a few shades.

        Returns:
            depth (1, H, W) and shading normal (3, H, W) at pixel centres; albedo (3, H, W) and emission (3, H, W), the
            radiance seen directly from lamps and from the environment, as means over each pixel's area. If `direct`,
            also seen_albedo (3, H, W), the mean share of light that is reflected to the camera, there or by what metal
            and glass show, which is less than the albedo under a coat; and direct (3, H, W), which times seen_albedo is
            the mean of what is reflected of lamps and sky, also by a coat; where nothing is, what white would reflect.
            Rough metal shows another direction of its lobe in each place. A lamp in a mirror is a white surface that
            reflects what it emits; lamps and sky in rough metal are left out.
        """
        return self._gbuffer.trace(camera, direct)

    def transmits(self, camera: Camera) -> np.ndarray:
        """Return (H, W) bool: whether the surface at the pixel centre transmits light, as glass does."""
        return self._gbuffer.transmits(camera)

    def photons(self, count: int, seed: int) -> dict[str, np.ndarray]:
        """Cast photons that arrive in the room, from all emitters in proportion to the power that arrives from each.

        A photon arrives if it crosses the description's `room` before it first hits a surface; without a `room`, if it
        hits a surface. Photons are cast until `count` have arrived, with at most 1024 casts for each.

        Returns:
            photon_origin, photon_direction, photon_flux, photon_hit (count, 3) and photon_valid (count,). The expected
            sum of the flux is the arriving power. Photons that did not arrive within the limit are zero and not valid.
        """
        return self._photons.cast(count, seed)


def sensor_to_world(camera: Camera, units_per_metre: float) -> Any:
    """Return the transform of Mitsuba's camera, which looks along +z like ours, but whose x points left and y up."""
    view_to_world = np.linalg.inv(camera.world_to_view.astype(float))
    view_to_world[:3, 3] *= units_per_metre
    return mi.ScalarTransform4f(view_to_world @ np.diag([-1.0, -1.0, 1.0, 1.0]))


def _radiance(scene: Any, integrator: Any, sampler: Any, corner: Any, **camera: Any) -> tuple:
    # box filter: uniform in the pixel
    ray = mi.RayDifferential3f(camera_ray(corner + sampler.next_2d(), **camera))
    value, valid, _ = integrator.sample(scene, sampler, ray)
    return (mi.Color3f(dr.select(valid, value, 0)),)


def _bidirectional(scene: Any, integrator: Any, sampler: Any, corner: Any, image: Any, **camera: Any) -> tuple:
    from nlt.rendering.bdpt import Pinhole

    ray = camera_ray(corner + sampler.next_2d(), **camera)
    pinhole = Pinhole(**camera, width=image.x, height=image.y, pixels=image.z)
    value, _, splats = integrator.trace(scene, sampler, ray, pinhole)
    return (value, *(part for splat in splats for part in splat))


def choose_integrator(own: str, wanted: str = "scene") -> str:
    """Return the integrator, "path" or "bdpt", for a scene whose description names `own`.

    Args:
        wanted: "path", "bdpt" or "scene"; "scene" means `own`, or "path" if the active variant cannot run `own`.

    Raises:
        UserError: `wanted` is "bdpt" and the active variant cannot run it.
    """
    if (own if wanted == "scene" else wanted) == "path":
        return "path"
    if is_jit():
        # Imported here because its classes belong to the active variant.
        import nlt.rendering.bdpt  # noqa: F401

        return "bdpt"
    if wanted != "scene":
        raise UserError("integrator: bdpt needs Mitsuba's llvm or cuda variant; install LLVM, or use integrator: path")
    log.warning("integrator: bdpt needs Mitsuba's llvm or cuda variant; using path, which has the same expectation")
    return "path"
