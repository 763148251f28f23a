"""Direct light without noise: shadow rays to fixed points of each lamp, from where a pixel's rays end."""

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi

from nlt.rendering.rays import hammersley
from nlt.rendering.surfaces import albedo_of, any_hit, emission_of
from nlt.scenes.lanes import is_jit
from nlt.scenes.masks import first_surface

# A ray is followed from a mirror, and through a thin pane or both sides of a thick one. Through more, as in a wine
# glass, one of a pixel's few rays may find a lamp that almost no path finds, and the pixel becomes a bright dot.
_MOST_MIRRORS = 2
# Brightest highlight of `principled`, in white surfaces. Its lobes cannot be sampled one by one, so shadow rays alone
# find its highlights, and sharper ones would show their points.
_BRIGHTEST = 4
_DARK = 0.01  # seen albedo below which the direct light over it is held down


def lit_albedo(scene: Any, masks: bool, lamps: Any, places: int, rays: int, trace: Callable) -> tuple[Any, Any, Any]:
    """Return the albedo, the direct light, and the seen albedo: means over places in each pixel.

    The direct light is weighted by seen albedo. So their product is the pixel's radiance where surfaces meet, too,
    unless the pixel is almost black (`_DARK`).
    """

    def step(k: Any, albedo: Any, seen: Any, reflected: Any, light: Any) -> tuple:
        place = hammersley(k, places)
        first = trace(place)
        surface, tint, bounces, is_sharp = _through_mirrors(scene, first, masks, place)
        emission = emission_of(scene, surface)
        # Rough metal blurs a lamp. The few rays here would show sharp copies of it, far too bright.
        is_lamp = (bounces > 0) & is_sharp & dr.any(emission > 0)
        # Places on one side of the pixel see points on all sides of a lamp, or edges would be lit by one side only.
        lit, white = _lit_by_shadow_rays(scene, masks, rays, (7 * k + 5) & (places - 1), places, surface)
        lit += _lamp_in_coat(scene, masks, lamps, rays // places, surface, place) / places
        lit, white = (dr.select(is_lamp, emission, places * part) for part in (lit, white))
        own = tint * dr.select(is_lamp, 1, _seen_albedo(surface))
        return k + 1, albedo + albedo_of(first), seen + own, reflected + tint * lit, light + white

    black = mi.Color3f(0)
    start = (mi.UInt32(0), black, black, black, black)
    _, albedo, seen, reflected, light = dr.while_loop(start, lambda k, *_: k < places, step)
    direct = dr.select(seen > 0, reflected / dr.maximum(seen, places * _DARK), light / places)
    return albedo / places, direct, seen / places


def _lit_by_shadow_rays(scene: Any, masks: bool, rays: int, first: Any, stride: int, surface: Any) -> tuple[Any, Any]:
    """Return the part of the reflected light that every `stride`-th of `rays` shadow rays finds.

    First what `surface` reflects towards the camera, second what a white surface would. What shadow rays and
    `_lamp_in_coat` both find is weighted.
    """
    normal = dr.select(surface.wi.z < 0, -surface.sh_frame.n, surface.sh_frame.n)
    albedo, is_coated = albedo_of(surface), _is_coated(surface)

    def step(k: Any, lit: Any, white: Any) -> tuple:
        # The first coordinate also chooses the emitter, and the triangle of a mesh.
        place = hammersley(k, rays)
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

    One ray is reflected by the coat, and traced if it hits `lamps`, the box around all lamps. It and the `shadow_rays`
    are weighted by the balance heuristic (Veach 1997).
    """
    active, black = _is_coated(surface), mi.Color3f(0)
    if not any_hit(active):
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
    emission = dr.select(active, emission_of(scene, hit), 0)
    active &= dr.any(emission > 0)
    if not any_hit(active):
        return black
    towards = mi.DirectionSample3f(scene, hit, surface)
    chance = shadow_rays * scene.pdf_emitter_direction(surface, towards, active)
    return emission * mi.Color3f(weight) * dr.select(is_delta, 1, _share(sample.pdf, chance))


def _seen_albedo(interaction: Any) -> Any:
    """Return the share of light from along the normal that the diffuse lobe reflects to the camera.

    Under a coat it is less than the albedo, in plastic half as much if the base is dark.
    """
    valid = interaction.is_valid()
    if not any_hit(valid):
        return mi.Color3f(0)
    normal = mi.Vector3f(0, 0, dr.sign(interaction.wi.z))
    return dr.minimum(dr.pi * _lobes(interaction, normal, mi.BSDFFlags.Diffuse), albedo_of(interaction))  # no highlight


def _lobes(interaction: Any, direction: Any, kinds: Any) -> Any:
    """Return the value of the lobes of some kinds, times the cosine; of `principled`, which has no parts, of all."""
    return mi.Color3f(interaction.bsdf().eval(_only(kinds), interaction, direction, interaction.is_valid()))


def _only(kinds: Any) -> Any:
    context = mi.BSDFContext()
    context.type_mask = int(kinds)
    return context


def _gloss() -> int:
    """Return the lobes of coats, as flags."""
    return int(mi.BSDFFlags.GlossyReflection) | int(mi.BSDFFlags.DeltaReflection)


def _is_coated(surface: Any) -> Any:
    """Return whether the surface has a diffuse base under a coat, rough or smooth."""
    if not any_hit(surface.is_valid()):
        return mi.Bool(False)
    flags = surface.bsdf().flags()
    return surface.is_valid() & mi.has_flag(flags, mi.BSDFFlags.DiffuseReflection) & (flags & _gloss() != 0)


def _has_parts(diffuse: Any, gloss: Any) -> Any:
    """Return whether a BSDF's lobes have values of their own; `principled` gives the sum whichever is asked for."""
    return dr.any(mi.Color3f(diffuse) != mi.Color3f(gloss))


def _share(own: Any, other: Any) -> Any:
    """Return the weight of a sample between two ways of sampling, by the balance heuristic."""
    return own / dr.maximum(own + other, 1e-20)


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
