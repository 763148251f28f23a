"""Engines that run jobs in processes on this machine, on a Dask cluster or in a Slurm array.

Every job runs in its own process, which ends with the job, because Mitsuba's memory grows with every scene and state.
"""

from __future__ import annotations

import importlib
import multiprocessing
import multiprocessing.connection
import os
import pickle
import sys
import time
from collections.abc import Callable, Generator, Mapping
from multiprocessing import forkserver
from pathlib import Path
from typing import Any, Protocol

from nlt.errors import UserError
from nlt.waiting import as_the_user_said

# work(job, threads, tick) does a job with the given number of threads and calls tick(n) after every n samples.
Work = Callable[[Any, int, Callable[[int], None]], None]
# An engine regularly yields the number of samples finished so far, or None if it cannot know.
Ticks = Generator[int | None, None, None]
_CONTEXT = multiprocessing.get_context("spawn")
_POLL, _CONNECT = 1.0, 20.0  # seconds
_SLURM_WORKERS = 64


class Died(Exception):
    """A process ended before its work was done."""


class Engine(Protocol):
    """Runs jobs, up to `workers` of them concurrently."""

    workers: int

    def run(self, work: Work, jobs: list[Any], failures: dict[Any, str]) -> Ticks:
        """Run all jobs. A job that dies is retried once; if it dies again, the reason is added to `failures`.

        Raises:
            UserError: `work` raised it.
        """
        ...


def find_engine(scheduler: str, workers: int | None, slurm: Mapping[str, str], preload: tuple[str, ...] = ()) -> Engine:
    """Return the engine that `--scheduler` names: local, slurm, slurm-local or a Dask scheduler's address.

    Args:
        scheduler: value of `--scheduler`.
        workers: number of concurrent jobs (default: the available CPUs; on Dask, its threads; in a Slurm array, 64).
        slurm: options of a Slurm job.
        preload: modules to import once per machine: slow to import, and without threads of their own (so not Mitsuba).

    Raises:
        UserError: the scheduler is unknown, not installed or not reachable, or the options do not fit it.
    """
    if slurm and scheduler != "slurm":
        raise UserError("--slurm: only works with --scheduler slurm")
    if scheduler == "local":
        return Local(workers or available_cpus(), preload)
    if scheduler in ("slurm", "slurm-local"):
        return Slurm(scheduler, workers or _SLURM_WORKERS, slurm)
    if "://" in scheduler:
        return Dask(scheduler, workers, preload)
    raise UserError(f"--scheduler: must be local, slurm or a Dask address such as tcp://host:8786, is {scheduler!r}")


def available_cpus() -> int:
    """Return the number of CPUs that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Local:
    """Runs jobs in processes on this machine."""

    def __init__(self, workers: int, preload: tuple[str, ...] = ()) -> None:
        self.workers, self._preload = workers, preload

    def run(self, work: Work, jobs: list[Any], failures: dict[Any, str]) -> Ticks:
        waiting, threads = list(jobs), max(1, available_cpus() // self.workers)
        running: dict[Process, Any] = {}
        counters: dict[Any, Any] = {}
        retried = set()
        try:
            while waiting or running:
                while waiting and len(running) < self.workers:
                    job = waiting.pop(0)
                    counters[job] = _counter()
                    content = pickle.dumps((work, job))
                    running[Process(_work, content, threads, counters[job], preload=self._preload)] = job
                multiprocessing.connection.wait([process.sentinel for process in running], timeout=0.5)
                yield sum(counter.value for counter in counters.values())
                for process in [process for process in running if not process.is_alive()]:
                    job = running.pop(process)
                    try:
                        process.result()
                    except Died as error:
                        if job in retried:
                            failures[job] = str(error)
                        else:
                            retried.add(job)
                            waiting.append(job)
        finally:
            for process in running:
                process.kill()


class Dask:
    """Runs jobs on a Dask cluster, which reruns the job of a lost worker on another one, up to its retry limit."""

    def __init__(self, address: str, workers: int | None, preload: tuple[str, ...] = ()) -> None:
        self._address, self._preload = address, preload
        with self._connect() as client:
            self.workers = workers or max(1, sum(client.nthreads().values()))

    def _connect(self) -> Any:
        distributed = _extra("distributed")
        try:
            return distributed.Client(self._address, timeout=_CONNECT)
        except (OSError, ValueError) as error:
            raise UserError(f"--scheduler: {self._address}: no Dask scheduler answers ({error})") from None

    def run(self, work: Work, jobs: list[Any], failures: dict[Any, str]) -> Ticks:
        with self._connect() as client:
            # Pickled here, so that Dask's workers do not import the modules that the work needs.
            submit = lambda job: client.submit(_on_dask, pickle.dumps((work, job)), self._preload, pure=False)
            yield from _wait({submit(job): job for job in jobs}, submit, failures)


class Slurm:
    """Runs jobs in a Slurm array with logs in runs/slurm; `slurm-local` emulates the array on this machine."""

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

    def run(self, work: Work, jobs: list[Any], failures: dict[Any, str]) -> Ticks:
        futures = dict(zip(self._submit(work, jobs), jobs, strict=True))
        try:
            yield from _wait(futures, lambda job: self._submit(work, [job])[0], failures)
        finally:
            for task in futures:
                if not task.done():
                    task.cancel(check=False)

    def _submit(self, work: Work, jobs: list[Any]) -> list[Any]:
        try:
            return list(self._executor.map_array(_on_slurm, [work] * len(jobs), jobs))
        except Exception as error:  # submitit has no exception class for a refusal by sbatch
            raise UserError(f"--scheduler slurm: {' '.join(str(error).split())}") from None


def _extra(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        raise UserError(f"--scheduler: {name} is not installed; run pip install 'nlt[cluster]'") from None


def _wait(futures: dict[Any, Any], submit: Callable[[Any], Any], failures: dict[Any, str]) -> Ticks:
    """Wait for all futures; each returns None or the message of a UserError, or raises because its worker died."""
    retried = set()
    while futures:
        time.sleep(_POLL)
        yield None
        for future in [future for future in futures if future.done()]:
            job = futures.pop(future)
            try:
                message = future.result()
            except Exception as error:  # Dask and submitit raise different classes for a lost worker
                if job in retried:
                    failures[job] = " ".join(str(error).split())
                else:
                    retried.add(job)
                    futures[submit(job)] = job
                continue
            if message:
                raise UserError(message)


def _on_dask(content: bytes, preload: tuple[str, ...]) -> str | None:
    from distributed import get_worker

    _allow_children()
    threads = max(1, available_cpus() // get_worker().state.nthreads)
    try:
        Process(_work, content, threads, _counter(), preload=preload).result()
    except UserError as error:
        return str(error)
    return None


def _allow_children() -> None:
    # Multiprocessing forbids children to daemons, which Dask's workers and our processes are. Our children end if their
    # parent dies.
    multiprocessing.current_process()._config["daemon"] = False  # type: ignore[attr-defined]


def _on_slurm(work: Work, job: Any) -> str | None:
    try:
        work(job, available_cpus(), lambda _: None)
    except UserError as error:
        return str(error)
    return None


def _counter() -> Any:
    # Without a lock, because a killed process could leave it held.
    return _CONTEXT.RawValue("q", 0)


def _work(content: bytes, threads: int, counter: Any) -> None:
    work, job = pickle.loads(content)
    parent = multiprocessing.parent_process()
    assert parent is not None
    _allow_children()
    multiprocessing.set_start_method(None, force=True)  # otherwise data loaders inherit our slow start method

    def tick(samples: int) -> None:
        if not parent.is_alive():
            os._exit(1)  # the parent was killed, so nobody needs the result
        counter.value += samples

    work(job, threads, tick)


def _fork_context(preload: tuple[str, ...]) -> Any:
    """Return a context whose processes are forked from a server that has only imported these modules."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(preload))
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join(sys.path)  # before Python 3.13, the server ignores sys.path
    try:
        with as_the_user_said():
            forkserver.ensure_running()
    finally:
        if before is None:
            del os.environ["PYTHONPATH"]
        else:
            os.environ["PYTHONPATH"] = before
    return context


class Process:
    """Calls a function in a new process; the `preload` modules are imported once for all processes."""

    def __init__(self, function: Callable, *arguments: Any, preload: tuple[str, ...] = ()) -> None:
        context: Any = _fork_context(preload) if preload else _CONTEXT
        self._receive, send = context.Pipe(duplex=False)
        self._process = context.Process(target=_send_result, args=(send, function, arguments), daemon=True)
        self._process.start()
        send.close()
        self.sentinel, self.is_alive, self.kill = self._process.sentinel, self._process.is_alive, self._process.kill

    def result(self) -> Any:
        """Wait for the function and return its result.

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
