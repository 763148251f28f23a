"""The one entry point, `nlt`. Parsing only: whatever is heavy is imported inside its subcommand."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

from nlt import __version__
from nlt.errors import UserError, to_user_error
from nlt.waiting import wait_passively

_LIGHTNING = {
    "fit": "train one method, of configs of data, model and scale",
    "validate": "compute the validation metrics of a checkpoint, of the same configs",
    "test": "compute all metrics of a checkpoint on the test split",
    "predict": "write a checkpoint's images of the test split",
}

# Commands in which Mitsuba and PyTorch take turns at frames.
_FRAMES = ("bench", "compare", "render")

# Words of several commands' help.
_OUT, _IMAGE = "directory of the results (default: {})", "image to write (default: {})"
_PICTURES = (".png", ".jpg", ".jpeg", ".pdf")
_VIEWS, _SIDE = "random views of each scene", "height and width of an image"


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command. Returns the exit code: 0, or 2 for a user's mistake, said in one line."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        return _run(arguments)
    except UserError as error:
        print(f"nlt: error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"nlt: error: {to_user_error(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("nlt: interrupted; run the same command again to go on", file=sys.stderr)
        return 130


class _Commands(argparse._SubParsersAction):
    def add_parser(self, name: str, *, help: str, **options: Any) -> Any:  # type: ignore[override]
        """A command's own help begins with what the list of commands says of it."""
        return super().add_parser(name, help=help, description=f"{help[0].upper()}{help[1:]}.", **options)


class _Parser(argparse.ArgumentParser):
    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.register("action", "parsers", _Commands)

    def error(self, message: str) -> NoReturn:
        """One line for a mistake here as everywhere."""
        raise UserError(f"{message}; see {self.prog} --help")


def _run(arguments: list[str]) -> int:
    if arguments and arguments[0] in _LIGHTNING:
        from nlt.training import run_lightning

        run_lightning(arguments)
        return 0
    options = _parser().parse_args(arguments)
    if options.command in _FRAMES:
        wait_passively()
    if options.command == "generate":
        from nlt.data.generate import generate
        from nlt.data.spec import load_spec

        print(generate(*load_spec(options.config), options.workers, options.scheduler, dict(options.slurm)))
    elif options.command == "data":
        _run_data(options)
    elif options.command == "compare":
        _compare(options)
    elif options.command == "export":
        from nlt.evaluation.export import export

        export(options.checkpoint, options.output, options.resolution, options.photons)
    elif options.command == "render":
        _render(options)
    elif options.command == "bench":
        _bench(options)
    elif options.command == "select":
        from nlt.select.run import select

        select(options.config, options.minutes, options.out, options.advice)
    elif options.command == "stress":
        from nlt.stress.run import stress

        how = (options.methods, options.suites, options.manifest, options.views)
        stress(options.config, options.out, options.scale, options.data, *how)
    elif options.command == "report":
        _draw(options.directory, options.megabytes)
    elif options.command == "dashboard":
        from nlt.report.dashboard import dashboard

        dashboard(options.directory, options.port)
    elif options.command == "scenes":
        _scenes(options)
    elif options.command == "teachers":
        from nlt.bench.teachers import teachers

        size = options.resolution
        teachers(options.names, options.out, options.seconds, size, options.views, options.experiment, options.seed)
    return 0


def _compare(options: argparse.Namespace) -> None:
    from nlt.evaluation.compare import compare
    from nlt.evaluation.comparison import Comparison
    from nlt.evaluation.results import load
    from nlt.report.tables import write_tables

    chosen = (options.scale, options.data, options.methods, options.seeds, options.precision)
    comparison, slurm = Comparison.load(options.config, *chosen), dict(options.slurm)
    where = (options.out, options.workers, options.scheduler, slurm)
    directory = compare(comparison, *where, options.train_images, lambda directory: write_tables(load(directory)))
    _draw(directory)
    print(f"\nwritten to {directory}: {', '.join(sorted(path.name for path in directory.iterdir()))}")


def _draw(directory: str | Path, megabytes: int | None = None) -> None:
    from nlt.report.draw import draw
    from nlt.stress.figures import stress_section

    draw(directory, megabytes, [stress_section])


def _bench(options: argparse.Namespace) -> None:
    from nlt.bench.run import bench

    bench(
        out=options.out,
        data=options.data,
        scale=options.scale,
        methods=options.methods,
        changed=dict(options.set),
        checkpoint=options.ckpt,
        device=options.device,
        seconds=options.seconds,
        growth=["nlt_photons"] if options.growth == [] else options.growth,
    )


def _render(options: argparse.Namespace) -> None:
    if options.demo == bool(options.checkpoint) or (options.checkpoint and not options.scene):
        raise UserError("give CKPT and SCENE, or --demo alone; see nlt render --help")
    from nlt.evaluation.render import DEMO, render

    demo = options.demo
    render(
        checkpoint=str(DEMO) if demo else options.checkpoint,
        scene=DEMO.stem if demo else options.scene,
        output=options.output,
        state=options.state,
        light=options.light or ("turntable" if demo and options.state.isdecimal() else None),
        camera_path=options.camera_path,
        frames=options.frames,
        resolution=options.resolution,
        fps=options.fps,
        spp=options.spp,
        photons=options.photons,
    )


def _scenes(options: argparse.Namespace) -> None:
    if options.action == "list":
        from nlt.scenes.catalog import listing

        print(listing())
        return
    if options.action == "preview":
        from nlt.evaluation.preview import contact_sheet

        views, size = options.views, options.resolution
        contact_sheet(options.names, options.output, views, size, options.spp, options.experiment, options.seed)
        print(options.output)
        return
    from nlt.rendering.variant import use_variant

    use_variant()
    from nlt.scenes import describe

    if options.action == "show":
        print(describe.show(options.name))
    elif options.action == "check":
        print(describe.check(options.file))
    else:
        print(describe.add(options.file, options.name, options.output))


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="nlt", description="Learned light transport: which renderer for this scene and this time budget?",
        epilog="`nlt compare --config demo` shows all of it in minutes; more in docs/commands.md.",
    )  # fmt: skip
    parser.add_argument("--version", action="version", version=f"nlt {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="command")
    generate = commands.add_parser("generate", help="render a dataset, or what is missing of it")
    generate.add_argument(
        "--config", action="append", required=True, help="a YAML file; later ones override earlier ones"
    )
    _add_scheduler(generate, "jobs side by side (default: as many as cores; on Dask, as threads; in a Slurm array, 64)")
    data = commands.add_parser("data", help="show, verify or measure a dataset")
    _add_data(data)
    for name, text in _LIGHTNING.items():
        # Handed to Lightning's own parser before this one sees it; here for the help.
        commands.add_parser(name, help=text)
    compare = commands.add_parser("compare", help="make a table of methods: generate, train, evaluate, time, draw")
    stress = commands.add_parser("stress", help="find where a comparison's methods break: suites of growing severity")
    for command in (compare, stress):
        command.add_argument("--config", required=True, help="a comparison of configs/compare, by name or path")
        command.add_argument("--out", help="directory of the results (default: results/NAME, or NAME-SCALE-DATA)")
        command.add_argument("--scale", help="of configs/scale, by name or path (default: the comparison's)")
        command.add_argument("--data", help="of configs/data, by name or path (default: the comparison's)")
        command.add_argument("--methods", nargs="+", help="of configs/model (default: the comparison's, else all)")
    stress.add_argument("--suites", nargs="+", type=_suite, help="of the manifest (default: all)")
    stress.add_argument("--manifest", default="suites", help="of configs/stress, by name or path (default: suites)")
    stress.add_argument("--views", type=_positive, help="of each scene (default: the manifest's)")
    compare.add_argument("--seeds", type=_positive, default=1, help="trainings of each method (default: 1)")
    compare.add_argument(
        "--train-images", nargs="+", type=_positive, default=[], metavar="N",
        help="also train every method on the first N images of each scene, for the learning curves",
    )  # fmt: skip
    _add_scheduler(compare, "trainings side by side (default: one; on a cluster as nlt generate)")
    compare.add_argument(
        "--precision", choices=("auto", "32", "bf16"), default="auto",
        help="of what is trained, judged and timed (default: auto, bf16 where the device multiplies it)",
    )  # fmt: skip
    _add_bench(commands.add_parser("bench", help="measure what a frame, a training step and a sample cost"))
    export = commands.add_parser("export", help="write a trained network as one file that runs with PyTorch alone")
    export.add_argument("checkpoint", metavar="CKPT", help="a checkpoint of nlt fit")
    export.add_argument(
        "-o", "--output", required=True,
        help="file of the torch.export program, such as nlt.pt2; NAME.safetensors: the weights, for nlt render",
    )  # fmt: skip
    export.add_argument(
        "--resolution", type=_positive, default=256, help="height and width of its images (default: 256)"
    )
    export.add_argument("--photons", type=_positive, default=10000, help="how many it is given (default: 10000)")
    _add_render(commands.add_parser("render", help="make a video of a scene by a trained method, beside path tracing"))
    select = commands.add_parser("select", help="find the smallest model that a scene needs, within minutes")
    select.add_argument("--config", required=True, help="a ladder of configs/select, by name or path")
    select.add_argument("--minutes", type=float, help="to measure and train in (default: the ladder's)")
    select.add_argument("--out", help="directory of the results (default: results/select/NAME)")
    select.add_argument(
        "--advice", action="store_true", help="only say what varies in the scene, and so what is needed; train nothing"
    )
    report = commands.add_parser("report", help="draw tables, figures and report.html of results anew, on any machine")
    report.add_argument("--megabytes", type=_positive, help="of report.html, at most: fewer images (default: 25)")
    board = commands.add_parser("dashboard", help="show a comparison's trainings and results in TensorBoard")
    board.add_argument("--port", type=_whole, default=6006, help="of the server (default: 6006; 0 takes a free one)")
    for command in (report, board):
        command.add_argument("directory", help="of results, as nlt compare wrote them")
    teachers = commands.add_parser("teachers", help="compare path and bdpt: variance at equal time, scene by scene")
    _add_views(teachers, seconds=(60, "of rendering by each teacher"), resolution=(64, _SIDE), views=(4, _VIEWS))
    teachers.add_argument("--out", type=Path, default=Path("results/teachers"), help=_OUT.format("results/teachers"))
    _add_scenes(commands.add_parser("scenes", help="list, show, check, add or preview scenes"))
    return parser


def _add_views(parser: argparse.ArgumentParser, **numbers: tuple[int, str]) -> None:
    """Scenes, and what of them is rendered."""
    parser.add_argument("names", nargs="+", help="descriptions of configs/scenes, by name or path")
    for name, (default, text) in numbers.items():
        parser.add_argument(f"--{name}", type=_positive, default=default, help=f"{text} (default: {default})")
    parser.add_argument(
        "--experiment", type=_experiment, default="fixed_lights",
        help="static, fixed_lights or moving_lights (default: fixed_lights)",
    )  # fmt: skip
    parser.add_argument("--seed", type=_whole, default=0, help="of states, views and noise (default: 0)")


def _add_scheduler(parser: argparse.ArgumentParser, workers: str) -> None:
    parser.add_argument("--workers", type=_positive, help=workers)
    parser.add_argument(
        "--scheduler",
        default="local",
        help="local, slurm, or a Dask scheduler such as tcp://host:8786 (default: local)",
    )
    parser.add_argument(
        "--slurm",
        action="append",
        type=_pair,
        default=[],
        metavar="KEY=VALUE",
        help="an option of sbatch, such as time=60",
    )


def _add_bench(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--data", default="demo", help="of configs/data, by name or path (default: demo)")
    parser.add_argument("--scale", default="demo", help="of configs/scale, by name or path (default: demo)")
    parser.add_argument("--methods", nargs="+", help="of configs/model (default: all)")
    parser.add_argument(
        "--set", nargs="+", action="extend", type=_pair, default=[], metavar="KEY=VALUE",
        help="over the configs: resolution, points, photons, width, depth, batch_size, workers; batch: frames at once",
    )  # fmt: skip
    parser.add_argument("--ckpt", help="a checkpoint of the one method (default: random weights)")
    parser.add_argument("--device", help="cpu or cuda (default: cuda, if there is one)")
    parser.add_argument("--seconds", type=_positive, default=20, help="the most that a measurement takes (default: 20)")
    parser.add_argument(
        "--growth", nargs="*", metavar="METHOD",
        help="also measure over resolution, points, photons, width and batch (without a name: nlt_photons)",
    )  # fmt: skip
    parser.add_argument("--out", default="results/bench", help=_OUT.format("results/bench"))


def _add_render(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("checkpoint", nargs="?", metavar="CKPT", help="of nlt fit, or NAME.safetensors of nlt export")
    parser.add_argument("scene", nargs="?", metavar="SCENE", help="a description of configs/scenes, by name or path")
    parser.add_argument("--demo", action="store_true", help="take the model that comes with nlt, and move the light")
    parser.add_argument("--state", default="0", help="the number of a random state, or a YAML file (default: 0)")
    parser.add_argument("--light", choices=("turntable",), help="moves around (default: as --state says)")
    parser.add_argument(
        "--camera-path", default="turntable", help="turntable, or a YAML or JSON file of views (default: turntable)"
    )
    parser.add_argument("-o", "--output", default="video.mp4", help="NAME.mp4 or a folder (default: video.mp4)")
    for option, default in (("--frames", 36), ("--fps", 24)):
        parser.add_argument(option, type=_positive, default=default, help=f"(default: {default})")
    parser.add_argument("--resolution", type=_size, default=(256, 256), help="N or WIDTHxHEIGHT (default: 256)")
    parser.add_argument(
        "--spp", type=_spp, help="of path tracing beside it; 0 for none (default: equal, what takes as long)"
    )
    parser.add_argument("--photons", type=_positive, help="to cast (default: as the method was trained with)")


def _add_scenes(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(dest="action", required=True, metavar="action")
    actions.add_parser("list", help="list the descriptions of configs/scenes")
    show = actions.add_parser("show", help="say what a description and its scene hold")
    show.add_argument("name", help="of a description of configs/scenes, or a path")
    check = actions.add_parser("check", help="load a scene file; say what it has, what it lacks, what to make of it")
    add = actions.add_parser("add", help="measure a scene file and write a description of it, to edit")
    for action in (check, add):
        action.add_argument("file", type=Path, help="Mitsuba XML (0.5 to 3.x), glTF, GLB or OBJ")
    add.add_argument("--name", help="of the scene (default: the file's, or its folder's for scene.xml)")
    add.add_argument("-o", "--output", type=Path, help="file to write (default: configs/scenes/NAME.yaml)")
    preview = actions.add_parser("preview", help="draw a contact sheet: a row per scene, random views of random states")
    preview.add_argument("-o", "--output", type=_picture, default="preview.png", help=_IMAGE.format("preview.png"))
    _add_views(preview, views=(4, _VIEWS), resolution=(256, _SIDE), spp=(64, "samples per pixel"))


def _add_data(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(dest="action", required=True, metavar="action")
    show = actions.add_parser("show", help="draw the twelve components of a sample")
    show.add_argument("--split", choices=("val", "test"), default="test", help="of the sample (default: test)")
    show.add_argument("--index", type=_whole, default=0, help="of the sample in its split (default: 0)")
    show.add_argument("-o", "--output", type=_picture, default="sample.png", help=_IMAGE.format("sample.png"))
    verify = actions.add_parser("verify", help="read every byte and say all that is wrong")
    stats = actions.add_parser("stats", help="measure bytes and seconds by field, here and at the paper's scale")
    stats.add_argument("--workers", type=_positive, help="processes side by side (default: as many as cores)")
    for action in (show, verify, stats):
        action.add_argument("dataset", help="directory or URL, as nlt generate prints it")


def _run_data(options: argparse.Namespace) -> None:
    if options.action == "show":
        from nlt.report.sample import show_sample

        print(show_sample(options.dataset, options.split, options.index, options.output))
    elif options.action == "verify":
        from nlt.data.verify import verify

        verify(options.dataset)
    else:
        from nlt.data.stats import stats

        print(stats(options.dataset, options.workers))


def _pair(text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not (key and equals and value):
        raise argparse.ArgumentTypeError(f"must be KEY=VALUE, is {text!r}")
    return key, value


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    return _positive(width), _positive(height or width)


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


def _positive(text: str) -> int:
    return _whole(text, 1)


def _whole(text: str, least: int = 0) -> int:
    if not text.isdecimal() or int(text) < least:
        raise argparse.ArgumentTypeError(f"must be a whole number of at least {least}, is {text!r}")
    return int(text)


def _picture(text: str) -> Path:
    if Path(text).suffix.lower() not in _PICTURES:
        raise argparse.ArgumentTypeError(f"must end in one of {', '.join(_PICTURES)}, is {text!r}")
    return Path(text)


if __name__ == "__main__":
    sys.exit(main())
