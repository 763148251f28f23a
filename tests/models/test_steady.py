"""The accumulation of frames: reprojection against a loop in float64, noise, uncovered surfaces, changing light."""

import numpy as np
import pytest
import torch

from nlt.models.steady import Steady, seen_before
from nlt.rendering.renderer import Renderer
from nlt.scenes.assembly import Scene
from nlt.scenes.camera import Camera
from nlt.scenes.state import sample_view

WIDTH, HEIGHT = 24, 16


def camera_at(x: float, turn: float = 0.0, size: tuple[int, int] = (WIDTH, HEIGHT)) -> Camera:
    position = np.array([x, 1.5, 0.0])
    target = position + np.array([np.sin(turn), 0.0, np.cos(turn)])
    return Camera.look_at(position, target, np.array([0.0, 1.0, 0.0]), 60, *size)


def frame_of(camera: Camera, depth) -> dict[str, torch.Tensor]:
    return {
        "camera_matrix": torch.from_numpy(camera.matrix)[None],
        "world_to_view": torch.from_numpy(camera.world_to_view)[None],
        "depth": torch.as_tensor(depth, dtype=torch.float32).expand(1, 1, camera.height, camera.width),
    }


def test_places_by_a_loop():
    """Each pixel's surface, found by numpy pixel by pixel, and where the other camera sees it."""
    rng = np.random.default_rng(0)
    now, before = camera_at(0.3, 0.2), camera_at(0.0, -0.1)
    depth = rng.uniform(1, 5, (HEIGHT, WIDTH)).astype(np.float32)
    depth[3, 4] = 0
    places, there = seen_before(frame_of(now, depth), frame_of(before, depth))
    for row in range(HEIGHT):
        for column in range(WIDTH):
            ray = np.linalg.solve(now.matrix.astype(float), [column + 0.5, row + 0.5, 1.0])
            world = now.position + now.rotation @ (ray * depth[row, column])
            view = before.rotation.T @ (world - before.position)
            u, v, _ = before.matrix @ view / view[2]
            assert there[0, 0, row, column] == pytest.approx(view[2] if depth[row, column] else 0, abs=1e-4)
            if depth[row, column]:
                expected = [2 * u / WIDTH - 1, 2 * v / HEIGHT - 1]
                assert places[0, row, column].numpy() == pytest.approx(expected, abs=1e-4)


def test_a_still_camera_averages_noise():
    """Of noise around a constant, the variance falls; the mean stays; the first frame is unchanged."""
    steady, frame = Steady(), frame_of(camera_at(0), 2.0)
    frames = 1 + torch.rand(40, 1, 3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0))
    results = torch.stack([steady(image, frame) for image in frames])
    assert torch.equal(results[0], frames[0])
    assert results[20:].var(0).mean() < 0.5 * frames.var(0).mean()
    assert results[20:].mean().item() == pytest.approx(1.5, abs=0.01)


def test_a_wall_seen_by_a_moving_camera():
    """A pattern on a wall stays in its place: blending the frames changes them by less than resampling does."""
    pattern = lambda x, y: 2 + np.sin(1.5 * x) + np.cos(y)
    steady, wall, last = Steady(), 4.0, None
    for k in range(6):
        camera = camera_at(0.11 * k)
        x, y = (camera.centres() - camera.matrix[:2, 2]).T / np.diag(camera.matrix)[:2, None] * wall
        image = pattern(camera.position[0] - x, camera.position[1] - y).reshape(1, 1, HEIGHT, WIDTH)
        true = torch.from_numpy(np.repeat(image, 3, 1)).float()
        result = steady(true, frame_of(camera, wall))
        unmoved = true if last is None else torch.lerp(true, last, 0.8)
        last = result
        error, unmoved_error = ((image - true).abs().mean() for image in (result, unmoved))
        assert error < 0.02
    assert unmoved_error > 4 * error, "without moving it, the history would be wrong"


@pytest.mark.parametrize("depth", [2.1, 1.0, 0.0])
def test_begins_anew_where_another_surface_was(depth):
    """A surface nearer or farther than what was seen in its place has no history; nor has what is no surface."""
    generator = torch.Generator().manual_seed(0)
    steady, images = Steady(), torch.rand(2, 1, 3, HEIGHT, WIDTH, generator=generator)
    steady(images[0], frame_of(camera_at(0), 2.0))
    assert torch.equal(steady(images[1], frame_of(camera_at(0), depth)), images[1])
    other_size = torch.rand(1, 3, HEIGHT, HEIGHT)
    assert torch.equal(steady(other_size, frame_of(camera_at(0, size=(HEIGHT, HEIGHT)), 2.0)), other_size)


def test_light_that_moved_does_not_trail():
    """Where the whole neighbourhood changes, the history is what the new frame has there."""
    steady, frame = Steady(), frame_of(camera_at(0), 2.0)
    steady(torch.full((1, 3, HEIGHT, WIDTH), 5.0), frame)
    dark = torch.full((1, 3, HEIGHT, WIDTH), 1.0)
    torch.testing.assert_close(steady(dark, frame), dark)


def test_follows_the_renderers_surfaces(demo):
    """In the built-in room, most of what a moved camera sees again has the depth that the renderer says."""
    renderer = Renderer(Scene(demo, "moving_lights"))
    first = sample_view(demo, 2 * WIDTH, np.random.default_rng(2))
    aside = first.world_to_view + np.array([[0, 0, 0, 0.1], *3 * [[0, 0, 0, 0]]], np.float32)
    second = Camera(first.matrix, aside, first.width, first.height)
    now, before = (frame_of(camera, renderer.gbuffer(camera)["depth"]) for camera in (second, first))
    places, depth = seen_before(now, before)
    inside = (places.abs() < 1).all(-1)[:, None]
    there = torch.nn.functional.grid_sample(before["depth"], places, mode="nearest", align_corners=False)
    same = lambda known: ((known - depth).abs() < 0.02 * depth)[inside].float().mean()
    assert inside.float().mean() > 0.7
    assert same(there) > 0.85 and same(there) > same(before["depth"]) + 0.1
