"""Opacity masks: rays pass through the transparent parts of a surface, like the gaps between leaves drawn on a quad."""

from typing import Any

import drjit as dr
import mitsuba as mi

from nlt.scenes.lanes import is_jit

_OPAQUE = 0.5  # A surface stops rays where its opacity is at least this.
_MOST_LAYERS = 64  # A ray passes at most this many transparent layers.


def is_mask(bsdf: Any) -> Any:
    """Return whether a BSDF may have transparent parts. Thin glass has none, although it does not refract."""
    flags, flag = bsdf.flags(), mi.BSDFFlags
    deltas = int(flag.DeltaReflection) | int(flag.DeltaTransmission)
    # Mitsuba flags the transmission of thin glass as Null too, but its other lobe is a delta.
    other_lobes = ((flags & int(flag.Smooth)) != 0) | ((flags & deltas) == 0)
    return ((flags & int(flag.Null)) != 0) & other_lobes


def is_transparent(bsdf: Any, interaction: Any) -> Any:
    """Return whether the BSDF is a mask with an opacity below one half at the interaction."""
    transmission = dr.mean(mi.Color3f(bsdf.eval_null_transmission(interaction)))
    return is_mask(bsdf) & (transmission > 1 - _OPAQUE)


def first_surface(scene: Any, ray: Any, masks: bool) -> Any:
    """Return the first interaction of a ray with a surface that is not transparent there.

    Args:
        ray: the interaction's `t` is measured from the ray's origin.
        masks: whether the scene has any masks (`Scene.masks`). Without masks, this is Mitsuba's `ray_intersect`.
    """
    interaction = scene.ray_intersect(ray)
    if not masks:
        return interaction

    def passes(interaction: Any, layers: Any) -> Any:
        if not is_jit() and not interaction.is_valid():
            return False  # A scalar ray that misses has no BSDF.
        return interaction.is_valid() & (layers < _MOST_LAYERS) & is_transparent(interaction.bsdf(), interaction)

    def step(interaction: Any, layers: Any) -> tuple:
        further = scene.ray_intersect(interaction.spawn_ray(ray.d))
        further.t += interaction.t
        return further, layers + 1

    return dr.while_loop((interaction, mi.UInt32(0)), passes, step)[0]
