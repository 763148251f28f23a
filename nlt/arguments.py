"""The arguments of all commands: `nlt COMMAND --help`."""

import argparse
from pathlib import Path
from typing import Any, NoReturn

from nlt import __version__
from nlt.errors import UserError

LIGHTNING = {
    "fit": "train one method with configs of data, model and scale",
    "validate": "compute the validation metrics of a checkpoint with the same configs",
    "test": "compute all metrics of a checkpoint on the test split",
    "predict": "write the images that a checkpoint predicts for the test split",
}

# Help texts of several commands.
_IMAGE = "image file to write (default: {})"
_PICTURES = (".png", ".jpg", ".jpeg", ".pdf")
EXPERIMENTS_OF_LIGHTS: dict[str, Any] = {"own": "fixed_lights", "moving": "moving_lights"}
_SCENE = "description in configs/scenes or in your ./scenes, by name or path"


class _Commands(argparse._SubParsersAction):
    def add_parser(self, name: str, *, help: str, **options: Any) -> Any:  # type: ignore[override]
        """Add a command whose own help begins with its text in the list of commands."""
        return super().add_parser(name, help=help, description=f"{help[0].upper()}{help[1:]}.", **options)


class Parser(argparse.ArgumentParser):
    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.register("action", "parsers", _Commands)

    def error(self, message: str) -> NoReturn:
        """Raise a user error, which is printed in one line."""
        raise UserError(f"{message}; see {self.prog} --help")


def command_parser() -> Parser:
    """Return the parser of the command line; Lightning parses the arguments of the commands in `LIGHTNING`."""
    parser = Parser(
        prog="nlt", description="Learned light transport: find the best renderer for a scene and a time budget.",
        epilog="`nlt compare --config demo` runs everything in minutes. Datasets are written to datasets, trainings to "
        "runs and results to results, all in the current directory. docs/commands.md describes all commands.",
    )  # fmt: skip
    parser.add_argument("--version", action="version", version=f"nlt {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="command")
    generate = commands.add_parser("generate", help="render a dataset, or its missing files")
    generate.add_argument(
        "--config", action="append", required=True, help="config by name, for example data/demo, or path; repeatable"
    )
    generate.add_argument(
        "settings", nargs="*", type=pair, metavar="KEY=VALUE",
        help="setting that overrides all configs, for example data.dataset.resolution=32",
    )  # fmt: skip
    _add_scheduler(generate, "concurrent jobs (default: available CPUs; on Dask, its threads; in a Slurm array, 64)")
    data = commands.add_parser("data", help="show, verify or measure a dataset")
    _add_data(data)
    for name, text in LIGHTNING.items():
        commands.add_parser(name, help=text)
    compare = commands.add_parser("compare", help="compare methods: generate, train, evaluate, time and draw")
    stress = commands.add_parser("stress", help="find where a comparison's methods fail, at increasing severity")
    for command in (compare, stress):
        command.add_argument("--config", required=True, help="comparison in configs/compare, by name or path")
        command.add_argument("--out", help="directory for the results (default: results/NAME or NAME_SCALE_DATA)")
        command.add_argument("--scale", help="config in configs/scale, by name or path (default: the comparison's)")
        command.add_argument("--data", help="config in configs/data, by name or path (default: the comparison's)")
        command.add_argument("--methods", nargs="+", help="configs in configs/model (default: the comparison's or all)")
    stress.add_argument("--suites", nargs="+", type=_suite, help="suites in the manifest (default: all)")
    stress.add_argument(
        "--manifest", default="suites", help="file in configs/stress, by name or path (default: suites)"
    )
    stress.add_argument("--views", type=positive, help="views per scene (default: the manifest's)")
    compare.add_argument("--seeds", type=positive, default=1, help="training runs per method (default: 1)")
    compare.add_argument(
        "--train-images", nargs="+", type=positive, default=[], metavar="N",
        help="also train every method on the first N images of each scene, for learning curves",
    )  # fmt: skip
    _add_scheduler(
        compare,
        "concurrent training runs (default and at most: one per core; on a GPU 1; on a cluster, as for generate)",
    )
    compare.add_argument(
        "--precision", choices=("auto", "32", "bf16"), default="auto",
        help="precision of training, evaluation and timing (default: auto, bf16 if the device supports it natively)",
    )  # fmt: skip
    export = commands.add_parser("export", help="export a trained network as one file that only needs PyTorch")
    export.add_argument("checkpoint", metavar="CKPT", help="checkpoint from nlt fit")
    export.add_argument(
        "-o", "--output", required=True,
        help="torch.export program, for example nlt.pt2, or NAME.safetensors: only the weights, for nlt render",
    )  # fmt: skip
    export.add_argument(
        "--resolution", type=positive, default=256, help="image height and width in pixels (default: 256)"
    )
    export.add_argument("--photons", type=positive, default=10000, help="number of input photons (default: 10000)")
    _add_render(commands.add_parser("render", help="render a video with a trained method next to path tracing"))
    _add_view(commands.add_parser("view", help="explore a scene in the browser, drawn by trained methods"))
    select = commands.add_parser("select", help="find the smallest model that suffices for a scene, within minutes")
    select.add_argument("--config", required=True, help="ladder in configs/select, by name or path")
    select.add_argument("--minutes", type=float, help="time limit of measuring and training (default: the ladder's)")
    select.add_argument("--out", help="directory for the results (default: results/select/NAME)")
    select.add_argument(
        "--advice", action="store_true", help="report what varies in the scene and what a model needs; train nothing"
    )
    report = commands.add_parser("report", help="redraw a comparison's tables, figures and report.html, or show them")
    report.add_argument("directory", help="results directory of nlt compare")
    report.add_argument("--megabytes", type=positive, help="maximum size of report.html (default: 25)")
    report.add_argument(
        "--dashboard", nargs="?", type=_whole, const=6006, metavar="PORT",
        help="show the training runs and results in TensorBoard instead (default port: 6006; 0 takes a free one)",
    )  # fmt: skip
    _add_scenes(commands.add_parser("scenes", help="list, show, check, add or preview scenes"))
    return parser


def _add_scheduler(parser: argparse.ArgumentParser, workers: str) -> None:
    parser.add_argument("--workers", type=positive, help=workers)
    parser.add_argument(
        "--scheduler", default="local",
        help="local, slurm or a Dask scheduler, for example tcp://host:8786 (default: local)",
    )  # fmt: skip
    parser.add_argument(
        "--slurm", action="append", type=pair, default=[], metavar="KEY=VALUE",
        help="option of sbatch, for example time=60",
    )  # fmt: skip


def _add_render(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "source", nargs="?", metavar="CKPT",
        help="checkpoint, or NAME.safetensors from nlt export (default: Open Image Denoise)",
    )  # fmt: skip
    parser.add_argument("scene", nargs="?", metavar="SCENE", help=_SCENE)
    parser.add_argument("--demo", action="store_true", help="use the two models that come with nlt and move the light")
    parser.add_argument(
        "--state", help="rest, index of a random state, or a YAML file (default: 0; without CKPT, rest)"
    )
    _add_lights(parser)
    parser.add_argument("--light", choices=("turntable",), help="move the light around (default: as in --state)")
    parser.add_argument(
        "--camera-path", default="turntable", help="turntable, or a YAML or JSON file with views (default: turntable)"
    )
    parser.add_argument("-o", "--output", default="video.mp4", help="NAME.mp4 or a frame folder (default: video.mp4)")
    for option, default, text in (("--frames", 36, "number of frames"), ("--fps", 24, "frames per second")):
        parser.add_argument(option, type=positive, default=default, help=f"{text} (default: {default})")
    parser.add_argument("--resolution", type=_size, default=(256, 256), help="N or WIDTHxHEIGHT, pixels (default: 256)")
    parser.add_argument(
        "--spp", type=_spp, help="samples per pixel of path tracing; 0 omits it (default: equal, at equal time)"
    )
    parser.add_argument("--photons", type=positive, help="number of input photons (default: as in training)")
    parser.add_argument("--steady", action="store_true", help="blend each frame with those before it: less flicker")
    parser.add_argument("--exr", action="store_true", help="also write each frame as a multi-layer EXR into the folder")


def _add_lights(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--lights", choices=tuple(EXPERIMENTS_OF_LIGHTS),
        help="the scene's own lights, or the moving light alone (default: as in training; without CKPT, own)",
    )  # fmt: skip


def _add_view(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "source", nargs="?", metavar="CKPT|RESULTS",
        help="checkpoint, NAME.safetensors from nlt export, or results directory of nlt compare (default: Open "
        "Image Denoise and path tracing)",
    )  # fmt: skip
    parser.add_argument("scene", nargs="?", metavar="SCENE", help=f"{_SCENE} (default: the first of the training)")
    parser.add_argument("--demo", action="store_true", help="use the two models that come with nlt")
    _add_lights(parser)
    parser.add_argument("--host", default="127.0.0.1", help="address to listen at (default: 127.0.0.1, this machine)")
    parser.add_argument(
        "--port", type=_whole, default=8080, help="port to listen at; 0 takes a free one (default: 8080)"
    )
    parser.add_argument(
        "--resolution", type=positive, default=256,
        help="most pixels of a picture, as the side of a square (default: 256)",
    )  # fmt: skip


def _add_scenes(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(dest="action", required=True, metavar="action")
    actions.add_parser("list", help="list the scene descriptions in configs/scenes and in your ./scenes")
    show = actions.add_parser("show", help="show the content of a scene description and its scene")
    show.add_argument("name", help=_SCENE)
    check = actions.add_parser("check", help="load a scene file and report its content, problems and description")
    add = actions.add_parser("add", help="measure a scene file and write a scene description that you can edit")
    for action in (check, add):
        action.add_argument("file", type=Path, help="Mitsuba XML (0.5 to 3.x), glTF, GLB or OBJ")
    add.add_argument("--name", help="name of the scene (default: the file's name, or its folder's for scene.xml)")
    add.add_argument("-o", "--output", type=Path, help="file to write (default: scenes/NAME.yaml)")
    preview = actions.add_parser("preview", help="draw a contact sheet with one row of random views per scene")
    preview.add_argument("-o", "--output", type=_picture, default="preview.png", help=_IMAGE.format("preview.png"))
    preview.add_argument("names", nargs="+", help=f"scenes: each a {_SCENE}")
    preview.add_argument("--views", type=positive, default=4, help="random views per scene (default: 4)")
    preview.add_argument(
        "--resolution", type=positive, default=256, help="image height and width in pixels (default: 256)"
    )
    preview.add_argument("--spp", type=positive, default=64, help="samples per pixel (default: 64)")
    preview.add_argument(
        "--experiment", type=_experiment, default="fixed_lights",
        help="static, fixed_lights or moving_lights (default: fixed_lights)",
    )  # fmt: skip
    preview.add_argument("--seed", type=_whole, default=0, help="seed of states, views and noise (default: 0)")


def _add_data(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(dest="action", required=True, metavar="action")
    show = actions.add_parser("show", help="draw the twelve components of a sample")
    show.add_argument("--split", choices=("val", "test"), default="test", help="split of the sample (default: test)")
    show.add_argument("--index", type=_whole, default=0, help="index of the sample in its split (default: 0)")
    show.add_argument("-o", "--output", type=_picture, default="sample.png", help=_IMAGE.format("sample.png"))
    verify = actions.add_parser("verify", help="read every byte and report everything that is wrong")
    stats = actions.add_parser("stats", help="measure bytes and seconds by field, here and at the paper's scale")
    stats.add_argument("--workers", type=positive, help="concurrent processes (default: available CPUs)")
    for action in (show, verify, stats):
        action.add_argument("dataset", help="directory or URL that nlt generate prints")


def pair(text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not (key and equals and value):
        raise argparse.ArgumentTypeError(f"must be KEY=VALUE, is {text!r}")
    return key, value


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    return positive(width), positive(height or width)


def _spp(text: str) -> int | None:
    return None if text == "equal" else _whole(text)


def _experiment(text: str) -> str:
    from nlt.scenes.description import EXPERIMENTS

    if text not in EXPERIMENTS:
        raise argparse.ArgumentTypeError(f"must be one of {', '.join(EXPERIMENTS)}, is {text!r}")
    return text


def _suite(text: str) -> str:
    from nlt.stress.suites import SUITES

    if text not in SUITES:
        raise argparse.ArgumentTypeError(f"must be one of {', '.join(SUITES)}, is {text!r}")
    return text


def positive(text: str) -> int:
    return _whole(text, 1)


def _whole(text: str, least: int = 0) -> int:
    if not text.isdecimal() or int(text) < least:
        raise argparse.ArgumentTypeError(f"must be a whole number of at least {least}, is {text!r}")
    return int(text)


def _picture(text: str) -> Path:
    if Path(text).suffix.lower() not in _PICTURES:
        raise argparse.ArgumentTypeError(f"must end in one of {', '.join(_PICTURES)}, is {text!r}")
    return Path(text)
