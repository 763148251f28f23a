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
_KEY = 0.18  # geometric mean of luminance in a picture that is neither dark nor burnt out (Reinhard et al. 2002)
_LUMINANCE = (0.2126, 0.7152, 0.0722)  # of linear sRGB (ITU-R BT.709)
_BLACK = 1e-3  # of luminance that shows


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

    Says of each scene how bright it is at its exposure, and which exposure would suit these views.

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
        images, mean = Process(_images, description, views, resolution, spp, experiment, seed).result()
        suits = description.exposure * _KEY / mean
        at = f"mean luminance {mean:.2g} at exposure {description.exposure:g}"
        print(f"{name}: {at}; mid-grey, {_KEY}, at exposure {suits:.2g}", flush=True)
        title = f"{name} ({experiment.replace('_', ' ')}, exposure {description.exposure:g}, {spp} spp)"
        draw.text((_GAP, row * height + _GAP), title, "black", font_size=14)
        for column, image in enumerate(images):
            corner = (_GAP + column * (resolution + _GAP), row * height + _TITLE)
            sheet.paste(Image.fromarray(image), corner)
    output.parent.mkdir(parents=True, exist_ok=True)
    sheet.save(output, optimize=True, quality=90)  # of a JPEG; noise makes a PNG five times as large


def _images(
    description: SceneDescription, views: int, resolution: int, spp: int, experiment: str, seed: int
) -> tuple[list[np.ndarray], float]:
    """(H, W, 3) uint8 sRGB images of one scene, and the geometric mean of their luminance as it is exposed."""
    use_variant()
    scene = Scene(description, experiment)
    renderer, sampler = Renderer(scene), Views(scene)
    images, logarithms = [], []
    for k in range(views):
        rng = np.random.default_rng([seed, k])
        scene.set_state(sample_state(description, experiment, rng))
        radiance = renderer.radiance(sampler.sample(resolution, rng), spp, seed + k)
        luminance = np.tensordot(_LUMINANCE, radiance * description.exposure, 1)
        logarithms.append(np.log(luminance + _BLACK).mean())
        shown = display(torch.from_numpy(radiance)[None], description.exposure)[0]
        images.append((shown.permute(1, 2, 0).numpy() * 255).round().astype(np.uint8))
    return images, float(np.exp(np.mean(logarithms)))
