"""Values of the surfaces that rays hit, for arrays of rays and for a single one."""

from typing import Any

import mitsuba as mi

from nlt.scenes.lanes import is_jit
from nlt.scenes.pointcloud import diffuse_albedo


def albedo_of(interaction: Any) -> Any:
    """Return the diffuse albedo, 0 where nothing is hit."""
    valid = interaction.is_valid()
    return diffuse_albedo(interaction.bsdf(), interaction, valid) if any_hit(valid) else mi.Color3f(0)


def emission_of(scene: Any, interaction: Any) -> Any:
    """Return the radiance that a lamp emits towards the ray's origin, or the sky where nothing is hit."""
    emitter = interaction.emitter(scene)  # the environment if the ray escapes
    return mi.Color3f(0) if emitter is None else mi.Color3f(emitter.eval(interaction))


def any_hit(valid: Any) -> bool:
    """Return whether any ray hit. A scalar ray that misses has no BSDF; arrays mask misses themselves."""
    return True if is_jit() else bool(valid)
