"""`nlt view` in headless Chromium: what is dragged and chosen is what it shows, as `nlt render` would draw it."""

import re
import signal
import socket
import subprocess
import sys
import time
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import OpenEXR
import pytest
import torch
from PIL import Image

from nlt.display import display_bytes
from nlt.errors import UserError
from nlt.evaluation.results import write_manifest, write_rows
from nlt.scenes.state import rest_state
from nlt.scenes.trajectory import cameras, states
from nlt.view.drawing import DEMO, load_models, open_models
from nlt.view.page import clamp
from nlt.view.pictures import DENOISED, REFERENCE, TRACED, Pictures

pytestmark = pytest.mark.slow
FINEST = 64  # --resolution
POSITION, TARGET = (-1.5, 1.3, 0.2), (0.5, 2.0, 0.0)  # of the camera; it sees the ceiling light
WINDOW = {"width": 1000, "height": 640}
PATIENCE = 600  # seconds to wait on a busy machine
NEAR = 0.02  # mean difference of displayed values in [0, 1]: the browser interpolates, and axes cover a corner


@contextmanager
def viewing():
    command = [sys.executable, "-m", "nlt.cli", "view", "--demo", "--port", "0", "--resolution", str(FINEST)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        url = next(found[1] for line in process.stdout if (found := re.search(r"nlt view: (http://127\S+)", line)))
        yield SimpleNamespace(url=url, popen=process)
        process.kill()


def ends_cleanly(process):
    _, error = process.popen.communicate()
    return process.popen.returncode == 0 and "Traceback" not in error


@pytest.fixture(scope="module")
def process():
    with viewing() as process:
        yield process


@pytest.fixture(scope="module")
def model():
    return next(iter(open_models(load_models(DEMO, None)).values()))


@pytest.fixture
def open_page(browser, process, model, tmp_path):
    """Opens a page in a context of its own, as of another person; nothing may have asked for anything elsewhere."""
    pages = []

    def open_():
        context = browser.new_context(viewport=WINDOW, accept_downloads=True)
        context.set_default_timeout(1000 * PATIENCE)
        page = context.new_page()
        requests = []
        page.on("request", lambda request: requests.append(request.url))
        at = lambda point: ",".join(map(str, point))
        page.goto(f"{process.url}?initialCameraPosition={at(POSITION)}&initialCameraLookAt={at(TARGET)}")
        page.get_by_text("frames per second,").wait_for()
        pages.append((page, requests))
        return Shown(page=page, model=model, folder=tmp_path)

    yield open_
    for page, requests in pages:
        page.context.close()
        assert all(url.startswith((process.url, "data:", "blob:")) for url in requests)


class Shown(SimpleNamespace):
    """A page; its methods act and look as a person does."""

    def saved(self, button, count=1):
        """Press a button of the page that saves files; return their paths by name."""
        files = []
        keep = lambda download: files.append(download)  # playwright cannot wrap a list's own method
        self.page.on("download", keep)
        self.page.get_by_role("button", name=button, exact=True).click()
        until(lambda: len(files) == count, self.page)
        self.page.remove_listener("download", keep)
        for file in files:
            file.save_as(self.folder / file.suggested_filename)
        return {file.suggested_filename: self.folder / file.suggested_filename for file in files}

    def asked(self):
        """Return the state and the camera that the page saves, as `nlt render` reads them."""
        files = self.saved("state and camera", 2)
        description, experiment = self.model.render.description, self.model.spec.experiment
        (state,) = states(description, experiment, str(files["state.yaml"]), None, 1)
        text = self.page.get_by_text("frames per second,").inner_text()
        width, height = map(int, re.search(r"(\d+)x(\d+)", text).groups())
        (camera,) = cameras(description, str(files["camera.yaml"]), 1, width, height)
        return state, camera

    def expected(self, spp=0):
        """Return what `nlt render` draws of the state and the camera, (H, W, 3): the method, or path tracing."""
        state, camera = self.asked()
        with torch.no_grad():
            image = self.model.traced(state, camera, spp, 0) if spp else self.model.frame(state, camera)
        return display_bytes(image[0].numpy(), self.model.render.description.exposure) / 255

    def canvas(self):
        return max(self.page.locator("canvas").all(), key=lambda canvas: canvas.bounding_box()["width"])

    def difference(self, picture):
        """Return how far the pixels on the screen are from a picture (H, W, 3) enlarged to them, as a mean."""
        self.page.mouse.move(5, 5)
        path = self.folder / "screen.png"
        self.canvas().screenshot(path=path)
        screen = Image.open(path).convert("RGB")
        enlarged = Image.fromarray((255 * picture).round().astype(np.uint8)).resize(screen.size, Image.BILINEAR)
        left = screen.width // 2  # the page's notes on downloads cover the left half
        return np.abs(np.asarray(screen, float) - np.asarray(enlarged))[:, left:].mean() / 255

    def shows(self, spp=0):
        """Wait until the page shows what `nlt render` draws; return that picture."""
        picture = []

        def is_near():
            picture[:] = [self.expected(spp)]
            return self.difference(picture[0]) < NEAR

        until(is_near, self.page)
        return picture[0]

    def choose(self, label, option):
        self.page.get_by_label(label, exact=True).first.click()
        self.page.get_by_role("option", name=option, exact=True).click()

    def drag(self, start, direction, pixels):
        """Drag with the mouse from a point of the room along the picture of a direction."""
        x, y = self.place(start)
        u, v = np.array(self.place(np.add(start, direction))) - (x, y)
        length = np.hypot(u, v)
        self.page.mouse.move(x, y)
        self.page.mouse.down()
        for part in (0.1, 0.5, 1):
            self.page.mouse.move(x + part * pixels * u / length, y + part * pixels * v / length)
        self.page.mouse.up()

    def place(self, point):
        """Return where on the page a point of the room is."""
        _, camera = self.asked()
        box = self.canvas().bounding_box()
        x, y, z = camera.matrix @ (camera.world_to_view @ [*point, 1])[:3]
        return box["x"] + x / z / camera.width * box["width"], box["y"] + y / z / camera.height * box["height"]


def until(is_so, page, seconds=PATIENCE):
    """Wait, however slow the machine; fail if it does not become so."""
    end = time.monotonic() + seconds
    while not is_so():
        assert time.monotonic() < end
        page.wait_for_timeout(200)


def test_objects_stay_in_their_boxes(demo):
    movables = demo.movables("moving_lights")
    boxes = np.stack([movable.box for movable in movables], 1)  # (2, M, 3)
    inside = boxes[0] + np.random.default_rng(0).random(boxes[0].shape) * (boxes[1] - boxes[0])
    np.testing.assert_array_equal(clamp(movables, inside), inside)
    np.testing.assert_array_equal(clamp(movables, boxes[1] + 1), boxes[1])
    np.testing.assert_array_equal(clamp(movables, boxes[0] - 1), boxes[0])
    assert clamp((), ()).shape == (0, 3)


def test_results_without_their_runs(tmp_path, refused):
    """One line that names the file; the same of a folder that holds no results, and of an address in use."""
    runs = [
        {"method": "cnn", "seed": 0, "status": "ok", "run": "runs/gone"},
        {"method": "oidn_1", "seed": 0, "status": "ok"},
    ]
    write_rows(tmp_path / "runs.csv", runs)
    write_rows(tmp_path / "views.csv", [{"method": "cnn"}])
    write_manifest(tmp_path, {})
    refused(["view", tmp_path, "--port", "0"], tmp_path / "runs.csv", "runs/gone")
    write_rows(tmp_path / "runs.csv", runs[1:])
    refused(["view", tmp_path, "--port", "0"], tmp_path / "manifest.json", "none is trained")
    refused(["view", tmp_path / "nothing.ckpt", "--port", "0"], "nothing.ckpt", "cannot be read")
    refused(["view"], "--demo")
    refused(["view", tmp_path, "--demo"], "--demo")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        refused(["view", "--demo", "--port", port], f"127.0.0.1:{port}")
    refused(["view", "--demo", "--host", "not.a.host.invalid"], "not.a.host.invalid")


def test_light_method_and_second_client(open_page, model):
    page = open_page()
    page.choose("drag", "none")  # handles would cover the picture
    rest = page.shows()
    page.choose("drag", "moving_light")
    light = model.render.description.light
    page.page.wait_for_timeout(1000)
    centre = model.render.scene.centres["moving_light"]
    page.drag(np.add(centre, (0.3, 0, 0)), (1, 0, 0), 60)
    page.choose("drag", "none")
    moved = page.shows()
    state, _ = page.asked()
    assert abs(state.translation[-1, 0]) > 0.05 and np.abs(state.translation[-1, 1:]).max() < 1e-3
    assert page.difference(moved) < page.difference(rest)

    other = open_page()  # a second person, who sees the same state and takes an object away
    assert np.abs(other.shows() - moved).mean() < NEAR
    other.page.get_by_label("table", exact=True).first.click()
    page.choose("left", TRACED)
    traced = page.shows(spp=1)
    assert page.difference(traced) < page.difference(moved)
    other.page.context.close()
    assert not page.asked()[0].present.all()
    page.shows(spp=1)

    assert (light.box[0] - 1e-4 <= light.centre + state.translation[-1]).all()


def test_saves_what_it_shows_and_quits(open_page, model, process):
    page = open_page()
    page.choose("drag", "none")
    page.choose("left", next(iter(DEMO)))  # all clients share what another one chose
    picture = page.shows()
    state, camera = page.asked()
    assert camera.width > camera.height and camera.fov == pytest.approx(model.render.description.fov, abs=0.5)
    png = np.asarray(Image.open(page.saved("PNG")["view.png"])) / 255
    assert np.abs(png - picture).mean() < 1 / 255 and png.std() > 0.05
    with OpenEXR.File(str(page.saved("EXR")["view.exr"]), separate_channels=True) as file:
        layers = {name: channel.pixels for name, channel in file.channels().items()}
    radiance = np.stack([layers[channel] for channel in "RGB"])
    assert np.abs(display_bytes(radiance, model.render.description.exposure) / 255 - png).max() <= 1 / 255
    np.testing.assert_allclose(layers["Depth.Z"], model.gbuffer(state, camera)["depth"][0], rtol=1e-4)
    page.page.get_by_role("button", name="quit", exact=True).click()
    assert ends_cleanly(process)


def test_without_training():
    """A scene in place of a checkpoint is shown as it is, by its own lights unless told otherwise."""
    own, moving = Pictures("egg"), Pictures("egg", experiment="moving_lights")
    assert own.names == moving.names == [DENOISED, TRACED, REFERENCE]
    assert [pictures.scene.experiment for pictures in (own, moving)] == ["fixed_lights", "moving_lights"]
    description = own.scene.description
    (view,) = cameras(description, "turntable", 1, 16, 16)
    images = [own.draw(name, rest_state(description, "fixed_lights"), view, 4) for name in own.names]
    assert all(image.shape == (3, 16, 16) and image.isfinite().all() for image in images)
    assert (images[0] != images[1]).any() and {"gbuffer", "path_tracing", "denoise"} == {*own.lap()}
    with pytest.raises(UserError, match=r"palace.*known scenes"):
        Pictures("palace")


def test_interrupted():
    with viewing() as process:
        process.popen.send_signal(signal.SIGINT)
        assert ends_cleanly(process)
