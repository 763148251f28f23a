"""Rendering a dataset: short-lived worker processes fill shards; what is there already is kept."""

from __future__ import annotations

import multiprocessing
import multiprocessing.connection
import os
import shutil
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tqdm import tqdm

from nlt.data.render import SampleRenderer
from nlt.data.sample import SPLITS
from nlt.data.spec import DatasetSpec, Shard
from nlt.data.store import MANIFEST, missing_files, points_path, write_manifest, write_shard
from nlt.errors import UserError
from nlt.rendering.variant import choose_variant

# Mitsuba's memory grows with every scene and state: a worker renders so many samples and ends.
_SAMPLES_PER_WORKER = 1024


def generate(spec: DatasetSpec, root: Path, workers: int | None = None) -> Path:
    """Render what is missing of a dataset and return its directory.

    Killed at any time and run again, it redoes at most the unfinished shards, with the same bytes.

    Raises:
        UserError: a scene is wrong, a worker failed twice, or the disk has no room.
    """
    directory = spec.directory(root)
    missing = set(missing_files(directory, spec))
    if not missing and (directory / MANIFEST).exists():
        return directory
    for leftover in directory.glob("**/.*.tmp"):
        if not _alive(int(leftover.name.split(".")[-2])):
            leftover.unlink(missing_ok=True)
    variant = choose_variant()
    write_manifest(directory, spec, f"{variant.name}: {variant.reason}")
    print(f"rendering with {variant.name}: {variant.reason}", flush=True)
    shards = [shard for shard in spec.shards() if directory / shard.name in missing]
    _announce(spec, directory, shards, workers or _cores())
    jobs = _plan(spec, shards, missing, directory, workers or _cores())
    _run(jobs, spec, directory, sum(s.stop - s.start for s in shards), workers or _cores())
    return directory


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _announce(spec: DatasetSpec, directory: Path, shards: list[Shard], workers: int) -> None:
    """Say what it will take before it starts; refuse what the disk cannot hold."""
    samples = {split: sum(s.stop - s.start for s in shards if s.split == split) for split in SPLITS}
    size = sum(count * spec.nbytes(split) for split, count in samples.items())
    free = shutil.disk_usage(directory).free
    if size > free:
        raise UserError(
            f"{directory}: no space left on disk: the dataset needs {size / 1e9:.1f} GB, {free / 1e9:.1f} GB are free"
        )
    train, evaluated = _in_process(_measure, spec)
    seconds = (samples["train"] * train + (samples["val"] + samples["test"]) * evaluated) / workers
    total = sum(samples.values())
    print(
        f"{directory}: {total} samples to render, about {seconds / 60:.1f} min with {workers} workers, "
        f"{size / 1e9:.2f} GB of {free / 1e9:.0f} GB free",
        flush=True,
    )


def _plan(
    spec: DatasetSpec, shards: list[Shard], missing: set[Path], directory: Path, workers: int
) -> list[tuple[int, list[Shard], bool]]:
    """Jobs for one worker process each: (scene, shards, whether to sample the scene's points)."""
    jobs = []
    for scene in range(len(spec.scenes)):
        mine = [shard for shard in shards if shard.scene == scene]
        most = max(1, min(_SAMPLES_PER_WORKER // spec.shard_size, -(-len(shards) // workers)))
        points = points_path(directory, scene) in missing
        # Shards of evaluated splits cost more: deal them out.
        count = -(-len(mine) // most)
        parts = [mine[k::count] for k in range(count)] or [[]]
        jobs += [(scene, part, points and k == 0) for k, part in enumerate(parts) if part or points]
    return jobs


def _run(jobs: list[Any], spec: DatasetSpec, directory: Path, total: int, workers: int) -> None:
    """Keep `workers` processes busy; one that dies is started once more, its finished shards kept."""
    context = multiprocessing.get_context("spawn")
    waiting = [(job, 0) for job in jobs]
    running: dict[Any, tuple[Any, int, Any, Any]] = {}
    done = 0
    try:
        with tqdm(total=total, unit="sample", desc="rendering", file=sys.stderr, mininterval=1.0) as bar:
            while waiting or running:
                while waiting and len(running) < workers:
                    job, tries = waiting.pop(0)
                    # Without a lock, so that a killed worker cannot leave one held.
                    counter = context.RawValue("q", 0)
                    receive, send = context.Pipe(duplex=False)
                    threads = max(1, _cores() // workers)
                    arguments = (spec, directory, job, threads, counter, send, os.getpid())
                    process = context.Process(target=_worker, args=arguments, daemon=True)
                    process.start()
                    send.close()
                    running[process] = (job, tries, counter, receive)
                multiprocessing.connection.wait([p.sentinel for p in running], timeout=0.5)
                bar.update(done + sum(c.value for _, _, c, _ in running.values()) - bar.n)
                for process in [p for p in running if not p.is_alive()]:
                    job, tries, counter, receive = running.pop(process)
                    process.join()
                    message = _message(receive)
                    if message:
                        raise UserError(message)
                    if process.exitcode:
                        if tries:
                            name = spec.scenes[job[0]]
                            raise UserError(f"rendering {name}: a worker died twice (exit code {process.exitcode})")
                        waiting.append((job, 1))
                    else:
                        done += counter.value
    finally:
        for process in running:
            process.kill()


def _message(receive: Any) -> str | None:
    """What a worker that has ended had to say, if anything."""
    try:
        return receive.recv() if receive.poll() else None
    except EOFError:
        return None


def _worker(spec: DatasetSpec, directory: Path, job: Any, threads: int, counter: Any, send: Any, parent: int) -> None:
    try:
        scene, shards, points = job
        render = SampleRenderer(spec, scene, threads)
        if points:
            write_shard(points_path(directory, scene), [render.points()])
        for shard in shards:
            path = directory / shard.name
            if path.exists():  # written before this worker's predecessor died
                counter.value += shard.stop - shard.start
                continue
            samples = []
            for index in range(shard.start, shard.stop):
                if os.getppid() != parent:
                    return  # the run was killed: nobody waits for this
                samples.append(render.sample(shard.split, index))
                counter.value += 1
            write_shard(path, samples)
    except UserError as error:
        send.send(str(error))


def _measure(spec: DatasetSpec) -> tuple[float, float]:
    """Seconds for a training and for an evaluated sample, one worker, warm."""
    render = SampleRenderer(spec, 0, 1)
    seconds = []
    for split in ("train", "test"):
        for _ in range(2):
            start = time.perf_counter()
            render.sample(split, 0, rest=True)
            last = time.perf_counter() - start
        seconds.append(last)
    return seconds[0], seconds[1]


def _in_process(function: Callable, *arguments: Any) -> Any:
    """Call it in a process that ends afterwards."""
    context = multiprocessing.get_context("spawn")
    receive, send = context.Pipe(duplex=False)
    process = context.Process(target=_send_result, args=(send, function, arguments), daemon=True)
    process.start()
    send.close()
    try:
        result = receive.recv()
    except EOFError:
        process.join()
        raise UserError(f"the renderer died while it was tried out (exit code {process.exitcode})") from None
    process.join()
    if isinstance(result, UserError):
        raise result
    return result


def _send_result(send: Any, function: Callable, arguments: tuple) -> None:
    try:
        send.send(function(*arguments))
    except UserError as error:
        send.send(error)
