"""Contact sheets against images rendered and exposed by hand."""

import numpy as np
import pytest
from conftest import write_room
from PIL import Image

from nlt.errors import UserError
from nlt.rendering.renderer import Renderer
from nlt.scenes.assembly import Scene
from nlt.scenes.description import load_description
from nlt.scenes.state import sample_state, sample_view
from nlt.view.preview import contact_sheet


def test_contact_sheet(tmp_path, capsys):
    files = [write_room(tmp_path / name, exposure=exposure) for name, exposure in (("a", 1.0), ("b", 0.3))]
    sheet = tmp_path / "new" / "sheet.png"
    contact_sheet([str(file) for file in files], sheet, views=3, resolution=20, spp=8, seed=5)
    picture = np.asarray(Image.open(sheet)).astype(int)
    said = capsys.readouterr().out.splitlines()
    for row, file in enumerate(files):
        logarithms = []
        description = load_description(str(file))
        scene = Scene(description, "fixed_lights")
        renderer = Renderer(scene)
        for column in range(3):
            rng = np.random.default_rng([5, column])
            scene.set_state(sample_state(description, "fixed_lights", rng))
            linear = renderer.radiance(sample_view(description, 20, rng), 8, 5 + column) * description.exposure
            logarithms.append(np.log(linear.T @ [0.2126, 0.7152, 0.0722] + 1e-3))
            linear = np.clip(np.moveaxis(linear, 0, 2), 0, 1)
            encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
            top, left = row * (20 + 28) + 24, 4 + column * 24
            assert np.abs(picture[top : top + 20, left : left + 20] - 255 * encoded).max() <= 1
        mean = np.exp(np.mean(logarithms))
        assert said[row].startswith(f"{file}: mean luminance {mean:.2g} at exposure {description.exposure:g};")
        assert said[row].endswith(f"; exposure {0.18 / mean * description.exposure:.2g} would give mid-grey (0.18)")
    assert len({picture[24:44, 4 + 24 * k : 24 + 24 * k].tobytes() for k in range(3)}) == 3


def test_a_wrong_name_renders_nothing(tmp_path):
    with pytest.raises(UserError, match=r"palace.*known scenes"):
        contact_sheet(["living_room", "palace"], tmp_path / "sheet.png")
    assert not list(tmp_path.iterdir())
