"""Views are taken from inside the room and outside its objects, wherever these have moved."""

import numpy as np
import pytest
import trimesh
from conftest import write_room

from nlt.errors import UserError
from nlt.scenes.assembly import Scene
from nlt.scenes.camera import Camera
from nlt.scenes.description import load_description
from nlt.scenes.state import SceneState, sample_view
from nlt.scenes.views import Views

CRATE = np.array([[-0.6, 0, 0.05], [-0.2, 0.5, 0.35]])


def crowded(folder, inside_out=False, scale=1.0):
    """The white room with a camera box that reaches through its walls and into its crate."""
    box = np.array([[-1.5, 0.1, -1.5], [1.5, 2.5, 1.5]]) * scale
    file = write_room(folder, scale, camera={"min": box[0].tolist(), "max": box[1].tolist()})
    if inside_out:
        room = trimesh.load(folder / "room.ply", process=False)
        room.invert()
        room.export(folder / "room.ply")
    return Scene(load_description(str(file)), "fixed_lights")


@pytest.mark.parametrize(("inside_out", "scale"), [(False, 1.0), (True, 1.0), (False, 10.0)])
def test_from_inside_the_room_only(tmp_path, inside_out, scale):
    """Also of a mesh whose faces all look outwards, and in a scene that is not in metres."""
    scene = crowded(tmp_path, inside_out, scale)
    views, rng = Views(scene), np.random.default_rng(0)
    for k in range(60):
        offset = 0.6 * (k % 2)  # the crate at either end of its box
        scene.set_state(SceneState(np.array([[offset, 0, 0]], np.float32), np.array([True])))
        x, y, z = position = views.sample(16, rng).position
        assert max(abs(x), abs(z), abs(y - 1)) < 1, "inside the room"
        inside = ((position > CRATE[0] + [offset, 0, 0]) & (position < CRATE[1] + [offset, 0, 0])).all()
        assert not inside, "not inside the crate"
    # Hardly anything but these is turned down.
    free = [sample_view(scene.description, 16, rng) for _ in range(100)]
    free = [c for c in free if (np.abs(c.position - [0, 1, 0]) < 0.75).all() and c.position[1] > 0.75]
    assert len(free) > 5 and np.mean([views.passes(camera) for camera in free]) > 0.9


def test_before_the_lens(tmp_path):
    scene = crowded(tmp_path)
    look = lambda x: Camera.look_at(np.array([x, 1, 0]), np.array([1, 1, 0]), np.array([0, 1, 0]), 70, 8, 8)
    shares = [Views(scene).shares(look(x)) for x in (0.95, 0.45)]
    assert shares[0]["near"] > 0.9 and shares[1]["near"] == 0 and shares[0]["back"] == shares[1]["back"] == 0


def test_what_rays_meet(tmp_path):
    """The shares of backs and of nothing, from above a floor, from below and from beside it."""
    views = Views(Scene(load_description(str(write_room(tmp_path, is_open=True))), "fixed_lights"))
    up = np.array([0, 1, 0])
    above = views.shares(Camera.look_at(np.array([0.5, 1.0, -0.5]), np.array([0, 0, 0.2]), up, 40, 8, 8))
    below = views.shares(Camera.look_at(np.array([0.5, -1.0, -0.5]), np.array([0, 0, 0.2]), up, 40, 8, 8))
    beside = views.shares(Camera.look_at(np.array([0.5, 1.0, -5.0]), np.array([0.5, 1.0, -9.0]), up, 40, 8, 8))
    assert above["back"] == 0 and below["back"] > 0.9 and beside["nothing"] == 1
    # A 2 x 2 m floor 1 m below its middle fills a sixth of the sphere: it is the side of a cube.
    middle = views.shares(Camera.look_at(np.array([0, 1.0, 0]), np.array([0, 0, 0.01]), up, 40, 8, 8))
    assert middle["nothing"] == pytest.approx(5 / 6, abs=0.05)


def test_no_view_is_left(tmp_path):
    file = write_room(tmp_path, camera={"min": [3, 0, 3], "max": [4, 1, 4]})
    views = Views(Scene(load_description(str(file)), "fixed_lights"))
    with pytest.raises(UserError, match=r"scene.yaml: camera: none of 100 random views shows the room"):
        views.sample(16, np.random.default_rng(0))


def test_a_stage_seen_from_outside(tmp_path):
    """Cameras outside the room's box may have nothing behind them; those that look past the stage are turned down."""
    camera, room = {"min": [-0.3, 2, 2], "max": [0.3, 2.5, 2.5]}, [[-1, 0, -1], [1, 1, 1]]
    look_at = {"min": [-0.1, 0, -0.1], "max": [0.1, 0, 0.1]}
    scene = lambda **more: Scene(
        load_description(str(write_room(tmp_path, is_open=True, camera=camera, **more))), "static"
    )
    views, rng = Views(scene(look_at=look_at, room=room, fov=30)), np.random.default_rng(0)
    assert views.sample(16, rng).position[2] > 2
    past = {"min": [4, 0, 0], "max": [5, 0, 0]}
    for other in (scene(look_at=past, room=room, fov=30), scene(look_at=look_at, fov=30)):
        with pytest.raises(UserError, match="none of 100 random views shows the room"):
            Views(other).sample(16, rng)
