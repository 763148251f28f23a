"""The command line, `nlt`. Each command imports its heavy modules itself, so that `nlt --help` starts at once."""

import sys
from argparse import Namespace
from collections.abc import Callable, Sequence
from pathlib import Path

from nlt.arguments import EXPERIMENTS_OF_LIGHTS, LIGHTNING, command_parser
from nlt.errors import UserError, to_user_error
from nlt.paths import is_checkpoint
from nlt.waiting import wait_passively


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code."""
    return exit_code(lambda: _run(list(sys.argv[1:] if argv is None else argv)))


def exit_code(work: Callable[[], None]) -> int:
    """Do some work and return the exit code: 0, 2 after a user error (printed in one line), 130 if interrupted."""
    try:
        work()
    except UserError as error:
        print(f"nlt: error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"nlt: error: {to_user_error(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("nlt: interrupted; run the same command again to continue", file=sys.stderr)
        return 130
    return 0


def _run(arguments: list[str]) -> None:
    if arguments and arguments[0] in LIGHTNING:
        from nlt.training import run_lightning

        trainer = run_lightning(arguments).trainer
        if arguments[0] == "fit":
            print(f"written to {trainer.log_dir}")
        return
    options, unknown = command_parser().parse_known_args(arguments)
    if unknown:
        raise UserError(f"unknown arguments: {' '.join(unknown)}; see nlt {options.command} --help")
    if options.command in ("compare", "render", "view"):  # Mitsuba and PyTorch alternate within a frame
        wait_passively()
    _COMMANDS[options.command](options)


def _generate(options: Namespace) -> None:
    from nlt.data.generate import generate
    from nlt.data.spec import load_spec

    spec, root = load_spec(options.config, options.settings)
    print(generate(spec, root, options.workers, options.scheduler, dict(options.slurm)))


def _data(options: Namespace) -> None:
    if options.action == "show":
        from nlt.report.sample import show_sample

        print(show_sample(options.dataset, options.split, options.index, options.output))
    elif options.action == "verify":
        from nlt.data.verify import verify

        verify(options.dataset)
    else:
        from nlt.data.stats import stats

        print(stats(options.dataset, options.workers))


def _compare(options: Namespace) -> None:
    from nlt.evaluation.compare import compare
    from nlt.evaluation.comparison import Comparison
    from nlt.evaluation.results import load
    from nlt.evaluation.trainings import generate_datasets
    from nlt.report.tables import write_tables

    overrides = (options.scale, options.data, options.methods, options.seeds, options.precision, options.train_images)
    comparison, machines = Comparison.load(options.config, *overrides), (options.workers, options.scheduler)
    dataset = generate_datasets(comparison, *machines, dict(options.slurm))
    after_row = lambda folder: write_tables(load(folder))
    directory = compare(comparison, dataset, options.out, *machines, dict(options.slurm), after_row)
    _draw(directory)
    print(f"\nwritten to {directory}: {', '.join(sorted(path.name for path in directory.iterdir()))}")


def _stress(options: Namespace) -> None:
    from nlt.stress.run import stress

    selection = (options.methods, options.suites, options.manifest, options.views)
    stress(options.config, options.out, options.scale, options.data, *selection)


def _select(options: Namespace) -> None:
    from nlt.select.run import select

    select(options.config, options.minutes, options.out, options.advice)


def _export(options: Namespace) -> None:
    from nlt.evaluation.export import export

    export(options.checkpoint, options.output, options.resolution, options.photons)


def _report(options: Namespace) -> None:
    if options.dashboard is None:
        _draw(options.directory, options.megabytes)
    else:
        from nlt.report.dashboard import dashboard

        dashboard(options.directory, options.dashboard)


def _draw(directory: str | Path, megabytes: int | None = None) -> None:
    from nlt.report.draw import draw
    from nlt.stress.report import stress_section

    draw(directory, megabytes, [stress_section])


def _render(options: Namespace) -> None:
    source, scene = options.source, options.scene
    if options.demo == bool(source) or (source and not scene and is_checkpoint(source)):
        raise UserError("give SCENE, CKPT and SCENE, or --demo; see nlt render --help")
    from nlt.view.drawing import DEMO, DEMO_SCENE
    from nlt.view.video import render

    checkpoints: dict[str, str] = {}
    state, light, lights = options.state, options.light, options.lights
    if options.demo:
        checkpoints, scene = DEMO, DEMO_SCENE
        light = light or ("turntable" if lights != "own" and (state or "0").isdecimal() else None)
    elif scene:
        checkpoints = {"": source}
    else:
        scene, state = source, state or "rest"
        lights = lights or ("moving" if light else None)
    render(
        checkpoints=checkpoints,
        scene=scene,
        output=options.output,
        state=state or "0",
        light=light,
        experiment=EXPERIMENTS_OF_LIGHTS.get(lights),
        camera_path=options.camera_path,
        frames=options.frames,
        resolution=options.resolution,
        fps=options.fps,
        spp=options.spp,
        photons=options.photons,
        layers=options.exr,
        steady=options.steady,
    )


def _view(options: Namespace) -> None:
    if options.demo == bool(options.source):
        raise UserError("give SCENE, CKPT, RESULTS or --demo; see nlt view --help")
    from nlt.view.page import view

    experiment = EXPERIMENTS_OF_LIGHTS.get(options.lights)
    view(options.source, options.scene, options.host, options.port, options.resolution, experiment)


def _scenes(options: Namespace) -> None:
    if options.action == "list":
        from nlt.scenes.description import listing

        print(listing())
        return
    if options.action == "preview":
        from nlt.view.preview import contact_sheet

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
        file = describe.add(options.file, options.name, options.output)
        scene = options.output or options.name or file.stem
        print(f"written to {file}: check and edit it, then look at it: nlt scenes preview {scene} -o {file.stem}.png")


_COMMANDS: dict[str, Callable[[Namespace], None]] = {
    "generate": _generate, "data": _data, "compare": _compare, "stress": _stress, "select": _select,
    "report": _report, "export": _export, "render": _render, "view": _view, "scenes": _scenes,
}  # fmt: skip

if __name__ == "__main__":
    sys.exit(main())
