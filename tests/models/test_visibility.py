"""Rendered depth and normals, the projection of points, and rays cast from the camera: three that must agree."""

import mitsuba as mi
import numpy as np
import pytest
import torch
from conftest import demo_meshes, first_hit

from nlt.models.projection import visible_pixels
from nlt.paths import scenes_root
from nlt.rendering.renderer import Renderer
from nlt.scenes.assembly import Scene
from nlt.scenes.description import load_description
from nlt.scenes.lanes import is_jit
from nlt.scenes.pointcloud import sample_points
from nlt.scenes.state import rest_state, sample_state, sample_view

pytestmark = pytest.mark.slow

NEAR = 0.5  # pixel footprints


def footprints(view, camera, buffer):
    """How far view-space points (n, 3) are from, and how far behind, what is seen around them, in pixel footprints.

    Of the planes through the surfaces at the four nearest pixel centres, the nearest counts: two arrays (n,).
    """
    matrix, size = camera.matrix.astype(float), camera.width
    xy = (view @ matrix.T)[:, :2] / view[:, 2:]
    off, behind = np.full((2, len(view)), np.inf)
    for corner in ((0, 0), (1, 0), (0, 1), (1, 1)):
        column, row = (np.floor(xy - 0.5).astype(int) + corner).clip(0, size - 1).T
        depth = buffer["depth"][0, row, column].astype(float)
        normal = buffer["normal"][:, row, column].T @ camera.world_to_view[:3, :3].T
        ray = np.linalg.solve(matrix, np.stack([column + 0.5, row + 0.5, np.ones(len(row))])).T
        away = np.sign((ray * normal).sum(1))  # of the normal, from the camera
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = ((view - ray * depth[:, None]) * normal).sum(1) * away / (depth / matrix[0, 0])
        off = np.where(depth > 0, np.minimum(off, np.abs(distance)), off)
        behind = np.where(depth > 0, np.minimum(behind, distance), -np.inf)  # of nothing, nothing is behind
    return off, behind


def check(renderer, resolution, free, state_of):
    """Return the share of visible points that the projection keeps and of hidden points that it lets through.

    `free(state, origin, points)` (n,) bool says independently of depth maps which points the origin sees.
    """
    scene, points = renderer.scene, sample_points(renderer.scene, 2000, 0)
    seen, hidden, by_depth = [], [], []
    near: dict[str, list] = {}
    for k in range(3):
        state = state_of(k)
        scene.set_state(state)
        camera = sample_view(scene.description, resolution, np.random.default_rng([k, 3]))
        offset = np.append(state.translation, np.zeros((1, 3), np.float32), 0)[points["object"]]
        present = np.append(state.present, True)[points["object"]]
        position = points["position"] + offset
        buffer = renderer.gbuffer(camera)
        arguments = (position, present, camera.matrix, camera.world_to_view, buffer["depth"], buffer["normal"])
        pixels = visible_pixels(*(torch.from_numpy(a)[None] for a in arguments))[0].numpy()
        view = (camera.world_to_view[:3, :3] @ position.T).T.astype(float) + camera.world_to_view[:3, 3]
        xy = (view @ camera.matrix.T.astype(float))[:, :2] / view[:, 2:]
        inside = present & (view[:, 2] > 0) & (xy >= 0).all(1) & (xy < resolution).all(1)
        assert (pixels[~inside] == resolution**2).all()
        pixels, view, (column, row) = pixels[inside], view[inside], xy[inside].astype(int).T
        kept = pixels < resolution**2
        assert (pixels[kept] == (row * resolution + column)[kept]).all()
        truth = free(state, camera.position, position[inside].astype(float))
        seen.append(kept[truth])
        hidden.append(kept[~truth])
        by_depth.append((view[:, 2] <= buffer["depth"][0, row, column] * (1 + 1e-3))[truth])
        changes = {
            "right": {},
            "a pixel aside": {name: np.roll(image, 1, axis=2) for name, image in buffer.items()},
            "3 % too near": {"depth": buffer["depth"] * 0.97},
            "3 % too far": {"depth": buffer["depth"] * 1.03},
        }
        for name, change in changes.items():
            off = footprints(view[truth], camera, buffer | change)
            near.setdefault(name, []).append(np.array(off) < NEAR)
    within, before = ({n: np.concatenate(v, 1)[k].mean() for n, v in near.items()} for k in (0, 1))
    seen, hidden, by_depth = (np.concatenate(column) for column in (seen, hidden, by_depth))
    assert len(seen) > 400 and len(hidden) > 400
    # What is seen lies on, and hardly ever behind, a surface that is seen: all but what falls between pixel centres.
    assert before.pop("right") >= 0.99 and within.pop("right") >= 0.97
    assert max(within.values()) < 0.8 and before["3 % too near"] < 0.8, "the test cannot tell wrong depth maps"
    assert seen.mean() > by_depth.mean() + 0.05, "no better than the nearest pixel's depth"
    return seen.mean(), hidden.mean()


# Of points that some view may see; of all the surface's, whose undersides and backs are easily told, fewer would pass.
@pytest.mark.parametrize(("resolution", "least", "most"), [(64, 0.93, 0.13), (128, 0.95, 0.07)])
def test_projection_sees_what_the_camera_sees(demo, resolution, least, most):
    def free(state, origin, points):
        triangles = np.concatenate([v[s.mesh.faces] for s, v in demo_meshes(demo, "fixed_lights", state).values()])
        distance, _, _ = first_hit(triangles, np.tile(origin, (len(points), 1)), points - origin)
        return distance > 1 - 1e-4

    renderer = Renderer(Scene(demo, "fixed_lights"))
    state_of = lambda k: sample_state(demo, "fixed_lights", np.random.default_rng([k, 4]))
    kept, leaked = check(renderer, resolution, free, state_of)
    assert kept > least and leaked < most


@pytest.fixture(scope="module")
def real_room():
    """A renderer of the real living room, and its file as Mitsuba loads it."""
    if not (scenes_root() / "living-room").is_dir():
        pytest.skip(f"the living-room is not in {scenes_root()}")
    description = load_description("real/living-room")
    return Renderer(Scene(description, "fixed_lights")), mi.load_file(str(description.path), optimize=False)


@pytest.mark.parametrize(("resolution", "least", "most"), [(64, 0.91, 0.1), (128, 0.93, 0.06)])
def test_projection_in_the_living_room(real_room, resolution, least, most):
    renderer, plain = real_room
    assert {s.id() for s in plain.shapes()} == set(renderer.scene.shapes)

    def free(state, origin, points):
        direction = points - origin
        if is_jit():
            ray = mi.Ray3f(mi.Point3f(origin.tolist()), mi.Vector3f(direction.T.astype(np.float32)), 1 - 1e-3, 0, [])
            return ~np.array(plain.ray_test(ray))
        rays = [mi.Ray3f(origin.tolist(), d.tolist(), 1 - 1e-3, 0, []) for d in direction]
        return ~np.array([plain.ray_test(ray) for ray in rays])

    state_of = lambda k: rest_state(renderer.scene.description, "fixed_lights")
    kept, leaked = check(renderer, resolution, free, state_of)
    assert kept > least and leaked < most
