"""The G-buffer: what primary rays see, and on request the direct light there."""

import itertools
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from nlt.rendering.rays import camera_ray, camera_values
from nlt.scenes.assembly import Scene
from nlt.scenes.camera import Camera
from nlt.scenes.lanes import freeze, is_jit, launch
from nlt.scenes.masks import first_surface, is_mask
from nlt.scenes.pointcloud import diffuse_albedo

# Albedo and direct light are means over so many places in each pixel. Coarse pixels show more edges; fine ones are
# those of a focal length of at least _FINE pixels. Powers of two spread evenly.
_PLACES_COARSE, _PLACES_FINE, _FINE = 8, 4, 128
_EMISSION_PLACES = 16
_SHADOW_RAYS = 16  # of a pixel to each emitter; of a fine pixel one from each place if all lamps are flat
# A ray is followed from a mirror, and through a thin pane or both sides of a thick one. Through more, as in a wine
# glass, one of a pixel's few rays may find a lamp that almost no path finds, and the pixel becomes a bright dot.
_MOST_MIRRORS = 2
# Brightest highlight of `principled`, in white surfaces. Its lobes cannot be sampled one by one, so shadow rays alone
# find its highlights, and sharper ones would show their points.
_BRIGHTEST = 4
_DARK = 0.01  # seen albedo below which the direct light over it is held down
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
        corners = np.floor(camera.centres()).astype(np.float32)
        lanes = {"corner": ("Point2f", corners), "lit": ("Float", self._may_see_lamp(camera))}
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

    def _corners_of_lamps(self) -> tuple[Any, Any]:
        """Return two opposite corners of the box around all lamps, which is everything where there is a sky."""
        if self.scene.environment is not None or not self._lamps:
            return mi.Point3f(-_FAR), mi.Point3f(_FAR)
        boxes = np.array([[lamp.bbox().min, lamp.bbox().max] for lamp in self._lamps])
        low, high = boxes[:, 0].min(0) - _MARGIN, boxes[:, 1].max(0) + _MARGIN
        return mi.Point3f(low.tolist()), mi.Point3f(high.tolist())

    def transmits(self, camera: Camera) -> np.ndarray:
        """Return (H, W) bool: whether the surface at the pixel centre transmits light, as glass does."""
        lanes = {"position": ("Point2f", camera.centres().astype(np.float32))}
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
    valid, albedo = centre.is_valid(), _albedo(centre)
    varies, escapes = True, True  # A scalar kernel knows only its own pixel.
    if is_jit():
        dr.eval(valid, albedo)
        varies, escapes = _compare_neighbours(valid, albedo, corner, size, sky)
    light: Any = ()
    if shadow_rays:
        mean, *light = _lit_albedo(scene, masks, mi.BoundingBox3f(*lamps), places, shadow_rays, trace)
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
    return dr.minimum(dr.pi * _lobes(interaction, normal, mi.BSDFFlags.Diffuse), _albedo(interaction))  # no highlight


def _lobes(interaction: Any, direction: Any, kinds: Any) -> Any:
    """Return the value of the lobes of some kinds, times the cosine; of `principled`, which has no parts, of all."""
    return mi.Color3f(interaction.bsdf().eval(_only(kinds), interaction, direction, interaction.is_valid()))


def _only(kinds: Any) -> Any:
    context = mi.BSDFContext()
    context.type_mask = int(kinds)
    return context


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


def _lit_albedo(scene: Any, masks: bool, lamps: Any, places: int, rays: int, trace: Callable) -> tuple[Any, Any, Any]:
    """Return the albedo, the direct light, and the seen albedo: means over places in each pixel.

    The direct light is weighted by seen albedo. So their product is the pixel's radiance where surfaces meet, too,
    unless the pixel is almost black (`_DARK`).
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
        lit += _lamp_in_coat(scene, masks, lamps, rays // places, surface, place) / places
        lit, white = (dr.select(is_lamp, emission, places * part) for part in (lit, white))
        own = tint * dr.select(is_lamp, 1, _seen_albedo(surface))
        return k + 1, albedo + _albedo(first), seen + own, reflected + tint * lit, light + white

    black = mi.Color3f(0)
    start = (mi.UInt32(0), black, black, black, black)
    _, albedo, seen, reflected, light = dr.while_loop(start, lambda k, *_: k < places, step)
    direct = dr.select(seen > 0, reflected / dr.maximum(seen, places * _DARK), light / places)
    return albedo / places, direct, seen / places


def _direct(scene: Any, masks: bool, rays: int, first: Any, stride: int, surface: Any) -> tuple[Any, Any]:
    """Return the part of the reflected light that every `stride`-th of `rays` shadow rays finds.

    First what `surface` reflects towards the camera, second what a white surface would. What shadow rays and
    `_lamp_in_coat` both find is weighted.
    """
    normal = dr.select(surface.wi.z < 0, -surface.sh_frame.n, surface.sh_frame.n)
    albedo, is_coated = _albedo(surface), _is_coated(surface)

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
        direction = surface.to_local(lamp.d)
        diffuse = _lobes(surface, direction, mi.BSDFFlags.Diffuse)
        gloss, chance = surface.bsdf().eval_pdf(_only(_gloss()), surface, direction, is_coated)
        held_down = dr.minimum(diffuse * radiance, (albedo + _BRIGHTEST) * received)
        chance = dr.select(lamp.delta, 0, chance)  # no reflected ray hits a point light
        value = (diffuse + gloss * _share(rays // stride * lamp.pdf, chance)) * radiance
        value = dr.select(_has_parts(diffuse, gloss), value, held_down)
        return k + stride, lit + value, white + received

    state = (mi.UInt32(first), mi.Color3f(0), mi.Color3f(0))
    _, lit, white = dr.while_loop(state, lambda k, *_: surface.is_valid() & (k < rays), step)
    return lit / rays, white / rays


def _lamp_in_coat(scene: Any, masks: bool, lamps: Any, shadow_rays: int, surface: Any, lobe: Any) -> Any:
    """Return the radiance of lamps and sky that a diffuse surface's coat reflects towards the camera.

    One ray is reflected by the coat. It and the `shadow_rays` are weighted by the balance heuristic (Veach 1997).
    """
    active, black = _is_coated(surface), mi.Color3f(0)
    if not _any(active):
        return black
    bsdf = surface.bsdf()
    sample, weight = bsdf.sample(_only(_gloss()), surface, mi.Float(0.9999), lobe, active)
    ray = surface.spawn_ray(surface.to_world(sample.wo))
    active &= (sample.pdf > 0) & lamps.ray_intersect(ray)[0]
    is_delta = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
    parts = (bsdf.eval(_only(kinds), surface, sample.wo, active) for kinds in (mi.BSDFFlags.Diffuse, _gloss()))
    active &= is_delta | _has_parts(*parts)
    ray.maxt = dr.select(active, ray.maxt, 0)
    hit = first_surface(scene, ray, masks)
    emission = dr.select(active, _emission(scene, hit), 0)
    active &= dr.any(emission > 0)
    if not _any(active):
        return black
    towards = mi.DirectionSample3f(scene, hit, surface)
    chance = shadow_rays * scene.pdf_emitter_direction(surface, towards, active)
    return emission * mi.Color3f(weight) * dr.select(is_delta, 1, _share(sample.pdf, chance))


def _gloss() -> int:
    """Return the lobes of coats, as flags."""
    return int(mi.BSDFFlags.GlossyReflection) | int(mi.BSDFFlags.DeltaReflection)


def _is_coated(surface: Any) -> Any:
    """Return whether the surface has a diffuse base under a coat, rough or smooth."""
    if not _any(surface.is_valid()):
        return mi.Bool(False)
    flags = surface.bsdf().flags()
    return surface.is_valid() & mi.has_flag(flags, mi.BSDFFlags.DiffuseReflection) & (flags & _gloss() != 0)


def _has_parts(diffuse: Any, gloss: Any) -> Any:
    """Return whether a BSDF's lobes have values of their own; `principled` gives the sum whichever is asked for."""
    return dr.any(mi.Color3f(diffuse) != mi.Color3f(gloss))


def _share(own: Any, other: Any) -> Any:
    """Return the weight of a sample between two ways of sampling, by the balance heuristic."""
    return own / dr.maximum(own + other, 1e-20)


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
    interaction = first_surface(scene, camera_ray(position, **camera), masks)
    valid = interaction.is_valid()
    if not _any(valid):
        return (False,)
    bsdf, null = interaction.bsdf(), int(mi.BSDFFlags.Null)
    # A mask has the Null flag only for its transparent parts, through which the rays have passed.
    flags = dr.select(is_mask(bsdf), bsdf.flags() ^ null, bsdf.flags())
    return (valid & mi.has_flag(flags, mi.BSDFFlags.Transmission),)


def _any(valid: Any) -> bool:
    """Return whether any ray hit. A scalar ray that misses has no BSDF; arrays mask misses themselves."""
    return True if is_jit() else bool(valid)
