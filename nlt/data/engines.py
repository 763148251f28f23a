"""Where jobs run: in processes of this machine, on a Dask cluster, in a Slurm array.

Every job has a process of its own that ends with it: Mitsuba's memory grows with every scene and state.
"""

from __future__ import annotations

import importlib
import multiprocessing
import multiprocessing.connection
import os
import time
from collections.abc import Callable, Generator, Mapping
from pathlib import Path
from typing import Any, Protocol

from nlt.errors import UserError

# work(job, threads, tick) does a job with so many threads and calls tick(n) after every n samples.
Work = Callable[[Any, int, Callable[[int], None]], None]
# What an engine yields now and then: the samples ticked so far, None if it cannot know.
Ticks = Generator[int | None, None, None]
_CONTEXT = multiprocessing.get_context("spawn")
_POLL, _CONNECT = 1.0, 20.0  # seconds
_SLURM_WORKERS = 64


class Died(Exception):
    """A process ended before its work was done; `job` says which."""

    def __init__(self, reason: str, job: Any = None) -> None:
        super().__init__(reason)
        self.job = job


class Engine(Protocol):
    """Runs jobs, up to `workers` of them side by side."""

    workers: int

    def run(self, work: Work, jobs: list[Any]) -> Ticks:
        """Run all jobs.

        Raises:
            UserError: `work` raised it.
            Died: a job's process died, more often than the engine tries; the other jobs have been run.
        """
        ...


def find_engine(scheduler: str, workers: int | None, slurm: Mapping[str, str]) -> Engine:
    """The engine that `--scheduler` names: local, slurm, slurm-local, or a Dask scheduler's address."""
    if slurm and scheduler != "slurm":
        raise UserError("--slurm: options for --scheduler slurm alone")
    if scheduler == "local":
        return Local(workers or cores())
    if scheduler in ("slurm", "slurm-local"):
        return Slurm(scheduler, workers or _SLURM_WORKERS, slurm)
    if "://" in scheduler:
        return Dask(scheduler, workers)
    raise UserError(f"--scheduler: must be local, slurm or an address such as tcp://host:8786, is {scheduler!r}")


def cores() -> int:
    """Of this machine that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Local:
    """Processes of this machine."""

    def __init__(self, workers: int) -> None:
        self.workers = workers

    def run(self, work: Work, jobs: list[Any]) -> Ticks:
        waiting, threads = list(jobs), max(1, cores() // self.workers)
        running: dict[Process, Any] = {}
        counters: list[Any] = []
        died = None
        try:
            while waiting or running:
                while waiting and len(running) < self.workers:
                    job = waiting.pop(0)
                    counters.append(_counter())
                    running[Process(_work, work, job, threads, counters[-1], os.getpid())] = job
                multiprocessing.connection.wait([process.sentinel for process in running], timeout=0.5)
                yield sum(counter.value for counter in counters)
                for process in [process for process in running if not process.is_alive()]:
                    job = running.pop(process)
                    try:
                        process.result()
                    except Died as error:
                        died = Died(str(error), job)
        finally:
            for process in running:
                process.kill()
        if died:
            raise died


class Dask:
    """A Dask cluster. A job whose worker is lost goes to another one, as often as the scheduler allows."""

    def __init__(self, address: str, workers: int | None) -> None:
        self._address = address
        with self._connect() as client:
            self.workers = workers or max(1, sum(client.nthreads().values()))

    def _connect(self) -> Any:
        distributed = _extra("distributed")
        try:
            return distributed.Client(self._address, timeout=_CONNECT)
        except (OSError, ValueError) as error:
            raise UserError(f"--scheduler: {self._address}: no Dask scheduler answers ({error})") from None

    def run(self, work: Work, jobs: list[Any]) -> Ticks:
        with self._connect() as client:
            # `retries` if the job's process dies; if the worker does, Dask's own setting `allowed-failures` counts.
            futures = client.map(_on_dask, [work] * len(jobs), jobs, pure=False, retries=2)
            yield from _wait(dict(zip(futures, jobs, strict=True)))


class Slurm:
    """A Slurm array by submitit, its logs in runs/slurm; `slurm-local` runs it without Slurm, to try it out."""

    def __init__(self, scheduler: str, workers: int, options: Mapping[str, str]) -> None:
        submitit = _extra("submitit")
        self.workers = workers
        cluster = {"slurm": "slurm", "slurm-local": "local"}[scheduler]
        try:
            self._executor = submitit.AutoExecutor(Path("runs/slurm").absolute(), cluster=cluster)
        except RuntimeError as error:
            raise UserError(f"--scheduler slurm: {error}") from None
        values: dict[str, Any] = {key: int(value) if value.isdigit() else value for key, value in options.items()}
        known = self._executor._valid_parameters()
        values = {key if key in known else f"slurm_{key}": value for key, value in values.items()}
        try:
            self._executor.update_parameters(**{"name": "nlt", "slurm_array_parallelism": workers} | values)
        except (AssertionError, NameError) as error:
            raise UserError(f"--slurm: {str(error).splitlines()[0]}") from None

    def run(self, work: Work, jobs: list[Any]) -> Ticks:
        try:
            tasks = self._executor.map_array(_on_slurm, [work] * len(jobs), jobs)
        except Exception as error:  # submitit has no class of its own for what sbatch refuses
            raise UserError(f"--scheduler slurm: {' '.join(str(error).split())}") from None
        try:
            yield from _wait(dict(zip(tasks, jobs, strict=True)))
        finally:
            for task in tasks:
                if not task.done():
                    task.cancel(check=False)


def _extra(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        raise UserError(f"--scheduler: {name} is not installed; run pip install 'nlt[cluster]'") from None


def _wait(futures: dict[Any, Any]) -> Ticks:
    """Until all are done: each returns what the user is to be told, or raises because it died."""
    died = None
    while futures:
        time.sleep(_POLL)
        yield None
        for future in [future for future in futures if future.done()]:
            job = futures.pop(future)
            try:
                mistake = future.result()
            except Exception as error:  # Dask and submitit each have their own for a lost worker
                died = Died(" ".join(str(error).split()), job)
                continue
            if mistake:
                raise UserError(mistake)
    if died:
        raise died


def _on_dask(work: Work, job: Any) -> str | None:
    from distributed import get_worker

    # Dask's workers are daemons, to which multiprocessing allows no children. Ours watch whether we live.
    multiprocessing.current_process()._config["daemon"] = False  # type: ignore[attr-defined]
    threads = max(1, cores() // get_worker().state.nthreads)
    try:
        Process(_work, work, job, threads, _counter(), os.getpid()).result()
    except UserError as error:
        return str(error)
    return None


def _on_slurm(work: Work, job: Any) -> str | None:
    try:
        work(job, cores(), lambda _: None)
    except UserError as error:
        return str(error)
    return None


def _counter() -> Any:
    # Without a lock, so that a killed process cannot leave one held.
    return _CONTEXT.RawValue("q", 0)


def _work(work: Work, job: Any, threads: int, counter: Any, parent: int) -> None:
    def tick(samples: int) -> None:
        if os.getppid() != parent:
            os._exit(1)  # the run was killed: nobody waits for this
        counter.value += samples

    work(job, threads, tick)


class Process:
    """Calls a function in a process that ends afterwards."""

    def __init__(self, function: Callable, *arguments: Any) -> None:
        self._receive, send = _CONTEXT.Pipe(duplex=False)
        self._process = _CONTEXT.Process(target=_send_result, args=(send, function, arguments), daemon=True)
        self._process.start()
        send.close()
        self.sentinel, self.is_alive, self.kill = self._process.sentinel, self._process.is_alive, self._process.kill

    def result(self) -> Any:
        """What the function returned, once it has.

        Raises:
            UserError: the function raised it.
            Died: the process died.
        """
        try:
            result = self._receive.recv()
        except EOFError:
            self._process.join()
            raise Died(f"exit code {self._process.exitcode}") from None
        self._process.join()
        if isinstance(result, UserError):
            raise result
        return result


def _send_result(send: Any, function: Callable, arguments: tuple) -> None:
    try:
        send.send(function(*arguments))
    except UserError as error:
        send.send(error)
