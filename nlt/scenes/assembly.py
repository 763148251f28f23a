"""Load a described scene into Mitsuba so that moving an object does not rebuild the rest of the scene.

The static part and each movable object are shape groups with their own acceleration structures; a state only sets the
transforms of their instances. Emitting shapes cannot be instanced and stay plain meshes.
"""

import gc
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from nlt.errors import UserError
from nlt.scenes.description import BUILTIN, MOVING_LIGHT, STATIC, SceneDescription
from nlt.scenes.importer import read
from nlt.scenes.lanes import is_jit, owned
from nlt.scenes.masks import is_mask
from nlt.scenes.meshes import live_mesh
from nlt.scenes.model import Triangles
from nlt.scenes.state import SceneState, rest_state

# A removed object shrinks to the size of a micrometre. No ray hits it, and no kernel has to be recompiled for a scene
# with fewer shapes.
_SPECK = 1e-6


@dataclass(frozen=True)
class Shape:
    """A triangle mesh: `vertices` (V, 3) in metres, `faces` (F, 3), `uv` (V, 2) or None, Mitsuba BSDF and emitter."""

    id: str
    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray | None
    bsdf: Any
    emitter: Any | None

    @property
    def face_normals(self) -> np.ndarray:
        """The normal (F, 3) of each face, as long as the face's area in m²."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        return np.cross(b - a, c - a) / 2

    @property
    def face_areas(self) -> np.ndarray:
        """The area (F,) of each face in m²."""
        return np.linalg.norm(self.face_normals, axis=1)


class Scene:
    """A scene in one experiment and one state at a time.

    Args:
        description: the scene's description.
        experiment: "static" and "fixed_lights" keep the scene's own emitters; "moving_lights" turns them all off
            and hangs one rectangular area light under the ceiling instead (Sec. Dynamic Objects and Dynamic Lights).

    Raises:
        UserError: the file cannot be loaded, a shape is missing, or nothing emits light.
    """

    def __init__(self, description: SceneDescription, experiment: str) -> None:
        # Kernels dispatch to the materials of all scenes in memory, also of unused scenes that cycles keep alive.
        gc.collect()
        self.description, self.experiment = description, experiment
        self.movables = description.movables(experiment)
        self._own_lights = own_lights = experiment != "moving_lights"
        source = load_source(description)
        meshes = {shape.id(): shape for shape in source.shapes()}
        claimed: dict[str, str] = {}
        for movable in description.objects:
            for shape in movable.shapes:
                where = f"{description.file}: objects.{movable.name}.shapes"
                if shape not in meshes:
                    raise UserError(f"{where}: the scene has no shape {shape!r}; its shapes are {some(sorted(meshes))}")
                if shape in claimed:
                    raise UserError(f"{where}: shape {shape!r} already belongs to {claimed[shape]}")
                claimed[shape] = movable.name
        self.environment = source.environment() if own_lights else None
        if own_lights and not source.emitters():
            raise UserError(
                f"{description.file}: source: {description.source} has no emitters; add one, or use moving_lights"
            )
        self.shapes = {name: read_shape(mesh, description.units_per_metre, own_lights) for name, mesh in meshes.items()}
        if not own_lights:
            # An emitter of zero radiance would still be sampled and add noise.
            dark = lambda name, mesh: live_mesh(name, read_triangles(mesh), self.shapes[name].bsdf)
            meshes = {name: dark(name, mesh) if mesh.is_emitter() else mesh for name, mesh in meshes.items()}
        self._assemble(meshes)
        self.masks = any(is_mask(shape.bsdf) for shape in self.shapes.values())
        vertices = {m.name: np.concatenate([self.shapes[name].vertices for name in m.shapes]) for m in self.movables}
        # The middles (3,) in metres of the movable objects at rest.
        self.centres = {name: (v.min(0) + v.max(0)) / 2 for name, v in vertices.items()}
        self.set_state(rest_state(description, experiment))

    def _assemble(self, meshes: dict[str, Any]) -> None:
        """Create one instance per movable object and one for the rest; emitters and the environment stay separate."""
        parts: dict[str, Any] = {"type": "scene"}
        owner = {shape: m.name for m in self.movables for shape in m.shapes}
        groups: dict[str, dict[str, Any]] = {}
        for name, mesh in meshes.items():
            if mesh.is_emitter():
                parts[f"emitter_{name}"] = mesh
            else:
                groups.setdefault(owner.get(name, STATIC), {})[name] = mesh
        for key, members in groups.items():
            # Merge the meshes of one BSDF, because tracing and checking frozen kernels takes time for every shape.
            merged = mi.load_dict({"type": "merge", **members})
            merged = merged if isinstance(merged, list) else [merged]
            group = mi.load_dict({"type": "shapegroup", **{str(k): mesh for k, mesh in enumerate(merged)}})
            parts[f"group_{key}"] = group
            parts[f"instance_{key}"] = {"type": "instance", "to_world": mi.ScalarTransform4f(), "of": group}
        if self.environment is not None:
            parts["environment"] = self.environment
        if not self._own_lights:
            light = self.description.light
            assert light is not None  # otherwise movables() raises
            parts[f"emitter_{MOVING_LIGHT}"] = {
                "type": "rectangle",
                "to_world": self._light_transform(np.zeros(3)),
                "black": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}},
                "light": {"type": "area", "radiance": {"type": "rgb", "value": light.radiance.tolist()}},
            }
        self.mi_scene = mi.load_dict(parts)
        if not self._own_lights:
            # Points are sampled on the light too. Its shape has the BSDF and the emitter of the rectangle, because
            # additional ones would join every virtual call of a compiled kernel.
            (rectangle,) = [shape for shape in self.mi_scene.shapes() if shape.id() == f"emitter_{MOVING_LIGHT}"]
            quad = light_quad(self.description)
            self.shapes[MOVING_LIGHT] = Shape(MOVING_LIGHT, *quad, None, rectangle.bsdf(), rectangle.emitter())
        self._parameters = mi.traverse(self.mi_scene)
        self._moving_meshes = {
            m.name: {
                key: np.array(self._parameters[key]).reshape(-1, 3)
                for shape in m.shapes
                if shape in meshes and meshes[shape].is_emitter()
                # Mitsuba names a mesh's parameters by its key in the dict, or by its own id if the XML gives one.
                for key in (f"emitter_{shape}.vertex_positions", f"{shape}.vertex_positions")
                if key in self._parameters
            }
            for m in self.movables
        }
        moved = {f"emitter_{MOVING_LIGHT}.to_world", *(f"instance_{m.name}.to_world" for m in self.movables)}
        moved.update(*self._moving_meshes.values())
        self._parameters.keep(sorted(moved & set(self._parameters.keys())))

    def _light_transform(self, translation: np.ndarray, scale: float = 1.0) -> Any:
        light, units = self.description.light, self.description.units_per_metre
        assert light is not None
        matrix = np.eye(4)
        half = light.size / 2 * scale
        matrix[:3, :3] = _facing_down(self.description.up) * [*half, scale] * units
        matrix[:3, 3] = (light.centre + translation) * units
        return mi.ScalarTransform4f(matrix.tolist())

    def set_state(self, state: SceneState) -> None:
        """Move and remove objects. The next rays see the new state."""
        self.state = state
        units = self.description.units_per_metre
        for movable, translation, present in zip(self.movables, state.translation, state.present, strict=True):
            centre = self.centres[movable.name] * units
            offset, scale = translation.astype(float) * units, 1.0 if present else _SPECK
            if movable.name == MOVING_LIGHT:
                transform = self._light_transform(translation.astype(float), scale)
                self._parameters[f"emitter_{MOVING_LIGHT}.to_world"] = transform
            if (key := f"instance_{movable.name}.to_world") in self._parameters:
                to_world = mi.ScalarTransform4f().translate(list(centre * (1 - scale) + offset)).scale(scale)
                self._parameters[key] = to_world
            for key, rest in self._moving_meshes[movable.name].items():
                moved = (rest - centre) * scale + centre + offset
                self._parameters[key] = owned(moved.astype(np.float32))
        if len(self._parameters):
            self._parameters.update()
            if is_jit():
                # Otherwise the transforms are literals, and every state recompiles the kernels.
                dr.make_opaque({key: self._parameters[key] for key in self._parameters.keys()})  # noqa: SIM118

    @contextmanager
    def in_state(self, state: SceneState) -> Iterator[None]:
        """Put the scene into another state for the duration of the context."""
        before = self.state
        self.set_state(state)
        try:
            yield
        finally:
            self.set_state(before)

    @property
    def lit(self) -> SceneState:
        """The state at rest without the removed emitters; the powers of all emitters depend on nothing else."""
        emits = np.array([bool(self._moving_meshes[movable.name]) for movable in self.movables], bool)
        return SceneState(np.zeros_like(self.state.translation), self.state.present | ~emits)


def light_quad(description: SceneDescription) -> tuple[np.ndarray, np.ndarray]:
    """The moving light at zero translation: vertices (4, 3) in metres, faces (2, 3)."""
    light = description.light
    assert light is not None
    corners = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]])
    vertices = corners * [*light.size, 1] @ _facing_down(description.up).T + light.centre
    return vertices, np.array([[0, 1, 2], [0, 2, 3]])


def some(names: Sequence[str]) -> str:
    """Return the first names and the number of the others."""
    return ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")


def _facing_down(up: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) that maps +z, a rectangle's normal, to -up and +x to the first horizontal axis."""
    first = np.eye(3)[int(up[0] == 1)]
    return np.stack([first, np.cross(-up, first), -up], axis=1)


def load_source(description: SceneDescription) -> Any:
    """Load the scene that a description refers to, without changing it."""
    if description.path is None:
        from nlt.scenes import builtin

        name = description.source.removeprefix(BUILTIN)
        if name not in builtin.BUILTINS:
            known = ", ".join(builtin.BUILTINS)
            raise UserError(f"{description.file}: source: no built-in scene {name!r}; known are {known}")
        return builtin.mitsuba_scene(name)
    return read(description.path).scene


def read_shape(mesh: Any, units_per_metre: float = 1.0, own_lights: bool = True) -> Shape:
    """Convert a Mitsuba mesh to a shape in metres, without its emitter if the scene's own lights are off."""
    triangles, emitter = read_triangles(mesh), mesh.emitter() if own_lights and mesh.is_emitter() else None
    uv = None if triangles.uv is None else triangles.uv.astype(float)
    vertices, faces = triangles.vertices.astype(float) / units_per_metre, triangles.faces.astype(np.int64)
    return Shape(mesh.id(), vertices, faces, uv, mesh.bsdf(), emitter)


def read_triangles(mesh: Any) -> Triangles:
    """Return the triangles of a Mitsuba mesh, in scene units."""
    old = mi.traverse(mesh)
    column = lambda key, n: np.array(old[key]).reshape(-1, n)
    normals = column("vertex_normals", 3) if mesh.has_vertex_normals() else None
    uv = column("vertex_texcoords", 2) if mesh.has_vertex_texcoords() else None
    return Triangles(column("vertex_positions", 3), column("faces", 3), normals, uv)
