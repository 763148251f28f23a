"""Every description in configs/scenes/real: true to its room, and used by views, photons and points as it should be."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from nlt.errors import UserError
from nlt.paths import config_names
from nlt.rendering.renderer import Renderer
from nlt.scenes.assembly import Scene
from nlt.scenes.camera import Camera
from nlt.scenes.description import load_description
from nlt.scenes.pointcloud import surface
from nlt.scenes.state import SceneState, rest_state, sample_state, sample_view
from nlt.scenes.views import Views

pytestmark = pytest.mark.slow

NAMES = [name for name in config_names("scenes") if name.startswith("real/")]


@pytest.fixture(scope="module", params=NAMES)
def real(request, variant):
    """A scene with its own lights, and all that is asked of it."""
    try:
        description = load_description(request.param)
    except UserError as error:
        pytest.skip(str(error))  # which says that its files are absent, and where they were looked for
    scene = Scene(description, "fixed_lights")
    return SimpleNamespace(description=description, scene=scene, views=Views(scene), renderer=Renderer(scene))


def bounds(scene, shapes):
    vertices = np.concatenate([scene.shapes[name].vertices for name in shapes])
    return np.stack([vertices.min(0), vertices.max(0)])


def test_objects_stay_inside_the_room(real):
    """What stands outside its bounds, such as on a window sill, is not taken further; the camera stays inside too."""
    description, scene = real.description, real.scene
    room = description.room
    for movable in description.objects:
        box = bounds(scene, movable.shapes)
        allowed = np.stack([np.minimum(room[0], box[0]), np.maximum(room[1], box[1])])
        assert (box[0] + movable.box[0] >= allowed[0] - 0.01).all(), movable.name
        assert (box[1] + movable.box[1] <= allowed[1] + 0.01).all(), movable.name
    assert (description.camera[0] >= room[0]).all() and (description.camera[1] <= room[1]).all()


def test_sizes(real):
    """Units: a chair, a bathtub or a ceiling is as high as one is in metres."""
    description = real.description
    height = description.room[1][1] - description.room[0][1]
    assert 2.4 < height < 3.5
    low = {"chair_1": (0.75, 1.1), "bench": (0.4, 0.6), "bathtub": (0.5, 0.7), "egg": (0.2, 0.6), "sofa": (0.7, 0.9)}
    for movable in description.objects:
        if movable.name in low:
            top = np.ptp(bounds(real.scene, movable.shapes), axis=0)[1]
            assert low[movable.name][0] < top < low[movable.name][1], movable.name


def test_light_hangs_under_the_ceiling(real):
    """At the corners and in the middle of its box, the ceiling is close above it and the air below it free."""
    description = real.description
    half = np.array([description.light.size[0], 0, description.light.size[1]]) / 2
    box = description.light.box
    assert (box[0] - half >= description.room[0]).all() and (box[1] + half <= description.room[1]).all()
    count = len(real.scene.movables)
    with real.scene.in_state(SceneState(np.zeros((count, 3), np.float32), np.zeros(count, bool))):
        for weight in np.array([[0, 0], [0, 1], [1, 0], [1, 1], [0.5, 0.5]]):
            centre = box[0] + (box[1] - box[0]) * [weight[0], 0, weight[1]]
            (above, below), *_ = real.views.look(centre, np.array([[0, 1, 0], [0, -1, 0]]))
            assert 0 < above < 0.1 and below > 1.0


def test_views(real):
    """Most of the camera box is free; what lies outside or inside closed objects is turned down."""
    description, views = real.description, real.views
    rng = np.random.default_rng(0)
    real.scene.set_state(rest_state(description, "fixed_lights"))
    assert np.mean([views.passes(sample_view(description, 16, rng)) for _ in range(25)]) > 0.85
    look = lambda position: Camera.look_at(position, rng.uniform(*description.look_at), description.up, 70.0, 16, 16)
    whole = bounds(real.scene, real.scene.shapes)
    outside = []
    for _ in range(20):
        position = rng.uniform(whole[0] - 3, whole[1] + 3)
        if ((position < whole[0]) | (position > whole[1])).any():
            outside.append(views.passes(look(position)))
    assert len(outside) > 10 and not any(outside)
    inside = []
    for shape in sorted(real.scene.shapes.values(), key=lambda s: -np.ptp(s.vertices, axis=0).prod())[:20]:
        mesh = trimesh.Trimesh(shape.vertices, shape.faces)
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
        size = mesh.extents.max()
        if len(mesh.faces) < 500 and mesh.is_watertight and mesh.extents.min() > 0.03 and size < 2:
            candidates = rng.uniform(*mesh.bounds, (4, 3))
            inside += [views.passes(look(position)) for position in candidates[contains(mesh, candidates)]]
    assert not any(inside)


def contains(mesh, points):
    """By the parity of crossings along a skew ray, in float64."""
    direction = np.array([0.31, 0.87, 0.38])
    a, e1, e2 = mesh.triangles[:, 0], *(mesh.triangles[:, k] - mesh.triangles[:, 0] for k in (1, 2))
    p = np.cross(direction, e2)
    offset = points[:, None] - a
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1 / (e1 * p).sum(1)
        u, q = (offset * p).sum(2) * inverse, np.cross(offset, e1)
        v, t = (q @ direction) * inverse, (q * e2).sum(2) * inverse
    return ((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)).sum(1) % 2 == 1


def test_albedo(real):
    """In [0, 1] for every material; Mitsuba itself says 18 of some conductors."""
    uv = np.random.default_rng(0).random((4, 2))
    unlike = {}
    for shape in real.scene.shapes.values():
        unlike.setdefault(repr(shape.bsdf), shape)
    for shape in unlike.values():
        albedo, _ = surface(shape, uv)
        assert np.isfinite(albedo).all() and albedo.min() >= 0 and albedo.max() <= 1, shape.id


def test_light_and_photons(real):
    """Ten thousand photons arrive, in the room; random views are neither black nor white at the scene's exposure."""
    description, scene, renderer = real.description, real.scene, real.renderer
    rng = np.random.default_rng(1)
    scene.set_state(sample_state(description, "fixed_lights", rng))
    photons = renderer.photons(10_000, 0)
    assert photons["photon_valid"].all() and (photons["photon_flux"].sum(0) > 0).all()
    hit, room = photons["photon_hit"], description.room
    assert ((hit > room[0] - 0.1) & (hit < room[1] + 0.1)).all(1).mean() > 0.8
    images = [renderer.radiance(real.views.sample(16, rng), 16, k) * description.exposure for k in range(3)]
    assert 0.04 < np.median([np.median(image) for image in images]) < 0.8
