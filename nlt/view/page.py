"""The page of `nlt view`. Its widgets hold the wanted state; one loop, which owns the renderers, reads and draws it."""

import io
import queue
import signal
import socket
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
import viser
from PIL import Image
from torch import Tensor

from nlt.display import display_bytes
from nlt.errors import UserError
from nlt.rendering.exr import exr
from nlt.scenes.camera import Camera
from nlt.scenes.description import Experiment, Movable
from nlt.scenes.state import SceneState, rest_state
from nlt.scenes.trajectory import TURNTABLE, cameras, write_camera, write_state
from nlt.view.pace import Pace, size
from nlt.view.pictures import REFERENCE, TRACED, Pictures

_STILL = 0.3  # seconds without a change after which nothing moves
_POLL = 0.01  # seconds between two looks at the widgets
_TEXT = 0.25  # seconds between two updates of the text
_ENOUGH = 1 << 14  # samples per pixel at which the reference stops
_ALL, _NONE = "all", "none"


def view(
    source: str | None, scene: str | None, host: str, port: int, resolution: int, experiment: Experiment | None = None
) -> None:
    """Show a scene in the browser until the page's button or Ctrl-C ends it; arguments as in `nlt view --help`.

    Raises:
        UserError: a file is missing or wrong, the scene does not suit a method, or the address cannot be used.
    """
    try:
        socket.create_server((host, port)).close()  # viser would silently take another port
    except OSError as error:
        raise UserError(f"--host, --port: {host}:{port}: {error.strerror}; give another address") from None
    page = Page(Pictures(source, scene, experiment), host, port, resolution)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: page.close())
    print(f"nlt view: http://{host}:{page.server.get_port()} (Ctrl-C ends it)", flush=True)
    try:
        page.run()
    finally:
        page.server.stop()


def clamp(movables: Sequence[Movable], translations: Sequence[np.ndarray]) -> np.ndarray:
    """Return translations (M, 3) in metres, each moved to the nearest point of its object's box."""
    nearest = [np.clip(t, *movable.box) for t, movable in zip(translations, movables, strict=True)]
    return np.array(nearest, float).reshape(-1, 3)


@dataclass
class Screen:
    """What one client sees: its camera, and the images that need not be drawn again."""

    client: viser.ClientHandle
    pace: Pace
    text: Any
    aspect: float = 0.0  # of the picture that the field of view was chosen for
    place: tuple = ()  # state and camera of the last look
    moved: float = 0.0  # time of the last change of the place
    drawn: tuple = ()  # all that the picture depends on
    images: dict[tuple, Tensor] = field(default_factory=dict)  # (3, H, W), by method, samples, place and size
    spp: int = 0  # samples per pixel of the reference so far
    written: float = 0.0  # time of the last text
    picture: np.ndarray | None = None  # (H, W, 3) uint8


class Page:
    """The widgets, which all clients share, and the pictures, of which each client has its own."""

    def __init__(self, pictures: Pictures, host: str, port: int, resolution: int) -> None:
        """Start serving; `resolution` is the side of a square that has as many pixels as a picture at rest."""
        self.pictures, self.most = pictures, resolution**2
        self.scene = pictures.scene
        self.description = self.scene.description
        self.screens: dict[int, Screen] = {}
        self.requests: queue.SimpleQueue[tuple[int, Callable[[Screen], None]]] = queue.SimpleQueue()
        self.closed = False
        self.server = viser.ViserServer(host, port, verbose=False)
        self.server.scene.set_up_direction(tuple(self.description.up))
        (first,) = cameras(self.description, TURNTABLE, 1, 1, 1)
        self.server.initial_camera.position = first.position
        self.server.initial_camera.look_at = first.position + first.rotation[:, 2]
        self._add_widgets()
        self._add_handles()

    def _add_widgets(self) -> None:
        gui, names = self.server.gui, self.pictures.names
        gui.configure_theme(control_layout="fixed", show_logo=False, show_share_button=False)
        self.left = gui.add_dropdown("left", names, initial_value=names[0])
        self.right = gui.add_dropdown("right", names, initial_value=TRACED)
        self.split = gui.add_slider("split", 0.0, 1.0, 0.01, 1.0, hint="where the right picture begins")
        self.samples = gui.add_slider("samples per pixel", 1, 64, 1, 1, hint="of path tracing and denoising")
        self.stops = gui.add_slider("exposure (stops)", -6.0, 6.0, 0.1, 0.0)
        self.rate = gui.add_slider("frames per second", 2, 60, 1, 10, hint="wanted while something moves")
        with gui.add_folder("save"):
            for label, work in (
                ("state and camera", self._save_state),
                ("PNG", self._save_png),
                ("EXR", self._save_exr),
            ):
                gui.add_button(label).on_click(
                    lambda event, work=work: self.requests.put((event.client_id, work))  # type: ignore[misc]
                )
        gui.add_button("quit", color="red").on_click(lambda _: self.close())

    def _add_handles(self) -> None:
        """Add a checkbox to every removable object, and handles by which the objects are dragged."""
        movables = {movable.name: movable for movable in self.scene.movables}
        self.present: dict[str, Any] = {}
        self.handles: dict[str, Any] = {}
        if not movables:
            return
        with self.server.gui.add_folder("objects"):
            names = (_ALL, _NONE, *movables)
            dragged = self.server.gui.add_dropdown("drag", names, initial_value=next(reversed(movables)))
            for name, movable in movables.items():
                if movable.removable:
                    self.present[name] = self.server.gui.add_checkbox(name, True)
        for name in movables:
            handle = self.server.scene.add_transform_controls(
                f"/{name}", scale=0.4, disable_rotations=True, depth_test=False, position=self.scene.centres[name]
            )
            handle.on_drag_end(lambda _: self._put_back())
            self.handles[name] = handle

        def choose(_: Any = None) -> None:
            for name, handle in self.handles.items():
                handle.visible = dragged.value in (_ALL, name)

        dragged.on_update(choose)
        choose()

    def _put_back(self) -> None:
        """Put handles that were dragged out of their boxes to where the objects are."""
        for movable, translation in zip(self.scene.movables, self._translations(), strict=True):
            self.handles[movable.name].position = self.scene.centres[movable.name] + translation

    def _translations(self) -> np.ndarray:
        """Return the translations (M, 3) in metres that the handles ask for, clamped to the objects' boxes."""
        movables, centres = self.scene.movables, self.scene.centres
        return clamp(movables, [self.handles[m.name].position - centres[m.name] for m in movables])

    def state(self) -> SceneState:
        """Return the state that the widgets ask for."""
        boxes = (self.present.get(movable.name) for movable in self.scene.movables)
        present = np.array([box is None or box.value for box in boxes], bool)
        if not len(present):
            return rest_state(self.description, self.scene.experiment)
        return SceneState(np.where(present[:, None], self._translations(), 0).astype(np.float32), present)

    def camera(self, client: viser.ClientHandle, pixels: int) -> Camera:
        """Return a client's camera with about so many pixels; it has no roll, as those of `nlt render` have none."""
        seen = client.camera
        width, height = size(pixels, seen.aspect)
        fov = np.degrees(2 * np.arctan(np.tan(seen.fov / 2) * width / height))
        forward, up = seen.look_at - seen.position, self.description.up
        sideways = forward - up * (forward @ up)
        if np.linalg.norm(sideways) < 1e-3 * np.linalg.norm(forward):  # straight up or down
            forward = forward + 1e-3 * np.linalg.norm(forward) * np.roll(up, 1)
        return Camera.look_at(seen.position, seen.position + forward, up, fov, width, height)

    def close(self) -> None:
        """End `run` after the current frame; any thread may call this."""
        self.closed = True

    def run(self) -> None:
        """Draw what the clients ask for until `close` is called."""
        while not self.closed:
            clients = self.server.get_clients()
            self.screens = {key: screen for key, screen in self.screens.items() if key in clients}
            for key in clients.keys() - self.screens.keys():
                self.screens[key] = self._open(clients[key])
            while not self.requests.empty():
                key, work = self.requests.get()
                if key in self.screens:
                    work(self.screens[key])
            if not [screen for screen in self.screens.values() if self._draw(screen)]:
                time.sleep(_POLL)

    def _open(self, client: viser.ClientHandle) -> Screen:
        return Screen(client, Pace(self.most), client.gui.add_markdown("", order=-1))

    def _draw(self, screen: Screen) -> bool:
        """Show a client what it asks for; return whether there was anything to draw."""
        start = time.perf_counter()
        state, pose = self.state(), screen.client.camera
        if pose.aspect != screen.aspect:  # also when the panel opens beside the picture
            screen.aspect = pose.aspect
            pose.fov = 2 * np.arctan(np.tan(np.radians(self.description.fov) / 2) / max(pose.aspect, 1))
        place = (state.key, *pose.position, *pose.look_at, pose.fov, pose.aspect)
        if place != screen.place:
            screen.place, screen.moved = place, start
        moving = start - screen.moved < _STILL
        camera = self.camera(screen.client, screen.pace.pixels if moving else self.most)
        split = round(self.split.value * camera.width)
        names = [self.left.value] * (split > 0) + [self.right.value] * (split < camera.width)
        size_and_place = (place, camera.width, camera.height)
        wanted = (*names, split, self.samples.value, self.stops.value, size_and_place, moving)
        accumulates = REFERENCE in names and screen.spp < _ENOUGH and not moving
        if wanted == screen.drawn and not accumulates:
            return False
        self.pictures.lap()
        both, spp = [], self.samples.value
        for name in names:
            key = (name, 0 if name == REFERENCE else spp, size_and_place)
            image = screen.images.get(key)
            if image is None or (name == REFERENCE and accumulates):
                image = self._next(screen, name, image, state, camera)
            screen.images[key] = image
            both.append(image)
        screen.images = {key: image for key, image in screen.images.items() if key[2] == size_and_place}
        screen.drawn = wanted
        radiance = torch.cat([both[0][..., :split], both[-1][..., split:]], -1)
        screen.picture = display_bytes(radiance.numpy(), self.description.exposure * 2.0**self.stops.value)
        screen.client.scene.set_background_image(screen.picture, "jpeg" if moving else "png", jpeg_quality=90)
        seconds = time.perf_counter() - start
        if moving:
            screen.pace.measured(seconds, 1 / self.rate.value / len(self.screens))
        if not moving or start - screen.written > _TEXT:
            screen.written = start
            screen.text.content = self._report(camera, seconds, screen)
        return True

    def _next(self, screen: Screen, name: str, before: Tensor | None, state: SceneState, camera: Camera) -> Tensor:
        """Return a method's image (3, H, W), or the mean of the reference's samples so far and some more."""
        spp = self.samples.value
        if name != REFERENCE:
            return self.pictures.draw(name, state, camera, spp)
        if before is None:
            screen.spp = 0
        image = self.pictures.draw(name, state, camera, spp, screen.spp)
        screen.spp += spp
        return image if before is None else before + (image - before) * (spp / screen.spp)

    def _report(self, camera: Camera, seconds: float, screen: Screen) -> str:
        stages = [f"{name.replace('_', ' ')} {1e3 * time:.1f}" for name, time in self.pictures.lap().items()]
        head = f"**{1e3 * seconds:.0f} ms, {1 / seconds:.1f} frames per second**, {camera.width}x{camera.height}"
        reference = [f"reference: {screen.spp} spp"] * (REFERENCE in (self.left.value, self.right.value))
        return "\n\n".join([head, f"ms: {', '.join(stages) or 'nothing drawn again'}", *reference])

    # The buttons' work, which the loop does.

    def _save_state(self, screen: Screen) -> None:
        content = write_state(self.description, self.scene.experiment, self.state())
        self._send(screen, "state.yaml", content.encode())
        self._send(screen, "camera.yaml", write_camera(self.camera(screen.client, self.most)).encode())

    def _save_png(self, screen: Screen) -> None:
        if screen.picture is not None:
            file = io.BytesIO()
            Image.fromarray(screen.picture).save(file, "PNG")
            self._send(screen, "view.png", file.getvalue())

    def _save_exr(self, screen: Screen) -> None:
        """Save the left picture and the G-buffer, and the reference if the screen has one."""
        state, camera, spp = self.state(), self.camera(screen.client, self.most), self.samples.value
        images = {key[0]: image for key, image in screen.images.items() if key[2][1] == camera.width}
        left = self.left.value
        if left not in images:  # the slider hides it, or something moves
            images[left] = self.pictures.draw(left, state, camera, spp)
        layers = {"radiance": images[left].numpy()}
        if REFERENCE in images:
            layers["reference"] = images[REFERENCE].numpy()
        self._send(screen, "view.exr", exr(layers | self.pictures.layers(state, camera)))

    def _send(self, screen: Screen, name: str, content: bytes) -> None:
        screen.client.send_file_download(name, content, save_immediately=True)
