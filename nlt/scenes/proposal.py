"""Propose a description of a new scene: room, units, camera volume, movable objects, moving light.

All values are measured: rays find the floor, the ceiling and free space, and shapes that touch form one object. Lengths
are in scene units. In the comments below, `h` is the height of the room, usually 2.7 m.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from nlt.scenes.assembly import Shape
from nlt.scenes.description import Movable, MovingLight
from nlt.scenes.lanes import launch

UNITS = {"metres": 1.0, "decimetres": 10.0, "centimetres": 100.0, "millimetres": 1000.0, "inches": 39.37, "feet": 3.281}
_HEIGHT = 2.7  # metres; the height of a usual room
_TOUCH = 1 / 135  # of h: shapes closer than this touch (2 cm)
_LARGE = 0.65  # of the room along an axis: longer shapes are walls and built-in furniture
_SMALL = 1 / 25  # of h: smaller shapes are handles and screws (11 cm)
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
    because = {}
    bounds = _box(np.concatenate([_box(s.vertices) for s in shapes.values()]))
    if up is None:
        up, because["up"] = _guess_up(shapes), "most of the area that faces along an axis faces along this axis"
    else:
        because["up"] = "stated in the file"
    axis = "xyz".index(up)
    room, because["room"] = _room(scene, shapes, bounds, axis)
    height = room[1, axis] - room[0, axis]
    unit = min(UNITS, key=lambda u: abs(np.log(height / UNITS[u] / _HEIGHT)))
    because["units_per_metre"] = (
        f"a guess: the room is {height:.4g} high, which is {height / UNITS[unit]:.2f} m if its units are {unit}"
    )
    rng = np.random.default_rng(0)
    points = {name: _surface_points(shape, _TOUCH * height / 2, rng) for name, shape in shapes.items()}
    objects = []
    for names, box in _movable(scene, points, room, axis):
        if all(shapes[n].emitter is not None for n in names):
            continue  # the light of a window moves only with the window
        largest = max(names, key=lambda n: float(np.prod(np.ptp(_box(points[n]), axis=0) + _TOUCH * height)))
        objects.append(Movable(largest, tuple(names), box))
    camera, because["camera"] = _camera(scene, room, axis)
    return Proposal(up, UNITS[unit], bounds, room, camera, tuple(objects), _light(room, axis), because)


def _box(points: np.ndarray) -> np.ndarray:
    return np.stack([points.min(0), points.max(0)])


def _guess_up(shapes: Mapping[str, Shape]) -> str:
    """Return the axis that most area faces, like floors and ceilings; y if two axes tie."""
    area = np.zeros(3)
    for shape in shapes.values():
        a, b, c = (shape.vertices[shape.faces[:, k]] for k in range(3))
        normals = np.cross(b - a, c - a) / 2
        size = np.linalg.norm(normals, axis=1)
        flat = np.abs(normals) > 0.98 * size[:, None]
        area += (size[:, None] * flat).sum(0)
    return max("yzx", key=lambda u: round(float(area["xyz".index(u)]), 6))


def trace(scene: Any, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return the distances (n,) to the first hits, inf for rays that hit nothing."""

    def kernel(origin: Any, direction: Any) -> tuple:
        return (scene.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(origin), mi.Vector3f(direction))).t,)

    (t,) = launch(kernel, {"origin": ("Point3f", origins), "direction": ("Vector3f", directions)})
    return t.astype(float)


def _grid(box: np.ndarray, counts: tuple[int, int, int]) -> np.ndarray:
    """Cell centres (n, 3) of a regular grid in a box."""
    axes = [box[0, k] + (box[1, k] - box[0, k]) * (np.arange(n) + 0.5) / n for k, n in enumerate(counts)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _level(heights: np.ndarray, tolerance: float, highest: bool) -> float:
    """Return the highest or lowest height at which at least a seventh of all rays end."""
    heights = np.sort(heights)
    counts = np.searchsorted(heights, heights + tolerance) - np.arange(len(heights))
    busy = heights[counts >= max(len(heights) / 7, 1)]
    start = busy[-1] if highest else busy[0]
    return float(np.median(heights[(heights >= start - tolerance * highest) & (heights <= start + tolerance)]))


def _room(scene: Any, shapes: Mapping[str, Shape], bounds: np.ndarray, axis: int) -> tuple[np.ndarray, str]:
    """Measure the inside of the room: vertical rays end at floor and ceiling, horizontal rays at the walls."""
    size, across = np.ptp(bounds, axis=0), [k for k in range(3) if k != axis]
    boxes = np.stack([_box(s.vertices) for s in shapes.values()])
    small = (np.ptp(boxes, axis=1) < 0.4 * size.max()).all(1)
    centres = boxes[small].mean(1) if small.any() else bounds.mean(0)[None]
    low, high = np.quantile(centres, [0.02, 0.98], axis=0)
    contents = np.stack([low - 0.02 * size, high + 0.02 * size]).clip(*bounds)
    room, ended = bounds.astype(float).copy(), np.zeros((2, 3), bool)

    def measure(inside: np.ndarray, axes: list[int], layers: int, tolerance: float) -> None:
        """Set the sides of the room across `axes` if enough of the rays that start all over a box end there."""
        counts = [24, 24, 24]
        counts[axis] = layers
        starts = _grid(inside, (counts[0], counts[1], counts[2]))
        for k in axes:
            for side, sign in enumerate((-1, 1)):
                t = trace(scene, starts, np.tile(sign * np.eye(3)[k], (len(starts), 1)))
                ends = (starts[:, k] + sign * t)[np.isfinite(t)]
                if len(ends) >= len(starts) / 5:
                    room[side, k] = _level(ends, tolerance * size[k], highest=bool(side))
                    ended[side, k] = True

    middle = contents.copy()
    middle[:, axis] = np.quantile(centres[:, axis], [0.4, 0.6]) + np.array([-0.01, 0.01]) * size[axis]
    measure(middle, [axis], 3, 0.01)
    height = np.ptp(room[:, axis])
    between = contents.copy()
    between[:, axis] = room[0, axis] + height * np.array([0.55, 0.9])
    measure(between, across, 4, 0.02)
    outward = np.array([[-1], [1]])
    # If all contents stand on one table, the rays end on it. Measure again from the whole area between the walls, and
    # keep the new height if it differs clearly.
    before = room[:, axis].copy()
    middle[:, across] = np.where(ended, room - 0.05 * outward * size, contents)[:, across]
    measure(middle, [axis], 3, 0.01)
    room[:, axis] = np.where(np.abs(room[:, axis] - before) > 0.1 * height, room[:, axis], before)
    reach = (contents + 2 * outward * height).clip(*bounds)
    room[:, across] = np.where(ended, room, reach)[:, across]
    names = [[f"{sign}{letter} wall" for letter in "xyz"] for sign in "-+"]
    names[0][axis], names[1][axis] = "floor", "ceiling"
    open_sides = [names[side][k] for k in (axis, *across) for side in (0, 1) if not ended[side, k]]
    reason = "where rays from the middle end"
    return room, reason + (f"; no rays end at the {', '.join(open_sides)}" if open_sides else "")


def _surface_points(shape: Shape, spacing: float, rng: np.random.Generator) -> np.ndarray:
    """Return the shape's vertices and random points on its surface."""
    areas = shape.face_areas
    count = int(np.clip(areas.sum() / spacing**2, 30, 20000))
    cdf = np.cumsum(areas)
    triangle = np.searchsorted(cdf, rng.random(count) * cdf[-1]).clip(max=len(areas) - 1)
    root, other = np.sqrt(rng.random(count))[:, None], rng.random(count)[:, None]
    a, b, c = (shape.vertices[shape.faces[triangle, k]] for k in range(3))
    return np.concatenate([shape.vertices, (1 - root) * a + root * (1 - other) * b + root * other * c])


def _movable(
    scene: Any, points: Mapping[str, np.ndarray], room: np.ndarray, axis: int
) -> list[tuple[list[str], np.ndarray]]:
    """Return groups of shapes that touch, each with its box of translations, the largest first.

    A group is built in if it is as long as the room, if nothing carries it, or if it cannot move away from a wall. It
    then loses its largest shape, and the remaining shapes are grouped again.
    """
    height, size = room[1, axis] - room[0, axis], np.ptp(room, axis=0)
    level = np.arange(3) != axis
    boxes = {name: _box(p) for name, p in points.items()}
    around = lambda names: _box(np.concatenate([boxes[n] for n in names]))
    volume = lambda names: float(np.prod(np.ptp(around(names), axis=0) + _TOUCH * height))
    too_long = lambda names: bool((np.ptp(around(names), axis=0) > _LARGE * size)[level].any())
    near = room + 0.1 * height * np.array([[-1], [1]])
    pending = [n for n, b in boxes.items() if _within(b.mean(0), near) and not too_long([n])]
    movable: list[tuple[list[str], np.ndarray]] = []
    while pending:
        labels = _touching([points[n] for n in pending], _TOUCH * height)
        groups = [[n for n, label in zip(pending, labels, strict=True) if label == k] for k in np.unique(labels)]
        pending = []
        for names in _stacked(groups, around, too_long, height, axis):
            if np.ptp(around(names), axis=0).max() < _SMALL * height:
                continue
            moves = None if too_long(names) else _translations(scene, points, names, room, axis)
            if moves is not None and np.ptp(moves, axis=0).max() > 0.02 * height:
                movable.append((names, moves))
                continue
            box = around(names)
            at_wall = bool((np.abs(box - room) < 0.03 * height)[:, level].any())
            if len(names) > 1 and (moves is None or at_wall):
                pending += sorted(set(names) - {max(names, key=lambda n: volume([n]))})
    return sorted(movable, key=lambda entry: -volume(entry[0]))


def _within(point: np.ndarray, box: np.ndarray) -> bool:
    return bool(((point >= box[0]) & (point <= box[1])).all())


def _stacked(
    groups: list[list[str]],
    around: Callable[[list[str]], np.ndarray],
    too_long: Callable[[list[str]], bool],
    height: float,
    axis: int,
) -> list[list[str]]:
    """Join groups if one box lies in the other or directly on top of it, like a table's top on its frame."""
    groups = sorted(groups, key=lambda names: -float(np.prod(np.ptp(around(names), axis=0) + _TOUCH * height)))
    joined: list[list[str]] = []
    for names in groups:
        box = around(names)
        for other in joined:
            large = around(other)
            shared = (np.minimum(large[1], box[1]) - np.maximum(large[0], box[0])) / np.maximum(
                np.ptp(box, axis=0), 1e-9
            )
            over = large[0, axis] > box[0, axis] and box[1, axis] > large[0, axis] - 2 * _TOUCH * height
            shared[axis] = 1.0 if over else shared[axis]
            if (shared > 0.8).all() and not too_long(other + names):
                other += names
                break
        else:
            joined.append(list(names))
    return joined


def _touching(clouds: list[np.ndarray], distance: float) -> np.ndarray:
    """Label connected clouds (n,): two clouds touch if they have points in the same cell of a grid."""
    owner = np.repeat(np.arange(len(clouds)), [len(c) for c in clouds])
    points = np.concatenate(clouds)
    pairs = []
    for shift in (0.0, 0.5):
        cells = np.floor(points / distance + shift).astype(np.int64)
        cells -= cells.min(0)
        flat_cell = np.ravel_multi_index(cells.T, tuple(cells.max(0) + 1))
        cell, cloud = np.divmod(np.unique(flat_cell * len(clouds) + owner), len(clouds))
        same = cell[1:] == cell[:-1]
        pairs.append(np.column_stack([cloud[:-1][same], cloud[1:][same]]))
    first, second = np.concatenate(pairs).T
    graph = coo_array((np.ones(len(first)), (first, second)), shape=(len(clouds), len(clouds)))
    return connected_components(graph, directed=False)[1]


def _translations(
    scene: Any, points: Mapping[str, np.ndarray], names: list[str], room: np.ndarray, axis: int
) -> np.ndarray | None:
    """Return the translations (2, 3) by which a group can slide over its support, or along its wall or ceiling.

    The group collides with nothing there. None if nothing carries it.
    """
    height = room[1, axis] - room[0, axis]
    cell, reach = height / 100, _REACH * height
    b, c = (k for k in range(3) if k != axis)
    own = np.concatenate([points[n] for n in names])
    box = _box(own)
    low, high = box[0] - reach, box[1] + reach
    shape = tuple(int(np.ceil((high[k] - low[k]) / cell)) for k in (b, c))
    at = lambda p: tuple(
        np.floor((p[:, k] - low[k]) / cell).astype(int).clip(0, n - 1) for k, n in zip((b, c), shape, strict=True)
    )
    blocked = np.zeros(shape, bool)
    for name, cloud in points.items():
        if name not in names:
            near = (cloud[:, [b, c]] > low[[b, c]]).all(1) & (cloud[:, [b, c]] < high[[b, c]]).all(1)
            near &= (cloud[:, axis] > box[0, axis] + 2 * cell) & (cloud[:, axis] < box[1, axis] - cell)
            blocked[at(cloud[near])] = True
    centres = np.zeros((shape[0] * shape[1], 3))
    rows, columns = np.indices(shape).reshape(2, -1)
    centres[:, b], centres[:, c] = low[b] + (rows + 0.5) * cell, low[c] + (columns + 0.5) * cell
    outside = ~((centres >= room[0]) & (centres <= room[1]))[:, [b, c]].all(1).reshape(shape)
    centres[:, axis] = box[0, axis] + cell
    t = trace(scene, centres, np.tile(-np.eye(3)[axis], (len(centres), 1)))
    carried = (t < 3 * cell).reshape(shape)
    first, last = (np.array(at(box[[k]])).ravel() for k in (0, 1))
    foot = _box(own[own[:, axis] < box[0, axis] + 2 * cell])
    (r0, c0), (r1, c1) = (np.array(at(foot[[k]])).ravel() for k in (0, 1))
    under, ring = np.zeros(shape, bool), np.zeros(shape, bool)
    under[r0 : r1 + 1, c0 : c1 + 1] = True
    ring[max(r0 - 2, 0) : r1 + 3, max(c0 - 2, 0) : c1 + 3] = True
    ring &= ~under & ~outside  # only around its feet: under them, rays would hit the group itself
    result = np.zeros((2, 3))
    blocked[first[0] : last[0] + 1, first[1] : last[1] + 1] = False
    if ring.any() and carried[ring].mean() > 0.5:
        steps = _grow(blocked | outside | (~carried & ~under), first, last, int(reach / cell))
        result[:, b], result[:, c] = steps[:, 0] * cell, steps[:, 1] * cell
        return result
    if box[1, axis] > room[1, axis] - 3 * cell and box[1, axis] - box[0, axis] < 0.5 * height:  # a lamp on the ceiling
        steps = _grow(blocked | outside, first, last, int(reach / 3 / cell))
        result[:, b], result[:, c] = steps[:, 0] * cell, steps[:, 1] * cell
        return result
    thin = min((b, c), key=lambda k: box[1, k] - box[0, k])
    along = c if thin == b else b
    gaps = np.abs(box[:, thin] - room[:, thin])
    if box[1, thin] - box[0, thin] > 0.1 * height or gaps.min() > 0.06 * height:
        return None
    # It hangs on a wall: points level with its front, or slightly before it, block it.
    side = int(gaps.argmin() == 0)
    sign = 1 if side else -1
    stop = np.zeros((shape[(b, c).index(along)], 1), bool)
    for name, cloud in points.items():
        depth = sign * (cloud[:, thin] - box[side, thin])
        hit = (
            (depth > -cell / 2) & (depth < 3 * cell) & (cloud[:, axis] > box[0, axis]) & (cloud[:, axis] < box[1, axis])
        )
        if name not in names:
            stop[np.floor((cloud[hit, along] - low[along]) / cell).astype(int).clip(0, len(stop) - 1)] = True
    k = (b, c).index(along)
    places = low[along] + (np.arange(len(stop)) + 0.5) * cell
    stop[:, 0] |= (places < room[0, along]) | (places > room[1, along])
    stop[first[k] : last[k] + 1] = False
    steps = _grow(stop, np.array([first[k], 0]), np.array([last[k], 0]), int(reach / 3 / cell))
    result[:, along] = steps[:, 0] * cell
    return result


def _grow(blocked: np.ndarray, first: np.ndarray, last: np.ndarray, most: int) -> np.ndarray:
    """Return by how many cells (2, 2) a rectangle can grow to each side without reaching a blocked cell."""
    steps = np.zeros((2, 2), int)
    growing = [(side, k) for k in (0, 1) for side in (0, 1)]
    while growing:
        for side, k in list(growing):
            trial = steps.copy()
            trial[side, k] += 1 if side else -1
            (r0, c0), (r1, c1) = first + trial[0], last + trial[1]
            inside = r0 >= 0 and c0 >= 0 and r1 < blocked.shape[0] and c1 < blocked.shape[1]
            if abs(trial[side, k]) > most or not inside or blocked[r0 : r1 + 1, c0 : c1 + 1].any():
                growing.remove((side, k))
            else:
                steps = trial
    return steps


def _camera(scene: Any, room: np.ndarray, axis: int) -> tuple[np.ndarray, str]:
    """Find a large box at eye height in which most points are free: nothing within a tenth of the room's height."""
    height = room[1, axis] - room[0, axis]
    box = room + 0.1 * height * np.array([[1], [-1]])
    box[:, axis] = room[0, axis] + height * np.array([0.3, 0.75])
    counts = [12, 12, 12]
    counts[axis] = 4
    cells = _grid(box, (counts[0], counts[1], counts[2]))
    directions = np.random.default_rng(0).normal(size=(26, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    t = trace(scene, np.repeat(cells, len(directions), 0), np.tile(directions, (len(cells), 1)))
    free = (t.reshape(len(cells), -1) > 0.1 * height).all(1).reshape(counts)
    low, high = [0, 0, 0], list(counts)
    while True:
        part = free[low[0] : high[0], low[1] : high[1], low[2] : high[2]]
        if part.mean() >= 0.9 or max(part.shape) == 1:
            break
        # Drop the outermost layer with the least free space; if layers tie, the one of the longer axis.
        layers = [(part.take(-side, k).mean(), -part.shape[k], k, side) for k in range(3) for side in (0, 1)]
        _, _, k, side = min(layer for layer in layers if part.shape[layer[2]] > 1)
        low[k] += side == 0
        high[k] -= side == 1
    size = np.ptp(box, axis=0) / counts
    return np.stack([box[0] + low * size, box[0] + high * size]), f"{part.mean():.0%} of its points are free"


def _light(room: np.ndarray, axis: int) -> MovingLight:
    """Place a light under the middle of the ceiling, with a quarter of its width and length."""
    level = [k for k in range(3) if k != axis]
    size = np.ptp(room, axis=0)
    box = np.stack([room.mean(0), room.mean(0)])
    box[:, level] += np.outer([-0.25, 0.25], size[level])
    box[:, axis] = room[1, axis] - 0.04 * size[axis]
    return MovingLight(0.25 * size[level], np.array([15.0, 13.6, 11.6]), box)
