"""Rays through the pixels of a camera, in scene units."""

from typing import Any

import drjit as dr
import mitsuba as mi

from nlt.scenes.assembly import Scene
from nlt.scenes.camera import Camera
from nlt.scenes.lanes import is_jit


def camera_values(scene: Scene, camera: Camera) -> dict[str, Any]:
    """Return scene and camera as arguments of a kernel; opaque, so that a new view reuses the compiled kernel."""
    units = scene.description.units_per_metre
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
    return {"scene": scene.mi_scene, **values}


def camera_ray(place: Any, origin: Any, du: Any, dv: Any, d0: Any) -> Any:
    """Return the ray through `place`, in pixels from the image's upper left corner; the rest are `camera_values`."""
    return mi.Ray3f(origin, dr.normalize(d0 + place.x * du + place.y * dv))


def hammersley(k: Any, count: int) -> Any:
    """Return the k-th of `count` points that are spread evenly over the unit square."""
    reversed_bits = mi.Float(dr.brev(mi.UInt32(k))) / 2**32
    return mi.Point2f((mi.Float(k) + 0.5) / count, reversed_bits + 0.5 / count)
