"""Propose a description of a new scene: room, units, camera volume, movable objects, moving light.

All values are measured: rays find the floor, the ceiling and free space, and shapes that touch form one object. Lengths
are in scene units. In the comments below, `h` is the height of the room, usually 2.7 m.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import mitsuba as mi
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from nlt.scenes.assembly import Shape
from nlt.scenes.description import Movable, MovingLight
from nlt.scenes.lanes import launch
from nlt.scenes.pointcloud import barycentric, sample_cdf

UNITS = {"metres": 1.0, "decimetres": 10.0, "centimetres": 100.0, "millimetres": 1000.0, "inches": 39.37, "feet": 3.281}
_HEIGHT = 2.7  # metres; the height of a usual room
_TOUCH = 1 / 135  # of h: shapes closer than this touch (2 cm)
_LARGE = 0.65  # of the room along an axis: longer shapes are walls and built-in furniture
_SMALL = 1 / 25  # of h: smaller shapes are handles and screws (11 cm)
_OUTWARD = np.array([[-1], [1]])  # by which a box (2, 3) grows to all sides
_REACH = 0.75  # of h: the largest translation of an object (2 m)


@dataclass(frozen=True)
class Proposal:
    """Content of a `scene.yaml`, lengths in scene units; boxes are (2, 3). `because` holds reasons for guesses."""

    up: str
    units_per_metre: float
    bounds: np.ndarray
    room: np.ndarray
    camera: np.ndarray
    objects: tuple[Movable, ...]
    light: MovingLight
    because: Mapping[str, str]


def propose(scene: Any, shapes: Mapping[str, Shape], up: str | None) -> Proposal:
    """Propose a description of a loaded scene; `up` is the axis that the file states, or None."""
    because = {"up": "stated in the file"}
    if up is None:
        up, because["up"] = _guess_up(shapes), "most of the area that faces along an axis faces along this axis"
    rays = _Rays(scene, up)
    upright = {name: replace(shape, vertices=shape.vertices[:, rays.order]) for name, shape in shapes.items()}
    boxes = np.stack([_box(s.vertices) for s in upright.values()])
    bounds = _box(boxes.reshape(-1, 3))
    room, because["room"] = _room(rays, boxes, bounds)
    height = room[1, 2] - room[0, 2]
    unit = min(UNITS, key=lambda u: abs(np.log(height / UNITS[u] / _HEIGHT)))
    because["units_per_metre"] = (
        f"a guess: the room is {height:.4g} high, which is {height / UNITS[unit]:.2f} m if its units are {unit}"
    )
    rng = np.random.default_rng(0)
    points = {}  # each shape's vertices and random points on its surface
    for name, shape in upright.items():
        count = int(np.clip(shape.face_areas.sum() / (_TOUCH * height / 2) ** 2, 30, 20000))
        triangles = shape.vertices[shape.faces[sample_cdf(shape.face_areas, rng.random(count))]]
        on_surface = np.einsum("nk,nkd->nd", barycentric(rng.random((2, count)).T), triangles)
        points[name] = np.concatenate([shape.vertices, on_surface])
    furniture = _Furniture(rays, points, room)
    world = lambda box: box[:, np.argsort(rays.order)]
    objects = tuple(
        Movable(max(names, key=lambda n: furniture.volume([n])), tuple(names), world(moves))
        for names, moves in furniture.movable()
        if any(shapes[n].emitter is None for n in names)  # the light of a window moves only with the window
    )
    camera, because["camera"] = _camera(rays, room)
    # The light hangs under the middle of the ceiling and has a quarter of its width and length.
    size = np.ptp(room, axis=0)
    places = room.mean(0) + 0.25 * size * _OUTWARD
    places[:, 2] = room[1, 2] - 0.04 * size[2]
    light = MovingLight(0.25 * size[:2], np.array([15.0, 13.6, 11.6]), world(places))
    return Proposal(up, UNITS[unit], world(bounds), world(room), world(camera), objects, light, because)


class _Rays:
    """Casts rays in a scene, in coordinates (two horizontal axes, up). `order` are the scene's axes in this order."""

    def __init__(self, scene: Any, up: str) -> None:
        self.scene, self.order = scene, [*("xyz".index(axis) for axis in "xyz".replace(up, "")), "xyz".index(up)]

    def __call__(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return the distances (n,) to the first hits of rays (n, 3), inf for rays that hit nothing."""
        kernel = lambda origin, direction: (self.scene.ray_intersect_preliminary(mi.Ray3f(origin, direction)).t,)
        rays = np.stack(np.broadcast_arrays(origins, directions))[..., np.argsort(self.order)]
        return launch(kernel, {"origin": ("Point3f", rays[0]), "direction": ("Vector3f", rays[1])})[0].astype(float)


def _box(points: np.ndarray) -> np.ndarray:
    return np.stack([points.min(0), points.max(0)])


def _guess_up(shapes: Mapping[str, Shape]) -> str:
    """Return the axis that most area faces, like floors and ceilings; y if two axes tie."""
    area = np.zeros(3)
    for shape in shapes.values():
        size = shape.face_areas[:, None]
        area += (size * (np.abs(shape.face_normals) > 0.98 * size)).sum(0)
    return max("yzx", key=lambda u: round(float(area["xyz".index(u)]), 6))


def _grid(box: np.ndarray, layers: tuple[int, int, int]) -> np.ndarray:
    """Cell centres (n, 3) of a regular grid in a box."""
    return box[0] + (box[1] - box[0]) * (np.indices(layers).reshape(3, -1).T + 0.5) / layers


def _level(heights: np.ndarray, tolerance: float, highest: bool) -> float:
    """Return the highest or lowest height at which at least a seventh of all rays end."""
    heights = np.sort(heights)
    counts = np.searchsorted(heights, heights + tolerance) - np.arange(len(heights))
    busy = heights[counts >= max(len(heights) / 7, 1)]
    start = busy[-1] if highest else busy[0]
    return float(np.median(heights[(heights >= start - tolerance * highest) & (heights <= start + tolerance)]))


def _room(rays: _Rays, boxes: np.ndarray, bounds: np.ndarray) -> tuple[np.ndarray, str]:
    """Measure the inside of the room: vertical rays end at floor and ceiling, horizontal rays at the walls."""
    size = np.ptp(bounds, axis=0)
    small = (np.ptp(boxes, axis=1) < 0.4 * size.max()).all(1)
    centres = boxes[small].mean(1) if small.any() else bounds.mean(0)[None]
    low, high = np.quantile(centres, [0.02, 0.98], axis=0)
    contents = np.stack([low - 0.02 * size, high + 0.02 * size]).clip(*bounds)
    room, ended = bounds.astype(float).copy(), np.zeros((2, 3), bool)

    def measure(inside: np.ndarray, axes: tuple[int, ...], layers: int, tolerance: float) -> None:
        """Set the sides of the room across `axes` if enough of the rays that start all over a box end there."""
        starts = _grid(inside, (24, 24, layers))
        for k in axes:
            for side, sign in enumerate((-1, 1)):
                t = rays(starts, sign * np.eye(3)[k])
                ends = (starts[:, k] + sign * t)[np.isfinite(t)]
                if len(ends) >= len(starts) / 5:
                    room[side, k] = _level(ends, tolerance * size[k], highest=bool(side))
                    ended[side, k] = True

    middle = contents.copy()
    middle[:, 2] = np.quantile(centres[:, 2], [0.4, 0.6]) + np.array([-0.01, 0.01]) * size[2]
    measure(middle, (2,), 3, 0.01)
    height = np.ptp(room[:, 2])
    between = contents.copy()
    between[:, 2] = room[0, 2] + height * np.array([0.55, 0.9])
    measure(between, (0, 1), 4, 0.02)
    # If all contents stand on one table, the rays end on it. Measure again from the whole area between the walls, and
    # keep the new height if it differs clearly.
    before = room[:, 2].copy()
    middle[:, :2] = np.where(ended, room - 0.05 * _OUTWARD * size, contents)[:, :2]
    measure(middle, (2,), 3, 0.01)
    room[:, 2] = np.where(np.abs(room[:, 2] - before) > 0.1 * height, room[:, 2], before)
    reach = (contents + 2 * _OUTWARD * height).clip(*bounds)
    room[:, :2] = np.where(ended, room, reach)[:, :2]
    sides = {"floor": (0, 2), "ceiling": (1, 2)}
    sides |= {f"{'-+'[side]}{'xyz'[rays.order[k]]} wall": (side, k) for k in (0, 1) for side in (0, 1)}
    open_sides = [name for name, side in sides.items() if not ended[side]]
    reason = "where rays from the middle end"
    return room, reason + (f"; no rays end at the {', '.join(open_sides)}" if open_sides else "")


class _Furniture:
    """Finds groups of shapes that can move.

    Args:
        points: points (n, 3) on each shape, up along the last axis.
        room: the inside of the room (2, 3).
    """

    def __init__(self, rays: _Rays, points: Mapping[str, np.ndarray], room: np.ndarray) -> None:
        self.rays, self.points, self.room = rays, points, room
        self.boxes = {name: _box(p) for name, p in points.items()}
        self.height = room[1, 2] - room[0, 2]
        self.cell = self.height / 100

    def around(self, names: list[str]) -> np.ndarray:
        """Return the bounding box (2, 3) of a group."""
        return _box(np.concatenate([self.boxes[n] for n in names]))

    def volume(self, names: list[str]) -> float:
        return float(np.prod(np.ptp(self.around(names), axis=0) + _TOUCH * self.height))

    def _too_long(self, names: list[str]) -> bool:
        return bool((np.ptp(self.around(names), axis=0) > _LARGE * np.ptp(self.room, axis=0))[:2].any())

    def movable(self) -> list[tuple[list[str], np.ndarray]]:
        """Return groups of shapes that touch, each with its box of translations, the largest first.

        A group is built in if it is as long as the room, if nothing carries it, or if it cannot move away from a wall.
        It then loses its largest shape, and the remaining shapes are grouped again.
        """
        low, high = self.room + 0.1 * self.height * _OUTWARD
        middles = {name: box.mean(0) for name, box in self.boxes.items()}
        pending = [n for n, p in middles.items() if (p >= low).all() and (p <= high).all() and not self._too_long([n])]
        movable: list[tuple[list[str], np.ndarray]] = []
        while pending:
            labels = _touching([self.points[n] for n in pending], _TOUCH * self.height)
            groups = [[n for n, label in zip(pending, labels, strict=True) if label == k] for k in np.unique(labels)]
            pending = []
            for names in self._stacked(groups):
                box = self.around(names)
                if np.ptp(box, axis=0).max() < _SMALL * self.height:
                    continue
                moves = None if self._too_long(names) else self._translations(names)
                at_wall = bool((np.abs(box - self.room) < 0.03 * self.height)[:, :2].any())
                if moves is not None and np.ptp(moves, axis=0).max() > 0.02 * self.height:
                    movable.append((names, moves))
                elif len(names) > 1 and (moves is None or at_wall):
                    pending += sorted(set(names) - {max(names, key=lambda n: self.volume([n]))})
        return sorted(movable, key=lambda entry: -self.volume(entry[0]))

    def _stacked(self, groups: list[list[str]]) -> list[list[str]]:
        """Join groups if one box lies in the other or directly on top of it, like a table's top on its frame."""
        joined: list[list[str]] = []
        for names in sorted(groups, key=lambda names: -self.volume(names)):
            box = self.around(names)
            for other in joined:
                large = self.around(other)
                common = np.minimum(large[1], box[1]) - np.maximum(large[0], box[0])
                shared = common / np.maximum(np.ptp(box, axis=0), 1e-9)
                over = large[0, 2] > box[0, 2] and box[1, 2] > large[0, 2] - 2 * _TOUCH * self.height
                shared[2] = 1.0 if over else shared[2]
                if (shared > 0.8).all() and not self._too_long(other + names):
                    other += names
                    break
            else:
                joined.append(list(names))
        return joined

    def _translations(self, names: list[str]) -> np.ndarray | None:
        """Return the translations (2, 3) by which a group can slide over its support, or along its wall or ceiling.

        The group collides with nothing there. None if nothing carries it.
        """
        room, cell, reach = self.room, self.cell, _REACH * self.height
        own = np.concatenate([self.points[n] for n in names])
        others = np.concatenate([np.empty((0, 3)), *(p for n, p in self.points.items() if n not in names)])
        box = _box(own)
        floor = _Floor(box, reach, cell)
        blocked = floor.occupied(others[(others[:, 2] > box[0, 2] + 2 * cell) & (others[:, 2] < box[1, 2] - cell)])
        blocked[floor.rectangle(box)] = False
        centres = floor.centres(box[0, 2] + cell)
        outside = ((centres < room[0]) | (centres > room[1]))[:, :2].any(1).reshape(blocked.shape)
        carried = (self.rays(centres, np.array([0, 0, -1])) < 3 * cell).reshape(blocked.shape)
        feet = _box(own[own[:, 2] < box[0, 2] + 2 * cell])
        under, ring = np.zeros_like(blocked), np.zeros_like(blocked)
        under[floor.rectangle(feet)] = True
        ring[floor.rectangle(feet, margin=2)] = True
        ring &= ~under & ~outside  # only around its feet: under them, rays would hit the group itself
        if ring.any() and carried[ring].mean() > 0.5:
            return floor.room_to_move(blocked | outside | (~carried & ~under), reach)
        if box[1, 2] > room[1, 2] - 3 * cell and box[1, 2] - box[0, 2] < 0.5 * self.height:  # a lamp on the ceiling
            return floor.room_to_move(blocked | outside, reach / 3)
        return self._along_wall(floor, others)

    def _along_wall(self, floor: _Floor, others: np.ndarray) -> np.ndarray | None:
        """Return the translations (2, 3) of a group that hangs on a wall, or None if it does not."""
        room, box, cell = self.room, floor.box, self.cell
        thin = int(np.ptp(box, axis=0)[:2].argmin())
        gaps = np.abs(box[:, thin] - room[:, thin])
        if np.ptp(box[:, thin]) > 0.1 * self.height or gaps.min() > 0.06 * self.height:
            return None
        front = int(gaps.argmin() == 0)
        depth = (others[:, thin] - box[front, thin]) * (1 if front else -1)
        # Points level with its front, or slightly before it, block it.
        level = (depth > -cell / 2) & (depth < 3 * cell) & (others[:, 2] > box[0, 2]) & (others[:, 2] < box[1, 2])
        along = floor.centres(0)[:, 1 - thin].reshape(floor.shape)
        blocked = (along < room[0, 1 - thin]) | (along > room[1, 1 - thin])
        blocked |= floor.occupied(others[level]).any(thin, keepdims=True)
        blocked[floor.rectangle(box)] = False
        return floor.room_to_move(blocked, _REACH * self.height / 3, axes=(1 - thin,))


class _Floor:
    """A horizontal grid of square cells around a `box` (2, 3), up to a distance of `reach`."""

    def __init__(self, box: np.ndarray, reach: float, cell: float) -> None:
        area = box + reach * _OUTWARD
        self.box, self.low, self.cell = box, area[0, :2], cell
        self.shape = np.ceil(np.ptp(area, axis=0)[:2] / cell).astype(int)

    def centres(self, height: float) -> np.ndarray:
        """Return the centres (n, 3) of all cells at a height."""
        level = self.low + (np.indices(self.shape).reshape(2, -1).T + 0.5) * self.cell
        return np.column_stack([level, np.full(len(level), height)])

    def _cells(self, points: np.ndarray) -> np.ndarray:
        """Return the cells (n, 2) of points (n, 3); points outside the grid are in the nearest cell."""
        return ((points[:, :2] - self.low) / self.cell).astype(int).clip(0, self.shape - 1)

    def occupied(self, points: np.ndarray) -> np.ndarray:
        """Return whether there are points in each cell."""
        edges = [low + self.cell * np.arange(n + 1) for low, n in zip(self.low, self.shape, strict=True)]
        return np.histogram2d(points[:, 0], points[:, 1], bins=edges)[0] > 0

    def rectangle(self, box: np.ndarray, margin: int = 0) -> tuple[slice, ...]:
        """Return the cells below a box (2, 3), with a margin around them."""
        first, last = self._cells(box)
        return tuple(slice(max(a - margin, 0), b + margin + 1) for a, b in zip(first, last, strict=True))

    def room_to_move(self, blocked: np.ndarray, most: float, axes: tuple[int, ...] = (0, 1)) -> np.ndarray:
        """Return the translations (2, 3), each at most `most` long, that keep the box out of all blocked cells."""
        blocked, corners = np.pad(blocked, 1, constant_values=True), self._cells(self.box) + 1
        steps = np.zeros((2, 2), int)
        growing = [(side, k) for k in axes for side in (0, 1)]
        while growing:
            for side, k in list(growing):
                trial = steps.copy()
                trial[side, k] += 1 if side else -1
                (r0, c0), (r1, c1) = corners + trial
                if abs(trial[side, k]) > int(most / self.cell) or blocked[r0 : r1 + 1, c0 : c1 + 1].any():
                    growing.remove((side, k))
                else:
                    steps = trial
        return np.column_stack([steps * self.cell, np.zeros(2)])


def _touching(clouds: list[np.ndarray], distance: float) -> np.ndarray:
    """Label connected clouds (n,): two clouds touch if they have points in the same cell of one of two grids."""
    owner = np.repeat(np.arange(len(clouds)), [len(c) for c in clouds])
    points = np.concatenate(clouds) / distance
    cells = np.concatenate([np.column_stack([np.floor(points + k / 2), np.full(len(points), k)]) for k in (0, 1)])
    cells = (cells - cells.min(0)).astype(np.int64)
    # A graph whose nodes are the clouds and then the cells: points connect their cloud with their cells.
    _, cell = np.unique(np.ravel_multi_index(cells.T, cells.max(0) + 1), return_inverse=True)
    links = np.tile(owner, 2), len(clouds) + cell
    count = len(clouds) + cell.max() + 1
    graph = coo_array((np.ones(len(cell)), links), shape=(count, count))
    return connected_components(graph, directed=False)[1][: len(clouds)]


def _camera(rays: _Rays, room: np.ndarray) -> tuple[np.ndarray, str]:
    """Find a large box at eye height in which most points are free: nothing within a tenth of the room's height."""
    height = room[1, 2] - room[0, 2]
    box = room - 0.1 * height * _OUTWARD
    box[:, 2] = room[0, 2] + height * np.array([0.3, 0.75])
    layers = (12, 12, 4)
    cells = _grid(box, layers)
    directions = np.random.default_rng(0).normal(size=(26, 3))[:, rays.order]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    t = rays(np.repeat(cells, len(directions), 0), np.tile(directions, (len(cells), 1)))
    free = (t.reshape(len(cells), -1) > 0.1 * height).all(1).reshape(layers)
    low, high = np.zeros(3, int), np.array(layers)
    while True:
        part = free[tuple(map(slice, low, high))]
        if part.mean() >= 0.9 or max(part.shape) == 1:
            break
        # Drop the outermost layer with the least free space; if layers tie, the one of the longer axis.
        outermost = [(part.take(-side, k).mean(), -part.shape[k], k, side) for k in range(3) for side in (0, 1)]
        _, _, k, side = min(layer for layer in outermost if part.shape[layer[2]] > 1)
        low[k] += side == 0
        high[k] -= side == 1
    size = np.ptp(box, axis=0) / layers
    return np.stack([box[0] + low * size, box[0] + high * size]), f"{part.mean():.0%} of its points are free"
