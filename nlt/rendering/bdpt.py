"""Bidirectional path tracing as a Mitsuba integrator, `mi.load_dict({"type": "bdpt"})` (Veach's thesis, ch. 10).

Import this module after a JIT variant has been activated, because Mitsuba's classes belong to the variant.

A path v_0 (on an emitter) ... v_k (the camera) can be sampled by several strategies: strategy s samples the first s
vertices by a light subpath and the others by a camera subpath, for s = 0 ... S. s < k unless light subpaths may be
connected to the camera itself (not for k = 1: an emitter in view is left to s = 0). Let P(v_i) be the density per area
with which the light subpath samples v_i, and p(v_i) that of the camera subpath. Strategies s and s + 1 differ in one
vertex, so their path densities have the ratio p_{s+1} / p_s = P(v_s) / p(v_s) =: r_s. The balance heuristic is then

    1 / w_s = 1 + r_s (1 + r_{s+1} (1 + ...)) + 1/r_{s-1} (1 + 1/r_{s-2} (1 + ...)).

The first sum has at most S - s terms, so that the weights of the existing strategies add up to one. At a specular
vertex, the strategies that would connect it have density zero, so their "1 +" is missing; both densities of a specular
direction count as 1. The ratio at a vertex depends on the vertex after the next one, through the density q with which
the next vertex samples the way back. A subpath x_0 x_1 ... therefore carries B_m, the nested sum of the m ratios before
the current vertex, without that q. B_m is the same for both subpaths, with P in place of p for the light subpath:

    B_m(x_j) = |cos x_{j-1}| / (|x_j - x_{j-1}|^2 p(x_{j-1})) (c + q(x_{j-1}) B_{m-1}(x_{j-1})), B_0 = 0,

where c is 1 if neither x_{j-1} nor x_{j-2} is specular, else 0. No vertex of the camera subpath has to be stored. The
weights ignore Russian roulette.

A pixel gets n camera subpaths, but all n * (number of pixels) light subpaths may reach it. In connections to the
camera, the density of the camera's directions within a pixel is therefore divided by the number of pixels.

Emitters other than area lights (environment, point, spot, directional) start no light subpaths. Their light comes by
s = 0 and s = 1, and the weights account for this.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi


@dataclass
class Pinhole:
    """A camera to which light subpaths are connected.

    The pixel coordinates (x, y) are seen along `d0` + x `du` + y `dv`, whose component along the optical axis is one.
    `width` and `height` are those of the image; `pixels` is the number of pixels traced.
    """

    origin: mi.Point3f
    du: mi.Vector3f
    dv: mi.Vector3f
    d0: mi.Vector3f
    width: mi.Float
    height: mi.Float
    pixels: mi.Float

    def cosine(self, direction: Any) -> Any:
        """Cosine of the angle between a direction and the optical axis."""
        return dr.dot(direction, dr.normalize(dr.cross(self.du, self.dv)))

    def density(self, cosine: Any) -> Any:
        """Density per solid angle of the directions sampled within a pixel."""
        return dr.rcp(dr.norm(self.du) * dr.norm(self.dv) * cosine * dr.square(cosine))

    def pixel(self, direction: Any) -> tuple:
        """Return the flat index of the pixel in which a direction lies, and whether there is one."""
        offset = direction / self.cosine(direction) - self.d0
        x, y = (dr.floor(dr.dot(offset, axis) / dr.squared_norm(axis)) for axis in (self.du, self.dv))
        inside = (x >= 0) & (y >= 0) & (x < self.width) & (y < self.height)
        return dr.select(inside, mi.UInt32(y) * mi.UInt32(self.width) + mi.UInt32(x), 0), inside


@dataclass
class _Step:
    """A segment of a subpath, from an origin along `ray`.

    `weight`: the throughput. `pdf`: the density of the direction per solid angle. `smooth`: 1 if the origin scattered
    smoothly, so that it could have been connected, else 0. `inverse`: |cos| at the origin / its density per area.
    `terms`: c + q B_{m-1} at the origin, for m = 1 ... S - 1.
    """

    ray: mi.Ray3f
    weight: mi.Color3f
    pdf: mi.Float
    smooth: mi.Float
    inverse: mi.Float
    terms: list[mi.Float]


@dataclass
class _Vertex:
    """The end of a step, with its `weight` and `smooth`. `inverse`: 1 / density per area. `ratio`: B_{S-1}."""

    si: mi.SurfaceInteraction3f
    weight: mi.Color3f
    smooth: mi.Float  # not a boolean: Dr.Jit 1.5 generates invalid LLVM code for booleans in local memory
    inverse: mi.Float
    ratio: mi.Float


@dataclass
class _Splat:
    pixel: mi.UInt32
    radiance: mi.Color3f


class BDPT(mi.SamplingIntegrator):
    """An unbiased integrator of infinite depth. Parameters: `light_vertices` (S >= 2), `rr_depth` as in `path`."""

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        self.stored = props.get("light_vertices", 5) - 1  # the vertex on the emitter is not stored
        self.rr_depth = props.get("rr_depth", 5)

    def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True) -> tuple:
        """Return radiance along `ray`, whether it is valid, and no AOVs, as every Mitsuba integrator does."""
        radiance, hit, _ = self.trace(scene, sampler, ray, None, active)
        return radiance, hit, []

    def trace(self, scene: Any, sampler: Any, ray: Any, camera: Pinhole | None, active: Any = True) -> tuple:
        """Trace as `sample` does and, if the `camera` of `ray` is given, connect light subpaths to it.

        Returns:
            Radiance along `ray`, whether it is valid, and S - 1 splats (pixel, radiance) of every lane's light
            subpath. A pixel's estimate is the mean radiance of its rays plus its splats / number of all rays.
        """
        active = mi.Bool(active)
        light, count, splats = self._light_subpath(scene, sampler, camera, active)
        radiance, hit = self._camera_subpath(scene, sampler, mi.Ray3f(ray), camera, light, count, active)
        hit |= scene.environment() is not None
        lane_splats = [splats[k] for k in range(self.stored)] if camera else []
        return radiance, hit, [(splat.pixel, splat.radiance) for splat in lane_splats]

    @dr.syntax
    def _light_subpath(self, scene: Any, sampler: Any, camera: Any, active: Any) -> tuple:
        """Return the vertices after the one on an area light, their number and their splats."""
        index, inverse_pmf, _ = scene.sample_emitter(sampler.next_1d(active), active)
        emitter: Any = dr.gather(mi.EmitterPtr, scene.emitters_dr(), index, active)
        active = active & _starts_subpaths(emitter)
        origin, inverse_pdf = emitter.sample_position(mi.Float(0), sampler.next_2d(active), active)
        local = mi.warp.square_to_cosine_hemisphere(sampler.next_2d(active))
        wavelengths: Any = dr.zeros(mi.Color0f)
        si = mi.SurfaceInteraction3f(origin, wavelengths)
        si.shape, si.wi = emitter.get_shape(), local
        inverse = dr.select(active, inverse_pmf * inverse_pdf, 0)
        step = _Step(
            ray=si.spawn_ray(si.to_world(local)),
            weight=emitter.eval(si, active) * inverse * dr.pi,  # cosine / its density
            pdf=local.z / dr.pi,
            smooth=mi.Float(1),
            inverse=local.z * inverse,
            terms=[mi.Float(1) for _ in range(self.stored)],  # s = 0
        )
        context = mi.BSDFContext(mi.TransportMode.Importance)
        vertices = dr.alloc_local(_Vertex, self.stored)
        splats = dr.alloc_local(_Splat, self.stored, _Splat(mi.UInt32(0), mi.Color3f(0)))
        count = mi.UInt32(0)
        active = active & dr.any(step.weight != 0)
        while active:
            vertex, ratios = _arrive(scene, step, active)
            active &= vertex.si.is_valid()
            if active:
                vertices[count] = vertex
                if dr.hint(camera is not None, mode="scalar"):
                    splats[count] = _splat(context, scene, camera, vertex, active)
                count += 1
            active &= count < self.stored
            step, _ = _scatter(context, sampler, vertex, ratios, active)
            active &= dr.any(step.weight != 0)
        return vertices, count, splats

    @dr.syntax
    def _camera_subpath(
        self, scene: Any, sampler: Any, ray: Any, camera: Any, light: Any, count: Any, active: Any
    ) -> tuple:
        context = mi.BSDFContext()
        active = mi.Bool(active)
        radiance, hit = mi.Color3f(0), mi.Bool(False)
        depth, eta = mi.UInt32(0), mi.Float(1)
        # Infinite without a camera, because no light subpath can then sample the first vertex.
        pdf = mi.Float(dr.inf) if camera is None else camera.density(camera.cosine(ray.d)) / camera.pixels
        terms = [mi.Float(0) for _ in range(self.stored)]
        step = _Step(ray, mi.Color3f(1), pdf, smooth=mi.Float(1), inverse=mi.Float(0), terms=terms)
        while active:
            vertex, ratios = _arrive(scene, step, active)
            radiance += _emission(scene, step, vertex, depth == 0, active)
            active &= vertex.si.is_valid()
            hit |= active
            smooth = active & mi.has_flag(vertex.si.bsdf().flags(), mi.BSDFFlags.Smooth)
            radiance += _emitter_sample(context, scene, sampler, vertex, ratios, smooth)
            radiance += self._connections(context, scene, vertex, ratios, light, count, smooth)
            step, ior = _scatter(context, sampler, vertex, ratios, active)
            eta *= ior
            depth += 1
            brightest = dr.max(step.weight)
            active &= brightest != 0
            survival = dr.select(depth > self.rr_depth, dr.minimum(brightest * dr.square(eta), 0.95), 1)
            active &= sampler.next_1d(active) < survival
            step.weight /= survival
        return radiance, hit

    @dr.syntax
    def _connections(
        self, context: Any, scene: Any, vertex: Any, ratios: Any, light: Any, count: Any, active: Any
    ) -> Any:
        """s = 2 ... S: connect a vertex to each vertex of the light subpath."""
        si = vertex.si
        adjoint = mi.BSDFContext(mi.TransportMode.Importance)
        radiance = mi.Color3f(0)
        k = mi.UInt32(0)  # s - 2
        while active & (k < count):
            other = light[k]
            to = other.si.p - si.p
            square = dr.squared_norm(to)
            direction = to * dr.rsqrt(square)
            near, far = (dr.abs(dr.dot(n, direction)) / square for n in (si.n, other.si.n))
            value, forward, back = _evaluate(context, si, direction, active)
            light_value, light_forward, light_back = _evaluate(adjoint, other.si, -direction, active)
            value *= vertex.weight * other.weight * light_value * _correction(other.si, -direction) / square
            others = _others(other, forward * far, light_back, other.ratio)
            # The other sum has S - s terms, and none for s = S.
            for m, ratio in enumerate(ratios[:-2]):
                others += dr.select(k + m == self.stored - 2, _others(vertex, light_forward * near, back, ratio), 0)
            value = _finite(value / (1 + others))
            lit = active & dr.any(value != 0)
            lit &= ~scene.ray_test(si.spawn_ray_to(other.si.p), lit)
            radiance += dr.select(lit, value, 0)
            k += 1
        return radiance


def _emission(scene: Any, step: Any, vertex: Any, in_view: Any, active: Any) -> Any:
    """s = 0: the camera subpath hits an emitter."""
    si = vertex.si
    emitter = si.emitter(scene, active)
    reference = dr.zeros(mi.Interaction3f)
    reference.p = step.ray.o
    sampled = scene.pdf_emitter_direction(reference, mi.DirectionSample3f(scene, si, reference), active)
    back = dr.select(si.is_valid() & _starts_subpaths(emitter), mi.Frame3f.cos_theta(si.wi) / dr.pi * vertex.ratio, 0)
    others = dr.select(in_view, 0, sampled / step.pdf * (step.smooth + back))
    return _finite(step.weight * emitter.eval(si, active) / (1 + others))


def _emitter_sample(context: Any, scene: Any, sampler: Any, vertex: Any, ratios: Any, active: Any) -> Any:
    """s = 1: connect a vertex to a point sampled on an emitter."""
    si = vertex.si
    ds, weight = scene.sample_emitter_direction(si, sampler.next_2d(active), True, active)
    value, forward, back = _evaluate(context, si, ds.d, active)
    emitted = dr.select(_starts_subpaths(ds.emitter), dr.maximum(-dr.dot(ds.d, ds.n), 0) / dr.pi, 0)
    density = emitted * dr.abs(dr.dot(si.n, ds.d)) / dr.square(ds.dist)
    others = dr.select(ds.delta, 0, forward / ds.pdf + _others(vertex, density, back, ratios[-2]))
    return dr.select(active & (ds.pdf != 0), _finite(vertex.weight * value * weight / (1 + others)), 0)


def _splat(context: Any, scene: Any, camera: Any, vertex: Any, active: Any) -> Any:
    """t = 1: connect a vertex of the light subpath to the camera."""
    si = vertex.si
    to = camera.origin - si.p
    square = dr.squared_norm(to)
    direction = to * dr.rsqrt(square)
    cosine = camera.cosine(-direction)
    pixel, inside = camera.pixel(-direction)
    active = active & inside & (cosine > 0)
    value, _, back = _evaluate(context, si, direction, active)
    density = camera.density(cosine) / square
    camera_density = density / camera.pixels * dr.abs(dr.dot(si.n, direction))
    value *= vertex.weight * _correction(si, direction) * density
    value = _finite(value / (1 + _others(vertex, camera_density, back, vertex.ratio)))
    active = active & dr.any(value != 0)
    active = active & ~scene.ray_test(si.spawn_ray_to(camera.origin), active)
    return _Splat(pixel, dr.select(active, value, 0))


def _arrive(scene: Any, step: Any, active: Any) -> tuple:
    """Return the vertex to which a step leads, and its B_0 ... B_{S-1}."""
    si = scene.ray_intersect(step.ray, active)
    square = dr.square(si.t)
    inverse = square / (step.pdf * dr.abs(dr.dot(si.n, step.ray.d)))
    ratios = [mi.Float(0), *(step.inverse / square * term for term in step.terms)]
    return _Vertex(si, step.weight, step.smooth, inverse, ratios[-1]), ratios


def _scatter(context: Any, sampler: Any, vertex: Any, ratios: Any, active: Any) -> tuple:
    """Sample the next step from a vertex; return it and the relative index of refraction that it crosses."""
    si = vertex.si
    bsdf = si.bsdf()
    sample, weight = bsdf.sample(context, si, sampler.next_1d(active), sampler.next_2d(active), active)
    direction = si.to_world(sample.wo)
    if context.mode == mi.TransportMode.Importance:
        weight *= _correction(si, direction)
    specular = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
    back = dr.select(specular, 1, bsdf.pdf(context, _turned(si, sample.wo), si.wi, active & ~specular))
    smooth = dr.select(specular, mi.Float(0), 1)
    step = _Step(
        ray=si.spawn_ray(direction),
        weight=_finite(vertex.weight * weight),
        pdf=dr.select(specular, 1, sample.pdf),
        smooth=smooth,
        inverse=vertex.inverse * dr.abs(dr.dot(si.n, direction)),
        terms=[smooth * vertex.smooth + back * ratio for ratio in ratios[:-1]],
    )
    return step, sample.eta


def _others(vertex: Any, density: Any, back: Any, ratio: Any) -> Any:
    """Sum the densities of the strategies in which the other subpath samples at least `vertex`, relative to this one.

    Args:
        density: the density per area with which the other subpath samples the vertex.
        back: the density per solid angle with which it continues from there to the previous vertex.
    """
    return density * vertex.inverse * (vertex.smooth + back * ratio)


def _evaluate(context: Any, si: Any, direction: Any, active: Any) -> tuple:
    """Return BSDF times cosine, and the densities of `direction` and of the way back."""
    bsdf, local = si.bsdf(), si.to_local(direction)
    value, forward = bsdf.eval_pdf(context, si, local, active)
    return value, forward, bsdf.pdf(context, _turned(si, local), si.wi, active)


def _turned(si: Any, local: Any) -> Any:
    """Return the interaction with another incident direction."""
    turned = mi.SurfaceInteraction3f(si)
    turned.wi = local
    return turned


def _correction(si: Any, direction: Any) -> Any:
    """Factor for light that leaves along `direction`: shading normals break the symmetry (Veach, Sec. 5.3.2)."""
    shaded = mi.Frame3f.cos_theta(si.wi) * dr.dot(si.n, direction)
    return dr.abs(shaded / (dr.dot(si.sh_frame.n, direction) * dr.dot(si.n, si.to_world(si.wi))))


def _starts_subpaths(emitter: Any) -> Any:
    """Return whether light subpaths start on an emitter; they start only on area lights."""
    flags = emitter.flags()
    return mi.has_flag(flags, mi.EmitterFlags.Surface) & ~mi.has_flag(flags, mi.EmitterFlags.Delta)


def _finite(value: Any) -> Any:
    """Replace undefined values by 0, like 0 / 0 at a right angle."""
    return dr.select(dr.all(dr.isfinite(value)), value, 0)


mi.register_integrator("bdpt", BDPT)
