"""The G-buffer: what primary rays see, and on request the direct light there."""

import itertools
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from nlt.rendering.direct_light import lit_albedo
from nlt.rendering.rays import camera_ray, camera_values, hammersley
from nlt.rendering.surfaces import albedo_of, any_hit, emission_of
from nlt.scenes.assembly import Scene
from nlt.scenes.camera import Camera
from nlt.scenes.lanes import freeze, is_jit, launch
from nlt.scenes.masks import first_surface, is_mask

# Albedo and direct light are means over so many places in each pixel. Coarse pixels show more edges; fine ones are
# those of a focal length of at least _FINE pixels. Powers of two spread evenly.
_PLACES_COARSE, _PLACES_FINE, _FINE = 8, 4, 128
_EMISSION_PLACES = 16
_SHADOW_RAYS = 16  # of a pixel to each emitter; of a fine pixel one from each place if all lamps are flat
_FAR, _MARGIN = 1e30, 1e-4  # scene units; the margin gives a flat lamp's box a volume
_UNIFORM = 0.02  # largest difference to a neighbour's albedo up to which a pixel is its centre's


class GBufferTracer:
    """Traces the G-buffer of a scene in its current state (`scene.set_state`)."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self._emitters = len(scene.mi_scene.emitters())
        self._lamps = [shape for shape in scene.mi_scene.shapes() if shape.is_emitter()]
        # The second also traces shadow rays, which Dr.Jit cannot freeze for every lamp.
        self._kernels = freeze(_gbuffer), freeze(_gbuffer)
        self._transmits = freeze(_transmits)

    def trace(self, camera: Camera, direct: bool) -> dict[str, np.ndarray]:
        """Return the buffers that `Renderer.gbuffer` describes."""
        lanes = {"corner": ("Point2f", camera.corners()), "lit": ("Float", self._may_see_lamp(camera))}
        fixed = {
            "masks": self.scene.masks,
            "sky": self.scene.environment is not None,
            **camera_values(self.scene, camera),
        }
        fixed["size"] = mi.Vector2f(camera.width, camera.height)
        fixed["lamps"] = self._corners_of_lamps()
        dr.make_opaque(fixed["size"], fixed["lamps"])
        is_flat = self.scene.environment is None and all(lamp.primitive_count() <= 2 for lamp in self._lamps)
        is_fine = camera.matrix[0, 0] >= _FINE
        fixed["places"] = _PLACES_FINE if is_fine else _PLACES_COARSE
        rays = _PLACES_FINE if is_fine and is_flat else _SHADOW_RAYS
        fixed["shadow_rays"] = direct * self._emitters * rays
        point, normal, albedo, emission, valid, *light = launch(self._kernels[direct], lanes, **fixed)
        metres = point.astype(float) / self.scene.description.units_per_metre
        # Depth is measured from the camera centre along the optical axis.
        depth = np.where(valid, (metres - camera.position) @ camera.rotation[:, 2], 0.0)
        buffers = {"depth": depth.astype(np.float32), "normal": np.where(valid, normal.T, 0)}
        buffers |= {"albedo": albedo.T, "emission": emission.T}
        if direct:
            buffers["direct"], buffers["seen_albedo"] = (values.T for values in light)
        return {name: values.reshape(-1, camera.height, camera.width) for name, values in buffers.items()}

    def _may_see_lamp(self, camera: Camera) -> np.ndarray:
        """Return (H W,) bool: the pixels that cover part of a lamp's bounding box. No others have a lamp's emission."""
        sees = np.zeros(camera.width * camera.height, bool)
        directions = camera.view_directions().reshape(3, -1)
        diagonal = np.hypot(1 / camera.matrix[0, 0], 1 / camera.matrix[1, 1])  # of a pixel, at depth 1
        for corners in self._lamp_boxes():
            box = corners / self.scene.description.units_per_metre - camera.position
            # Every ray in a pixel is at most half a diagonal away from the ray through the centre.
            margin = diagonal / 2 * np.linalg.norm(np.abs(box).max(0)) + 1e-4
            planes = (box + np.array([[-margin], [margin]])).astype(np.float32)
            with np.errstate(divide="ignore"):
                low, high = planes[:, :, None] / directions
            enter, leave = np.minimum(low, high).max(0), np.maximum(low, high).min(0)
            sees |= (enter <= leave) & (leave > 0)
        return sees

    def _corners_of_lamps(self) -> tuple[Any, Any]:
        """Return two opposite corners of the box around all lamps, which is everything where there is a sky."""
        if self.scene.environment is not None or not self._lamps:
            return mi.Point3f(-_FAR), mi.Point3f(_FAR)
        low, high = self._lamp_boxes().swapaxes(0, 1)
        return mi.Point3f((low.min(0) - _MARGIN).tolist()), mi.Point3f((high.max(0) + _MARGIN).tolist())

    def _lamp_boxes(self) -> np.ndarray:
        """Return the two corners of each lamp's bounding box (lamps, 2, 3), in scene units."""
        return np.array([[lamp.bbox().min, lamp.bbox().max] for lamp in self._lamps])

    def transmits(self, camera: Camera) -> np.ndarray:
        """Return (H, W) bool: whether the surface at the pixel centre transmits light, as glass does."""
        lanes = {"position": ("Point2f", camera.centres())}
        (transmits,) = launch(self._transmits, lanes, masks=self.scene.masks, **camera_values(self.scene, camera))
        return transmits.reshape(camera.height, camera.width)


def _gbuffer(
    scene: Any,
    masks: bool,
    sky: bool,
    lamps: tuple[Any, Any],
    places: int,
    shadow_rays: int,
    corner: Any,
    lit: Any,
    size: Any,
    **camera: Any,
) -> tuple:
    """Return point, normal, albedo, emission, whether the ray hit, and direct light. `lit` is 0 where no lamp is seen.

    It is one kernel because, however few rays a kernel traces, Dr.Jit needs 2 to 4 ms to look at the whole scene.
    """
    trace = lambda place: first_surface(scene, camera_ray(corner + place, **camera), masks)
    centre = trace(0.5)
    valid, albedo = centre.is_valid(), albedo_of(centre)
    varies, escapes = True, True  # A scalar kernel knows only its own pixel.
    if is_jit():
        dr.eval(valid, albedo)
        varies, escapes = _compare_neighbours(valid, albedo, corner, size, sky)
    light: Any = ()
    if shadow_rays:
        mean, *light = lit_albedo(scene, masks, mi.BoundingBox3f(*lamps), places, shadow_rays, trace)
    else:
        mean = _pixel_mean(trace, albedo_of, hammersley, places, varies)
    albedo = dr.select(varies, mean, albedo)
    lit = (lit > 0) | (escapes & sky)

    emission = _pixel_mean(trace, partial(emission_of, scene), _grid, _EMISSION_PLACES, lit)
    return centre.p, centre.sh_frame.n, albedo, emission, valid, *light


def _compare_neighbours(valid: Any, albedo: Any, corner: Any, size: Any, sky: bool) -> tuple[Any, Any]:
    """Return two masks: pixels at an edge or in a texture, and pixels from which a ray escapes.

    The second mask is for finding the sky: where there is one, the neighbours of such pixels belong to it, too.
    The pixels that are not at an edge, half of an image at 64x64 and more at higher resolutions, need no further rays.
    The image's border counts as an edge, because the neighbours outside are not known.
    """
    varies, escapes = mi.Bool(False), ~valid
    for dx, dy in itertools.product((-1, 0, 1), repeat=2):
        x, y = corner.x + dx, corner.y + dy
        inside = (x >= 0) & (y >= 0) & (x < size.x) & (y < size.y)
        index = mi.UInt32(y * size.x + x)
        if sky:
            escapes |= inside & ~dr.gather(mi.Bool, valid, index, inside)
        if abs(dx) + abs(dy) == 1:
            differs = dr.abs(dr.gather(mi.Color3f, albedo, index, inside) - albedo) > _UNIFORM
            varies |= ~inside | dr.any(differs)
    return varies, escapes


def _pixel_mean(trace: Callable, value: Callable, place: Callable, count: int, active: Any) -> Any:
    """Return the mean of the colour `value(interaction)` over `place(k, count)` in each active pixel, else 0."""

    def step(k: Any, total: Any) -> tuple:
        return k + 1, total + value(trace(place(k, count)))

    # An unrolled loop takes a minute to compile in a large scene and runs no faster.
    _, total = dr.while_loop((mi.UInt32(0), mi.Color3f(0)), lambda k, total: active & (k < count), step)
    return total / count


def _grid(k: Any, count: int) -> Any:
    """Return the k-th of `count` points of a square grid in the unit square."""
    side = math.isqrt(count)
    return (mi.Point2f(mi.Float(k % side), mi.Float(k // side)) + 0.5) / side


def _transmits(scene: Any, masks: bool, position: Any, **camera: Any) -> tuple:
    interaction = first_surface(scene, camera_ray(position, **camera), masks)
    valid = interaction.is_valid()
    if not any_hit(valid):
        return (False,)
    bsdf, null = interaction.bsdf(), int(mi.BSDFFlags.Null)
    # A mask has the Null flag only for its transparent parts, through which the rays have passed.
    flags = dr.select(is_mask(bsdf), bsdf.flags() ^ null, bsdf.flags())
    return (valid & mi.has_flag(flags, mi.BSDFFlags.Transmission),)
