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
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterable, Mapping
from functools import partial
from multiprocessing import forkserver
from pathlib import Path
from threading import Thread
from typing import Any

from nlt.errors import UserError
from nlt.waiting import as_the_user_said

_CPU_QUOTA = Path("/sys/fs/cgroup/cpu.max")  # "quota period" in microseconds, or "max period"
# work(job, threads, tick) does a job with the given number of threads; tick(n) adds n to the progress that is shown.
Work = Callable[[Any, int, Callable[[int], None]], None]
# An engine regularly yields the sum of all ticks so far, or None if it cannot know.
Ticks = Generator[int | None, None, None]
_CONTEXT = multiprocessing.get_context("spawn")
_POLL, _CONNECT = 1.0, 20.0  # seconds
_SLURM_WORKERS = 64


class Died(Exception):
    """A process ended before its work was done."""


class Engine(ABC):
    """Runs jobs, up to `workers` of them concurrently."""

    workers: int
    _at_once = sys.maxsize  # how many jobs are started: a cluster has a queue of its own

    def run(self, work: Work, jobs: list[Any], failures: dict[Any, str]) -> Ticks:
        """Run all jobs. A job that dies is retried once; if it dies again, the reason is added to `failures`.

        A UserError that `work` raises ends all jobs and is raised here.
        """
        waiting, retried = list(jobs), set()
        running: dict[Any, Any] = {}  # jobs by future
        try:
            while waiting or running:
                free = self._at_once - len(running)
                if started := waiting[:free]:
                    running.update(zip(self._start(work, started), started, strict=True))
                    waiting = waiting[free:]
                yield self._wait(running)
                for future in [future for future in running if future.done()]:
                    job = running.pop(future)
                    try:
                        if isinstance(result := future.result(), UserError):
                            raise result
                    except UserError:
                        raise
                    except Exception as error:  # Dask and submitit raise different classes for a lost worker
                        if job in retried:
                            failures[job] = " ".join(str(error).split())
                        else:
                            retried.add(job)
                            waiting.append(job)
        finally:
            for future in running:
                self._cancel(future)

    @abstractmethod
    def _start(self, work: Work, jobs: list[Any]) -> list[Any]:
        """Start jobs and return their futures, which have `done`, `result` and `cancel`."""

    def _wait(self, running: Iterable[Any]) -> int | None:
        """Wait a moment and return the sum of all ticks so far, or None."""
        time.sleep(_POLL)
        return None

    def _cancel(self, future: Any) -> None:
        future.cancel()


def find_engine(scheduler: str, workers: int | None, slurm: Mapping[str, str], preload: tuple[str, ...] = ()) -> Engine:
    """Return the engine that `--scheduler` names.

    Args:
        scheduler: local, slurm, slurm-local (which emulates a Slurm array here) or a Dask scheduler's address.
        workers: number of concurrent jobs (default: the available CPUs; on Dask, its threads; in a Slurm array, 64).
        slurm: options of a Slurm job.
        preload: modules to import once per machine; they must not start threads, as Mitsuba does.

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
    """Return the number of CPUs that this process may use: its affinity, and at most its container's quota."""
    cpus = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quota, period = _CPU_QUOTA.read_text().split() if _CPU_QUOTA.exists() else ("max", "")
    return cpus if quota == "max" else max(1, min(cpus, int(quota) // int(period)))


class Local(Engine):
    """Runs jobs in processes on this machine."""

    def __init__(self, workers: int, preload: tuple[str, ...] = ()) -> None:
        self.workers = self._at_once = workers
        self._preload = preload
        self._counters: dict[Any, Any] = {}

    def _start(self, work: Work, jobs: list[Any]) -> list[Process]:
        self._counters |= {job: _CONTEXT.RawValue("q", 0) for job in jobs}  # a killed process could keep a lock
        threads = max(1, available_cpus() // self.workers)
        start = partial(Process, _work, preload=self._preload)
        return [start(pickle.dumps((work, job)), threads, self._counters[job]) for job in jobs]

    def _wait(self, running: Iterable[Process]) -> int:
        multiprocessing.connection.wait([process.sentinel for process in running], timeout=_POLL / 2)
        return sum(counter.value for counter in self._counters.values())


class Dask(Engine):
    """Runs jobs on a Dask cluster, which reruns the job of a lost worker on another one, up to its retry limit."""

    def __init__(self, address: str, workers: int | None, preload: tuple[str, ...] = ()) -> None:
        self._preload = preload
        try:
            self._client = _extra("distributed").Client(address, timeout=_CONNECT)
        except (OSError, ValueError) as error:
            raise UserError(f"--scheduler: {address}: no Dask scheduler answers ({error})") from None
        self.workers = workers or max(1, sum(self._client.nthreads().values()))

    def run(self, work: Work, jobs: list[Any], failures: dict[Any, str]) -> Ticks:
        with self._client:
            yield from super().run(work, jobs, failures)

    def _start(self, work: Work, jobs: list[Any]) -> list[Any]:
        # Pickled here, so that Dask's workers do not import the modules that the work needs.
        start = partial(self._client.submit, _on_dask, preload=self._preload, pure=False)
        return [start(pickle.dumps((work, job))) for job in jobs]


class Slurm(Engine):
    """Runs jobs in a Slurm array with logs in runs/slurm; `slurm-local` emulates the array on this machine."""

    def __init__(self, scheduler: str, workers: int, options: Mapping[str, str]) -> None:
        submitit = _extra("submitit")
        self.workers = workers
        cluster = scheduler.removeprefix("slurm-")  # submitit's names are slurm and local
        try:
            self._executor = submitit.AutoExecutor(Path("runs/slurm").absolute(), cluster=cluster)
        except RuntimeError as error:
            raise UserError(f"--scheduler slurm: {error}") from None
        values = {f"slurm_{key}": int(value) if value.isdigit() else value for key, value in options.items()}
        try:
            self._executor.update_parameters(**{"name": "nlt", "slurm_array_parallelism": workers} | values)
        except NameError as error:
            raise UserError(f"--slurm: {str(error).splitlines()[0]}") from None

    def _start(self, work: Work, jobs: list[Any]) -> list[Any]:
        try:
            return list(self._executor.map_array(_on_slurm, [work] * len(jobs), jobs))
        except Exception as error:  # submitit has no exception class for a refusal by sbatch
            raise UserError(f"--scheduler slurm: {' '.join(str(error).split())}") from None

    def _cancel(self, future: Any) -> None:
        future.cancel(check=False)


def _extra(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        raise UserError(f"--scheduler: {name} is not installed; run pip install 'nlt[cluster]'") from None


def _on_dask(content: bytes, preload: tuple[str, ...]) -> UserError | None:
    from distributed import get_worker

    multiprocessing.current_process().daemon = False  # a daemon may not start processes
    threads = max(1, available_cpus() // get_worker().state.nthreads)
    process = Process(_work, content, threads, _CONTEXT.RawValue("q", 0), preload=preload)
    return _result_or_user_error(process.result)


def _on_slurm(work: Work, job: Any) -> UserError | None:
    return _result_or_user_error(work, job, available_cpus(), lambda _: None)


def _work(content: bytes, threads: int, counter: Any) -> None:
    work, job = pickle.loads(content)
    multiprocessing.current_process().daemon = False  # a daemon may not start processes, as data loaders do
    multiprocessing.set_start_method(None, force=True)  # otherwise data loaders inherit our slow start method

    def tick(progress: int) -> None:
        counter.value += progress

    work(job, threads, tick)


def _result_or_user_error(function: Callable, *arguments: Any) -> Any:
    try:
        return function(*arguments)
    except UserError as error:
        return error


class Process:
    """Calls a function in a new process: spawned or, with `preload`, forked from a server with only these modules."""

    def __init__(self, function: Callable, *arguments: Any, preload: tuple[str, ...] = ()) -> None:
        context: Any = _CONTEXT
        if preload:
            context = multiprocessing.get_context("forkserver")
            context.set_forkserver_preload(list(preload))
            with as_the_user_said():
                forkserver.ensure_running()
        self._receive, send = context.Pipe(duplex=False)
        self._process = context.Process(target=_send_result, args=(send, function, *arguments), daemon=True)
        self._process.start()
        send.close()
        self.sentinel, self.cancel = self._process.sentinel, self._process.kill

    def done(self) -> bool:
        """Return whether the process has ended."""
        return not self._process.is_alive()

    def result(self) -> Any:
        """Wait for the function and return its result; raise its UserError, or Died if the process died."""
        try:
            result = self._receive.recv()
        except EOFError:
            self._process.join()
            raise Died(f"exit code {self._process.exitcode}") from None
        self._process.join()
        if isinstance(result, UserError):
            raise result
        return result


def _send_result(send: Any, function: Callable, *arguments: Any) -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    Thread(target=_end_after, args=(parent,), daemon=True).start()
    send.send(_result_or_user_error(function, *arguments))


def _end_after(parent: Any) -> None:
    parent.join()
    os._exit(1)  # it was killed, so nobody needs the result
