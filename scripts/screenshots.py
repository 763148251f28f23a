"""Take the pictures of the report, the dashboard and `nlt view`: `python scripts/screenshots.py results/NAME [docs]`.

Writes report.png (the report's images), dashboard.png and view.webp into the second directory. Needs playwright and
chromium (`scripts/system-packages.sh chromium`) and the results' images; the dashboard shows the curves that runs/ has.
Without results/NAME, it takes only the picture of `nlt view --demo`.
"""

import io
import os
import re
import shutil
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from PIL import Image
from playwright.sync_api import Page, sync_playwright
from tensorboard import program

from nlt.evaluation.results import load
from nlt.report.dashboard import write_logs
from nlt.report.draw import draw
from nlt.report.page import PAGE
from nlt.scenes.camera import Camera
from nlt.scenes.description import load_description
from nlt.view.drawing import DEMO, DEMO_SCENE
from nlt.view.pictures import REFERENCE


def report(page: Page, directory: Path, path: Path) -> None:
    """Capture the viewer, with the slider between its first two images, and the controls around it."""
    page.goto((directory / PAGE).resolve().as_uri())
    page.wait_for_function("$('canvas').dataset.drawn === JSON.stringify(state)")
    page.locator("#viewer").screenshot(path=path)


def dashboard(page: Page, directory: Path, path: Path) -> None:
    """Capture TensorBoard's custom scalars: the training and validation curves of all methods."""
    board = program.TensorBoard()
    board.configure(logdir=str(write_logs(load(directory))), port=0)
    page.goto(f"{board.launch()}/#custom_scalars")
    page.locator("vz-line-chart2, tf-line-chart-data-loader").first.wait_for(timeout=120_000)
    page.wait_for_load_state("networkidle")
    page.wait_for_timeout(3000)  # curves fade in
    page.screenshot(path=path)


def view(page: Page, path: Path) -> None:
    """Capture `nlt view --demo` three times: at rest, with a dragged light and two methods, without the table."""
    position, target = np.array([2.2, 1.3, 0.9]), np.array([-0.8, 1.85, -0.3])  # of a camera that sees the light
    command = [sys.executable, "-m", "nlt.cli", "view", "--demo", "--port", "0", "--resolution", "384"]
    shots = []
    with ExitStack() as stack:
        process = stack.enter_context(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
        stack.callback(process.terminate)
        assert process.stdout
        url = next(found[1] for line in process.stdout if (found := re.search(r"(http://127\S+)", line)))
        at = lambda point: ",".join(map(str, point))
        page.goto(f"{url}?initialCameraPosition={at(position)}&initialCameraLookAt={at(target)}")
        page.get_by_text("frames per second,").wait_for()
        page.get_by_role("alert").get_by_role("button").click()  # chromium renders in software

        def shoot() -> None:
            page.mouse.move(5, 5)
            page.wait_for_timeout(15_000)  # until it rests
            shots.append(np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")))

        def choose(label: str, option: str) -> None:
            page.get_by_label(label, exact=True).first.click()
            page.get_by_role("option", name=option, exact=True).click()

        def split(share: str) -> None:
            field = "xpath=//label[normalize-space()='split']/following::input[contains(@class, 'NumberInput')][1]"
            page.locator(field).fill(share)
            page.keyboard.press("Enter")

        shoot()
        description = load_description(DEMO_SCENE)
        boxes = [canvas.bounding_box() for canvas in page.locator("canvas").all()]
        box = max((box for box in boxes if box), key=lambda box: box["width"])
        width, height = round(box["width"]), round(box["height"])
        camera = Camera.look_at(position, target, description.up, description.fov, width, height)
        assert description.light
        for k, offset in enumerate((0.3, 0.0, -0.4)):  # along the handle's red arrow
            x, y, z = description.light.centre
            x, y, z = camera.matrix @ (camera.world_to_view @ [x + offset, y, z, 1])[:3]
            page.mouse.move(box["x"] + x / z, box["y"] + y / z)
            if k == 0:
                page.mouse.down()
        page.mouse.up()
        choose("left", list(DEMO)[-1])
        split("0.5")
        shoot()
        choose("drag", "none")
        page.get_by_label("table", exact=True).first.click()
        split("1")
        choose("left", REFERENCE)
        shoot()
    Image.fromarray(np.concatenate(shots)).save(path, quality=85)


def main() -> None:
    directory, folder = sys.argv[1] if sys.argv[1:] else None, Path((sys.argv[2:] or ["docs"])[0])
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox"] if os.geteuid() == 0 else []
        )
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.set_default_timeout(120_000)
        if directory is not None:
            draw(Path(directory))
            report(page, Path(directory), folder / "report.png")
            dashboard(page, Path(directory), folder / "dashboard.png")
        page.set_viewport_size({"width": 960, "height": 480})
        view(page, folder / "view.webp")
        browser.close()


if __name__ == "__main__":
    main()
