"""`nlt scenes preview`: a contact sheet of scenes in random states, from random views."""

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from nlt.data.engines import Process
from nlt.display import display_bytes
from nlt.rendering.renderer import Renderer
from nlt.rendering.variant import choose_variant, use_variant
from nlt.scenes.assembly import Scene
from nlt.scenes.description import SceneDescription, load_description
from nlt.scenes.state import sample_state
from nlt.scenes.views import Views

_TITLE, _GAP = 24, 4  # pixels
_KEY = 0.18  # geometric mean luminance of a well-exposed picture (Reinhard et al. 2002)
_LUMINANCE = (0.2126, 0.7152, 0.0722)  # weights for linear sRGB (ITU-R BT.709)
_BLACK = 1e-3  # the least luminance that is visible; keeps the logarithm finite


def contact_sheet(
    names: list[str],
    output: Path,
    views: int = 4,
    resolution: int = 256,
    spp: int = 64,
    experiment: str = "fixed_lights",
    seed: int = 0,
) -> None:
    """Write a picture with a row per scene and a column per view, each in a random state of the experiment.

    Prints each scene's mean luminance at its exposure, and the exposure that would suit these views.

    Raises:
        UserError: a scene is unknown, does not load, or has no such experiment.
    """
    descriptions = [load_description(name) for name in names]  # fails before anything is rendered
    width, height = views * (resolution + _GAP) + _GAP, resolution + _TITLE + _GAP
    sheet = Image.new("RGB", (width, len(names) * height), "white")
    draw = ImageDraw.Draw(sheet)
    choose_variant()  # once; child processes inherit it
    # A process per scene, because Mitsuba's memory grows with every scene.
    for row, (name, description) in enumerate(zip(names, descriptions, strict=True)):
        images, mean = Process(_images, description, views, resolution, spp, experiment, seed).result()
        suggested = description.exposure * _KEY / mean
        brightness = f"mean luminance {mean:.2g} at exposure {description.exposure:g}"
        print(f"{name}: {brightness}; exposure {suggested:.2g} would give mid-grey ({_KEY})", flush=True)
        title = f"{name} ({experiment.replace('_', ' ')}, exposure {description.exposure:g}, {spp} spp)"
        draw.text((_GAP, row * height + _GAP), title, "black", font_size=14)
        for column, image in enumerate(images):
            corner = (_GAP + column * (resolution + _GAP), row * height + _TITLE)
            sheet.paste(Image.fromarray(image), corner)
    output.parent.mkdir(parents=True, exist_ok=True)
    sheet.save(output, optimize=True, quality=90)  # quality of a JPEG, which is a fifth of a noisy PNG's size


def _images(
    description: SceneDescription, views: int, resolution: int, spp: int, experiment: str, seed: int
) -> tuple[list[np.ndarray], float]:
    """Return a scene's (H, W, 3) uint8 sRGB images and the geometric mean of their exposed luminance."""
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
        images.append(display_bytes(radiance, description.exposure))
    return images, float(np.exp(np.mean(logarithms)))
