"""`nlt scenes preview`: what scenes look like, in random states, from random views."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw

from nlt.data.engines import Process
from nlt.metrics.display import display
from nlt.rendering.renderer import Renderer
from nlt.rendering.variant import choose_variant, use_variant
from nlt.scenes.assembly import Scene
from nlt.scenes.description import SceneDescription, load_description
from nlt.scenes.state import sample_state
from nlt.scenes.views import Views

_TITLE, _GAP = 24, 4  # pixels


def contact_sheet(
    names: list[str],
    output: Path,
    views: int = 4,
    resolution: int = 256,
    spp: int = 64,
    experiment: str = "fixed_lights",
    seed: int = 0,
) -> None:
    """Write a picture of a row per scene and a column per view, each in a random state of the experiment.

    Raises:
        UserError: a scene is unknown, does not load, or has no such experiment.
    """
    descriptions = [load_description(name) for name in names]  # mistakes show before anything is rendered
    width, height = views * (resolution + _GAP) + _GAP, resolution + _TITLE + _GAP
    sheet = Image.new("RGB", (width, len(names) * height), "white")
    draw = ImageDraw.Draw(sheet)
    choose_variant()  # once; the processes inherit it
    # A process per scene: Mitsuba's memory grows with every one.
    for row, (name, description) in enumerate(zip(names, descriptions, strict=True)):
        images = Process(_images, description, views, resolution, spp, experiment, seed).result()
        title = f"{name} ({experiment.replace('_', ' ')}, exposure {description.exposure:g}, {spp} spp)"
        draw.text((_GAP, row * height + _GAP), title, "black", font_size=14)
        for column, image in enumerate(images):
            corner = (_GAP + column * (resolution + _GAP), row * height + _TITLE)
            sheet.paste(Image.fromarray(image), corner)
    output.parent.mkdir(parents=True, exist_ok=True)
    sheet.save(output, optimize=True, quality=90)  # of a JPEG; noise makes a PNG five times as large


def _images(
    description: SceneDescription, views: int, resolution: int, spp: int, experiment: str, seed: int
) -> list[np.ndarray]:
    """(H, W, 3) uint8 sRGB images of one scene."""
    use_variant()
    scene = Scene(description, experiment)
    renderer, sampler = Renderer(scene), Views(scene)
    images = []
    for k in range(views):
        rng = np.random.default_rng([seed, k])
        scene.set_state(sample_state(description, experiment, rng))
        radiance = renderer.radiance(sampler.sample(resolution, rng), spp, seed + k)
        shown = display(torch.from_numpy(radiance)[None], description.exposure)[0]
        images.append((shown.permute(1, 2, 0).numpy() * 255).round().astype(np.uint8))
    return images
