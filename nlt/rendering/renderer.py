"""Trace rays through a scene: radiance of any set of pixels, the G-buffer, photons.

All results are numpy arrays in metres, world coordinates and linear, unclamped RGB.
"""

import itertools
import logging
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from nlt.errors import UserError
from nlt.scenes.assembly import Scene
from nlt.scenes.camera import Camera
from nlt.scenes.lanes import freeze, is_jit, launch
from nlt.scenes.masks import first_surface, is_mask
from nlt.scenes.pointcloud import diffuse_albedo

log = logging.getLogger(__name__)

# Lanes traced at once; this bounds memory, at about 1 kB per lane.
_MAX_LANES = 1 << 20
_PILOT = 1 << 15  # photons cast per emitter to estimate how many arrive
_MOST_CASTS = 1024  # per requested photon
_WALL = 0.005  # metres by which the room shrinks, so that photons that hit a wall from outside do not cross it
# Albedo and direct light are means over so many places in each pixel. Coarse pixels show more edges; fine ones are
# those of a focal length of at least _FINE pixels. Powers of two spread evenly.
_PLACES_COARSE, _PLACES_FINE, _FINE = 8, 4, 128
_EMISSION_PLACES = 16
_SHADOW_RAYS = 16  # of a pixel to each emitter; of a fine pixel one from each place if all lamps are flat
# A ray is followed from a mirror, and through a thin pane or both sides of a thick one. Through more, as in a wine
# glass, one of a pixel's few rays may find a lamp that almost no path finds, and the pixel becomes a bright dot.
_MOST_MIRRORS = 2
_UNIFORM = 0.02  # largest difference to a neighbour's albedo up to which a pixel is its centre's


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
        self.emitters = list(scene.mi_scene.emitters())
        self._lamps = [shape for shape in scene.mi_scene.shapes() if shape.is_emitter()]
        self._radiance = freeze(_radiance if is_path else _bidirectional)
        # The second also traces shadow rays, which Dr.Jit cannot freeze for every lamp.
        self._gbuffer, self._transmits = (freeze(_gbuffer), freeze(_gbuffer)), freeze(_transmits)
        self._photons = [freeze(_photons) for _ in self.emitters]
        self._pilots: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}  # by scene.lit
        room = scene.description.room
        box = np.outer([-1e9, 1e9], np.ones(3)) if room is None else room + np.array([[_WALL], [-_WALL]])
        low, high = (box * scene.description.units_per_metre).tolist()
        self._room = {"low": mi.Point3f(low), "high": mi.Point3f(high)}
        if is_jit():
            dr.make_opaque(self._room)

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
        corner = np.stack([pixels % camera.width, pixels // camera.width], 1).astype(np.float32)
        total = np.zeros((len(pixels), 3))
        batch = max(1, min(spp, _MAX_LANES // max(len(pixels), 1)))
        fixed = self._camera_values(camera)
        if self.integrator_name == "bdpt":
            fixed["image"] = mi.Vector3f(camera.width, camera.height, len(pixels))
            dr.make_opaque(fixed["image"])
        for k, start in enumerate(range(0, spp, batch)):
            count = min(batch, spp - start)
            sampler = mi.load_dict({"type": "independent"})
            lanes = len(pixels) * count
            sub_seed = int(np.random.SeedSequence([seed, k]).generate_state(1)[0])
            sampler.seed(dr.opaque(mi.UInt32, sub_seed) if is_jit() else sub_seed, lanes if is_jit() else 1)
            corners = {"corner": ("Point2f", np.repeat(corner, count, axis=0))}
            fixed |= {"integrator": self.integrator, "sampler": sampler}
            values, *splats = launch(self._radiance, corners, **fixed)
            # Samples of a pixel are contiguous. Summing them here is deterministic; an atomic add is not.
            total += values.reshape(len(pixels), count, 3).sum(1, dtype=np.float64)
            for pixel, value in zip(splats[::2], splats[1::2], strict=True):
                lit = value.any(1)
                image = [np.bincount(pixel[lit], channel, camera.width * camera.height) for channel in value[lit].T]
                total += np.stack(image, 1)[pixels] / len(pixels)
        return (total / spp).T.astype(np.float32).reshape(shape)

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

    def _camera_values(self, camera: Camera) -> dict[str, Any]:
        """Return the camera as opaque values, so that a new view reuses the compiled kernel."""
        units = self.scene.description.units_per_metre
        right, down, forward = camera.rotation.T
        values = {
            "origin": mi.Point3f((camera.position * units).tolist()),
            # A pixel's ray direction is affine in its coordinates.
            "du": mi.Vector3f((right / float(camera.matrix[0, 0])).tolist()),
            "dv": mi.Vector3f((down / float(camera.matrix[1, 1])).tolist()),
            "d0": mi.Vector3f((forward - right * (camera.matrix[0, 2] / camera.matrix[0, 0])
                               - down * (camera.matrix[1, 2] / camera.matrix[1, 1])).tolist()),
        }  # fmt: skip
        if is_jit():
            dr.make_opaque(values)
        return {"scene": self.scene.mi_scene, **values}

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
            the mean of what is reflected of the lamps; where nothing is, what white would reflect. Rough metal shows
            another direction of its lobe in each place. A lamp in a mirror is a white surface that reflects what it
            emits; lamps and sky in rough metal are left out.
        """
        corners = np.floor(camera.centres()).astype(np.float32)
        lanes = {"corner": ("Point2f", corners), "lit": ("Float", self._may_see_lamp(camera))}
        fixed = {"masks": self.scene.masks, "sky": self.scene.environment is not None, **self._camera_values(camera)}
        fixed["size"] = mi.Vector2f(camera.width, camera.height)
        dr.make_opaque(fixed["size"])
        is_flat = self.scene.environment is None and all(lamp.primitive_count() <= 2 for lamp in self._lamps)
        is_fine = camera.matrix[0, 0] >= _FINE
        fixed["places"] = _PLACES_FINE if is_fine else _PLACES_COARSE
        rays = _PLACES_FINE if is_fine and is_flat else _SHADOW_RAYS
        fixed["shadow_rays"] = direct * len(self.emitters) * rays
        point, normal, albedo, emission, valid, *light = launch(self._gbuffer[direct], lanes, **fixed)
        metres = point.astype(float) / self.scene.description.units_per_metre
        # Depth is measured from the camera centre along the optical axis.
        depth = np.where(valid, (metres - camera.position) @ camera.rotation[:, 2], 0.0)
        buffers = {"depth": depth[:, None].astype(np.float32), "normal": np.where(valid[:, None], normal, 0)}
        buffers |= {"albedo": albedo, "emission": emission}
        if direct:
            buffers["direct"], buffers["seen_albedo"] = light
        return {name: values.T.reshape(-1, camera.height, camera.width) for name, values in buffers.items()}

    def _may_see_lamp(self, camera: Camera) -> np.ndarray:
        """Return (H W,) bool: the pixels that cover part of a lamp's bounding box. No others have a lamp's emission."""
        sees = np.zeros(camera.width * camera.height, bool)
        directions = camera.view_directions().reshape(3, -1)
        diagonal = np.hypot(1 / camera.matrix[0, 0], 1 / camera.matrix[1, 1])  # of a pixel, at depth 1
        for lamp in self._lamps:
            corners = np.array([lamp.bbox().min, lamp.bbox().max])
            box = corners / self.scene.description.units_per_metre - camera.position
            # Every ray in a pixel is at most half a diagonal away from the ray through the centre.
            margin = diagonal / 2 * np.linalg.norm(np.abs(box).max(0)) + 1e-4
            planes = (box + np.array([[-margin], [margin]])).astype(np.float32)
            with np.errstate(divide="ignore"):
                low, high = planes[:, :, None] / directions
            enter, leave = np.minimum(low, high).max(0), np.maximum(low, high).min(0)
            sees |= (enter <= leave) & (leave > 0)
        return sees

    def transmits(self, camera: Camera) -> np.ndarray:
        """Return (H, W) bool: whether the surface at the pixel centre transmits light, as glass does."""
        lanes = {"position": ("Point2f", camera.centres().astype(np.float32))}
        (transmits,) = launch(self._transmits, lanes, masks=self.scene.masks, **self._camera_values(camera))
        return transmits.reshape(camera.height, camera.width)

    def photons(self, count: int, seed: int) -> dict[str, np.ndarray]:
        """Cast photons that arrive in the room, from all emitters in proportion to the power that arrives from each.

        A photon arrives if it crosses the description's `room` before it first hits a surface; without a `room`, if it
        hits a surface. Photons are cast until `count` have arrived, with at most 1024 casts for each.

        Returns:
            photon_origin, photon_direction, photon_flux, photon_hit (count, 3) and photon_valid (count,). The expected
            sum of the flux is the arriving power. Photons that did not arrive within the limit are zero and not valid.
        """
        rng = np.random.default_rng(seed)
        lit = self.scene.lit
        if lit.key not in self._pilots:
            # Estimate, per emitter, the arriving power (mean over RGB, scene units) and the share of casts that arrive.
            uniform = np.random.default_rng(0).random((_PILOT, 5), np.float32)
            with self.scene.in_state(lit):
                casts = [self._cast(k, uniform) for k in range(len(self.emitters))]
            powers = [max(flux[arrived].sum(), flux.mean()) / (3 * _PILOT) for _, _, flux, _, arrived in casts]
            # Assume at least one arrival, so that an emitter that seems to light nothing still gets a few photons.
            shares = [max(arrived.mean(), 1 / _PILOT) for *_, arrived in casts]
            self._pilots[lit.key] = np.array(powers), np.array(shares)
        power, reach = self._pilots[lit.key]
        share = power / power.sum()
        # Systematic resampling: each emitter gets its share of the photons, rounded at random.
        edges = np.floor(np.concatenate([[0], np.cumsum(share)]) * count + rng.random())
        edges[-1] = edges[0] + count
        parts = []
        for k, number in enumerate(np.diff(edges).astype(int)):
            if number:
                origin, direction, flux, hit, valid = self._sample_arrivals(k, number, reach[k], rng)
                parts.append((origin, direction, flux * (number / (share[k] * count)), hit, valid))
        origin, direction, flux, hit, valid = (np.concatenate(column) for column in zip(*parts, strict=True))
        units = self.scene.description.units_per_metre
        return {
            "photon_origin": origin / units,
            "photon_direction": direction,
            "photon_flux": flux / units**2,
            "photon_hit": hit / units,
            "photon_valid": valid,
        }

    def _sample_arrivals(self, emitter: int, number: int, reach: float, rng: np.random.Generator) -> list[np.ndarray]:
        """Return origin, direction, flux, hit (number, 3) and valid (number,) of arriving photons of one emitter."""
        batches: list[tuple[np.ndarray, ...]] = []
        missing, cast, most = number, 0, number * _MOST_CASTS
        while missing and cast < most:
            width = min(int(1.1 * missing / reach) + 64, most - cast, _MAX_LANES)
            *columns, arrived = self._cast(emitter, rng.random((width, 5), np.float32))
            rows = np.flatnonzero(arrived)[:missing]
            batches.append(tuple(column[rows] for column in columns))
            missing -= len(rows)
            cast += width if missing else int(rows[-1]) + 1
        # Inverse binomial sampling: if casting stops at the n-th arrival after N casts, n / N is too large on average,
        # and (n - 1) / (N - 1) is unbiased (Haldane 1945). If it stops at the limit of N casts with m arrivals, m / N
        # is unbiased (Girshick et al. 1946).
        arrivals = number - missing
        share = arrivals / cast if missing or cast == 1 else (arrivals - 1) / (cast - 1)
        origin, direction, flux, hit = (np.concatenate(column) for column in zip(*batches, strict=True))
        columns = [origin, direction, flux * (share / max(arrivals, 1)), hit, np.ones(arrivals, bool)]
        return [np.concatenate([c, np.zeros((missing, *c.shape[1:]), c.dtype)]) for c in columns]

    def _cast(self, emitter: int, uniform: np.ndarray) -> tuple[np.ndarray, ...]:
        """Cast photons of an emitter: origin, direction, flux, hit (n, 3) in scene units; whether they arrive (n,)."""
        u0, u1, u2 = uniform[:, 0], uniform[:, 1:3], uniform[:, 3:]
        lanes = {"u0": ("Float", u0), "u1": ("Point2f", u1), "u2": ("Point2f", u2)}
        fixed = {"scene": self.scene.mi_scene, "masks": self.scene.masks, **self._room}
        return launch(self._photons[emitter], lanes, emitter=self.emitters[emitter], **fixed)


def sensor_to_world(camera: Camera, units_per_metre: float) -> Any:
    """Return the transform of Mitsuba's camera, which looks along +z like ours, but whose x points left and y up."""
    view_to_world = np.linalg.inv(camera.world_to_view.astype(float))
    view_to_world[:3, 3] *= units_per_metre
    return mi.ScalarTransform4f(view_to_world @ np.diag([-1.0, -1.0, 1.0, 1.0]))


def _ray(corner: Any, origin: Any, du: Any, dv: Any, d0: Any) -> Any:
    return mi.Ray3f(origin, dr.normalize(d0 + corner.x * du + corner.y * dv))


def _radiance(scene: Any, integrator: Any, sampler: Any, corner: Any, **camera: Any) -> tuple:
    # box filter: uniform in the pixel
    ray = mi.RayDifferential3f(_ray(corner + sampler.next_2d(), **camera))
    value, valid, _ = integrator.sample(scene, sampler, ray)
    return (mi.Color3f(dr.select(valid, value, 0)),)


def _bidirectional(scene: Any, integrator: Any, sampler: Any, corner: Any, image: Any, **camera: Any) -> tuple:
    from nlt.rendering.bdpt import Pinhole

    ray = _ray(corner + sampler.next_2d(), **camera)
    pinhole = Pinhole(**camera, width=image.x, height=image.y, pixels=image.z)
    value, _, splats = integrator.trace(scene, sampler, ray, pinhole)
    return (value, *(part for splat in splats for part in splat))


def _gbuffer(
    scene: Any, masks: bool, sky: bool, places: int, shadow_rays: int, corner: Any, lit: Any, size: Any, **camera: Any
) -> tuple:
    """Return point, normal, albedo, emission, whether the ray hit, and direct light. `lit` is 0 where no lamp is seen.

    It is one kernel because, however few rays a kernel traces, Dr.Jit needs 2 to 4 ms to look at the whole scene.
    """
    trace = lambda place: first_surface(scene, _ray(corner + place, **camera), masks)
    centre = trace(0.5)
    valid, albedo = centre.is_valid(), _albedo(centre)
    varies, escapes = True, True  # A scalar kernel knows only its own pixel.
    if is_jit():
        dr.eval(valid, albedo)
        varies, escapes = _compare_neighbours(valid, albedo, corner, size, sky)
    light: Any = ()
    if shadow_rays:
        mean, *light = _lit_albedo(scene, masks, places, shadow_rays, trace)
    else:
        mean = _pixel_mean(trace, _albedo, _hammersley, places, varies)
    albedo = dr.select(varies, mean, albedo)
    lit = (lit > 0) | (escapes & sky)

    emission = _pixel_mean(trace, partial(_emission, scene), _grid, _EMISSION_PLACES, lit)
    return centre.p, centre.sh_frame.n, albedo, emission, valid, *light


def _emission(scene: Any, interaction: Any) -> Any:
    emitter = interaction.emitter(scene)  # the environment if the ray escapes
    return mi.Color3f(0) if emitter is None else mi.Color3f(emitter.eval(interaction))


def _albedo(interaction: Any) -> Any:
    valid = interaction.is_valid()
    return diffuse_albedo(interaction.bsdf(), interaction, valid) if _any(valid) else mi.Color3f(0)


def _seen_albedo(interaction: Any) -> Any:
    """Return the share of light from along the normal that the diffuse lobe reflects to the camera.

    Under a coat it is less than the albedo, in plastic half as much if the base is dark.
    """
    valid = interaction.is_valid()
    if not _any(valid):
        return mi.Color3f(0)
    normal = mi.Vector3f(0, 0, dr.sign(interaction.wi.z))
    return dr.minimum(dr.pi * _diffuse_lobe(interaction, normal), _albedo(interaction))  # no highlight


def _diffuse_lobe(interaction: Any, direction: Any) -> Any:
    """Return the diffuse lobe's value times the cosine; of `principled`, which has no parts, the whole BSDF's."""
    diffuse = mi.BSDFContext()
    diffuse.type_mask = mi.BSDFFlags.Diffuse
    return mi.Color3f(interaction.bsdf().eval(diffuse, interaction, direction, interaction.is_valid()))


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


def _lit_albedo(scene: Any, masks: bool, places: int, rays: int, trace: Callable) -> tuple[Any, Any, Any]:
    """Return the albedo, the direct light, and the seen albedo: means over places in each pixel.

    The direct light is weighted by seen albedo. So their product is the pixel's radiance where surfaces meet, too.
    """

    def step(k: Any, albedo: Any, seen: Any, reflected: Any, light: Any) -> tuple:
        place = _hammersley(k, places)
        first = trace(place)
        surface, tint, bounces, is_sharp = _through_mirrors(scene, first, masks, place)
        emission = _emission(scene, surface)
        # Rough metal blurs a lamp. The few rays here would show sharp copies of it, far too bright.
        is_lamp = (bounces > 0) & is_sharp & dr.any(emission > 0)
        # Places on one side of the pixel see points on all sides of a lamp, or edges would be lit by one side only.
        lit, white = _direct(scene, masks, rays, (7 * k + 5) & (places - 1), places, surface)
        lit, white = (dr.select(is_lamp, emission, places * part) for part in (lit, white))
        own = tint * dr.select(is_lamp, 1, _seen_albedo(surface))
        return k + 1, albedo + _albedo(first), seen + own, reflected + tint * lit, light + white

    black = mi.Color3f(0)
    start = (mi.UInt32(0), black, black, black, black)
    _, albedo, seen, reflected, light = dr.while_loop(start, lambda k, *_: k < places, step)
    direct = dr.select(seen > 0, reflected / dr.maximum(seen, 1e-9), light / places)
    return albedo / places, direct, seen / places


def _direct(scene: Any, masks: bool, rays: int, first: Any, stride: int, surface: Any) -> tuple[Any, Any]:
    """Return the part of the reflected light that every `stride`-th of `rays` shadow rays finds.

    First what the diffuse lobe of `surface` reflects towards the camera, second what a white surface would reflect.
    """
    normal = dr.select(surface.wi.z < 0, -surface.sh_frame.n, surface.sh_frame.n)
    albedo = _albedo(surface)

    def step(k: Any, lit: Any, white: Any) -> tuple:
        # The first coordinate also chooses the emitter, and the triangle of a mesh.
        place = _hammersley(k, rays)
        lamp, radiance = scene.sample_emitter_direction(surface, place, not masks, surface.is_valid())
        if masks:
            ray = surface.spawn_ray_to(lamp.p)
            radiance = dr.select(first_surface(scene, ray, masks).t < ray.maxt, 0, radiance)
        # A ray stands for a part of the lamp. Seen from nearby, a disk of that area covers less than a point's square
        # law says, and at most all that is above the surface.
        is_area = mi.has_flag(lamp.emitter.flags(), mi.EmitterFlags.Surface)
        parts = dr.pi * rays * lamp.pdf  # so many would cover all above the surface
        radiance = dr.select(is_area, radiance * parts / (1 + parts), radiance)
        received = mi.Color3f(radiance) * dr.maximum(dr.dot(lamp.d, normal), 0) / dr.pi
        value = _diffuse_lobe(surface, surface.to_local(lamp.d)) * radiance
        return k + stride, lit + dr.minimum(value, albedo * received), white + received  # no highlight

    state = (mi.UInt32(first), mi.Color3f(0), mi.Color3f(0))
    _, lit, white = dr.while_loop(state, lambda k, *_: surface.is_valid() & (k < rays), step)
    return lit / rays, white / rays


def _grid(k: Any, count: int) -> Any:
    """Return the k-th of `count` points of a square grid in the unit square."""
    side = math.isqrt(count)
    return (mi.Point2f(mi.Float(k % side), mi.Float(k // side)) + 0.5) / side


def _hammersley(k: Any, count: int) -> Any:
    """Return the k-th of `count` points that are spread evenly over the unit square."""
    reversed_bits = mi.Float(dr.brev(mi.UInt32(k))) / 2**32
    return mi.Point2f((mi.Float(k) + 0.5) / count, reversed_bits + 0.5 / count)


def _through_mirrors(scene: Any, surface: Any, masks: bool, lobe: Any) -> tuple[Any, Any, Any, Any]:
    """Follow the ray that hit `surface`, off metal and through glass, to the first surface with a diffuse lobe.

    At most `_MOST_MIRRORS` surfaces are on the way. `lobe`, a point in the unit square, chooses the direction in which
    the rough ones reflect.

    Returns the interaction there, the share of its radiance that reaches the camera, the number of surfaces on the way,
    and whether none of these is rough.
    """

    def reflects(surface: Any, tint: Any, bounces: Any, is_sharp: Any) -> Any:
        if not is_jit() and not surface.is_valid():
            return False  # A scalar ray that misses has no BSDF.
        flags = surface.bsdf().flags()
        is_specular = (flags != 0) & (flags & int(mi.BSDFFlags.Diffuse) == 0)
        return surface.is_valid() & is_specular & (bounces < _MOST_MIRRORS)

    def step(surface: Any, tint: Any, bounces: Any, is_sharp: Any) -> tuple:
        # A dielectric reflects if the first number is below its reflectance.
        bsdf = surface.bsdf()
        sample, weight = bsdf.sample(mi.BSDFContext(), surface, mi.Float(0.9999), lobe)
        onward = surface.spawn_ray(surface.to_world(sample.wo))
        is_sharp &= bsdf.flags() & int(mi.BSDFFlags.Smooth) == 0  # "Smooth" are all lobes but deltas.
        return first_surface(scene, onward, masks), tint * mi.Color3f(weight), bounces + 1, is_sharp

    return dr.while_loop((surface, mi.Color3f(1), mi.UInt32(0), mi.Bool(True)), reflects, step)


def _transmits(scene: Any, masks: bool, position: Any, **camera: Any) -> tuple:
    interaction = first_surface(scene, _ray(position, **camera), masks)
    valid = interaction.is_valid()
    if not _any(valid):
        return (False,)
    bsdf, null = interaction.bsdf(), int(mi.BSDFFlags.Null)
    # A mask has the Null flag only for its transparent parts, through which the rays have passed.
    flags = dr.select(is_mask(bsdf), bsdf.flags() ^ null, bsdf.flags())
    return (valid & mi.has_flag(flags, mi.BSDFFlags.Transmission),)


def _photons(scene: Any, masks: bool, emitter: Any, low: Any, high: Any, u0: Any, u1: Any, u2: Any) -> tuple:
    ray, weight = emitter.sample_ray(mi.Float(0), u0, u1, u2)
    interaction = first_surface(scene, ray, masks)
    direction = dr.select(ray.d == 0, 1e-30, ray.d)  # the scalar variant does not divide by zero
    to_low, to_high = (low - ray.o) / direction, (high - ray.o) / direction
    enter, leave = dr.max(dr.minimum(to_low, to_high)), dr.min(dr.maximum(to_low, to_high))
    crosses = (enter < leave) & (leave > 0) & (enter < interaction.t)
    return ray.o, ray.d, mi.Color3f(weight), interaction.p, interaction.is_valid() & crosses


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


def _any(valid: Any) -> bool:
    """Return whether any ray hit. A scalar ray that misses has no BSDF; arrays mask misses themselves."""
    return True if is_jit() else bool(valid)
