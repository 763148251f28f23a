"""Take the README's pictures of the report and the dashboard: `python scripts/screenshots.py results/NAME [docs]`.

Writes report.png (the image viewer) and dashboard.png into the second directory. Needs playwright and chromium
(`scripts/system-packages.sh chromium`), and the results' images; the dashboard shows the curves that runs/ has.
"""

import os
import shutil
import sys
from pathlib import Path

from playwright.sync_api import Page, sync_playwright
from tensorboard import program

from nlt.evaluation.results import load
from nlt.report.dashboard import write_logs
from nlt.report.draw import draw
from nlt.report.page import PAGE


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


def main() -> None:
    directory, folder = Path(sys.argv[1]), Path((sys.argv[2:] or ["docs"])[0])
    draw(directory)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox"] if os.geteuid() == 0 else []
        )
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.set_default_timeout(120_000)
        report(page, directory, folder / "report.png")
        dashboard(page, directory, folder / "dashboard.png")
        browser.close()


if __name__ == "__main__":
    main()
