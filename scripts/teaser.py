"""Draw the README's first picture: one view by the methods of a comparison, with the milliseconds that each takes.

    python scripts/teaser.py results/NAME --view 3 --methods cnn guided_1spp oidn_1 [-o docs/teaser.webp]

The results must be on the machine that made them, because their images are not in git.
"""

import argparse
from pathlib import Path

from nlt.errors import UserError
from nlt.evaluation.paper import label
from nlt.evaluation.results import load
from nlt.report.gallery import Shown
from nlt.report.plots import PICTURE, in_lines, plt, save

_WIDTH, _TITLE = 2.56, 0.7  # inches: an image, so that one of 256 pixels is drawn as it is, and its title
_CHARACTERS = 28  # of a line of the title


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path)
    parser.add_argument("--view", type=int, default=0, help="number of the stored view")
    parser.add_argument("--methods", nargs="+", required=True)
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/teaser.webp"))
    options = parser.parse_args()
    results = load(options.results)
    images = Shown.load(results)
    if images is None:
        raise UserError(f"{options.results}/images: missing; run nlt compare there again")
    milliseconds = lambda method: 1000 * results.mean(method, "time_per_frame_s")
    time = lambda method: f"{in_lines(label(method), _CHARACTERS)}\n{milliseconds(method):.0f} ms"
    pictures = {time(method): images.methods[method][options.view] for method in options.methods}
    pictures["Reference"] = images.reference[options.view]
    figure, axes = plt.subplots(1, len(pictures), figsize=(_WIDTH * len(pictures), _WIDTH + _TITLE), squeeze=False)
    figure.subplots_adjust(0, 0, 1, _WIDTH / (_WIDTH + _TITLE), 0.01)
    for axis, (title, picture) in zip(axes[0], pictures.items(), strict=True):
        axis.imshow(picture)
        axis.set_axis_off()
        axis.set_title(title, fontsize=12)
    save(figure, options.output.parent, options.output.stem, PICTURE)


if __name__ == "__main__":
    main()
