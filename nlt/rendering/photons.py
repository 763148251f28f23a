"""Cast photons from every emitter of a scene (Sec. 3 of the paper)."""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from nlt.scenes.assembly import Scene
from nlt.scenes.lanes import freeze, is_jit, launch
from nlt.scenes.masks import first_surface

_PILOT = 1 << 15  # photons cast per emitter to estimate how many arrive
_MOST_CASTS = 1024  # per requested photon
_MOST_AT_ONCE = 1 << 20  # This bounds memory, at about 1 kB per photon.
_WALL = 0.005  # metres by which the room shrinks, so that photons that hit a wall from outside do not cross it


class PhotonCaster:
    """Casts the photons of a scene in its current state (`scene.set_state`)."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.emitters = list(scene.mi_scene.emitters())
        self._kernels = [freeze(_photons) for _ in self.emitters]
        self._pilots: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}  # by scene.lit
        room = scene.description.room
        box = np.outer([-1e9, 1e9], np.ones(3)) if room is None else room + np.array([[_WALL], [-_WALL]])
        low, high = (box * scene.description.units_per_metre).tolist()
        self._room = {"low": mi.Point3f(low), "high": mi.Point3f(high)}
        if is_jit():
            dr.make_opaque(self._room)

    def cast(self, count: int, seed: int) -> dict[str, np.ndarray]:
        """Cast photons until `count` have arrived, as `Renderer.photons` describes."""
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
            width = min(int(1.1 * missing / reach) + 64, most - cast, _MOST_AT_ONCE)
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
        return launch(self._kernels[emitter], lanes, emitter=self.emitters[emitter], **fixed)


def _photons(scene: Any, masks: bool, emitter: Any, low: Any, high: Any, u0: Any, u1: Any, u2: Any) -> tuple:
    ray, weight = emitter.sample_ray(mi.Float(0), u0, u1, u2)
    interaction = first_surface(scene, ray, masks)
    direction = dr.select(ray.d == 0, 1e-30, ray.d)  # the scalar variant does not divide by zero
    to_low, to_high = (low - ray.o) / direction, (high - ray.o) / direction
    enter, leave = dr.max(dr.minimum(to_low, to_high)), dr.min(dr.maximum(to_low, to_high))
    crosses = (enter < leave) & (leave > 0) & (enter < interaction.t)
    return ray.o, ray.d, mi.Color3f(weight), interaction.p, interaction.is_valid() & crosses
