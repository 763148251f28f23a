"""Where jobs run: in processes of this machine, on a Dask cluster, in a Slurm array.

Every job has a process of its own that ends with it: Mitsuba's memory grows with every scene and state.
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

# work(job, threads, tick) does a job with so many threads and calls tick(n) after every n samples.
Work = Callable[[Any, int, Callable[[int], None]], None]
# What an engine yields now and then: the samples ticked so far, None if it cannot know.
Ticks = Generator[int | None, None, None]
_CONTEXT = multiprocessing.get_context("spawn")
_POLL, _CONNECT = 1.0, 20.0  # seconds
_SLURM_WORKERS = 64


class Died(Exception):
    """A process ended before its work was done."""


class Engine(Protocol):
    """Runs jobs, up to `workers` of them side by side."""

    workers: int

    def run(self, work: Work, jobs: list[Any], died: dict[Any, str]) -> Ticks:
        """Run all jobs. One that dies is run once more; if it dies again, `died` says of what, and the others go on.

        Raises:
            UserError: `work` raised it.
        """
        ...


def find_engine(scheduler: str, workers: int | None, slurm: Mapping[str, str], preload: tuple[str, ...] = ()) -> Engine:
    """The engine that `--scheduler` names: local, slurm, slurm-local, or a Dask scheduler's address.

    Args:
        workers: jobs side by side (default: a core each; on Dask, as it has threads; in a Slurm array, 64).
        slurm: options of a Slurm job.
        preload: modules that take long to import and start no threads (so not Mitsuba): imported once on a machine.
    """
    if slurm and scheduler != "slurm":
        raise UserError("--slurm: options for --scheduler slurm alone")
    if scheduler == "local":
        return Local(workers or available_cpus(), preload)
    if scheduler in ("slurm", "slurm-local"):
        return Slurm(scheduler, workers or _SLURM_WORKERS, slurm)
    if "://" in scheduler:
        return Dask(scheduler, workers, preload)
    raise UserError(f"--scheduler: must be local, slurm or an address such as tcp://host:8786, is {scheduler!r}")


def available_cpus() -> int:
    """Of this machine that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Local:
    """Processes of this machine."""

    def __init__(self, workers: int, preload: tuple[str, ...] = ()) -> None:
        self.workers, self._preload = workers, preload

    def run(self, work: Work, jobs: list[Any], died: dict[Any, str]) -> Ticks:
        waiting, threads = list(jobs), max(1, available_cpus() // self.workers)
        running: dict[Process, Any] = {}
        counters: dict[Any, Any] = {}
        tried = set()
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
                        if job in tried:
                            died[job] = str(error)
                        else:
                            tried.add(job)
                            waiting.append(job)
        finally:
            for process in running:
                process.kill()


class Dask:
    """A Dask cluster. A job whose worker is lost goes to another one, as often as the scheduler allows."""

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

    def run(self, work: Work, jobs: list[Any], died: dict[Any, str]) -> Ticks:
        with self._connect() as client:
            # Pickled, so that Dask's workers need not import what the work does.
            submit = lambda job: client.submit(_on_dask, pickle.dumps((work, job)), self._preload, pure=False)
            yield from _wait({submit(job): job for job in jobs}, submit, died)


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

    def run(self, work: Work, jobs: list[Any], died: dict[Any, str]) -> Ticks:
        futures = dict(zip(self._submit(work, jobs), jobs, strict=True))
        try:
            yield from _wait(futures, lambda job: self._submit(work, [job])[0], died)
        finally:
            for task in futures:
                if not task.done():
                    task.cancel(check=False)

    def _submit(self, work: Work, jobs: list[Any]) -> list[Any]:
        try:
            return list(self._executor.map_array(_on_slurm, [work] * len(jobs), jobs))
        except Exception as error:  # submitit has no class of its own for what sbatch refuses
            raise UserError(f"--scheduler slurm: {' '.join(str(error).split())}") from None


def _extra(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        raise UserError(f"--scheduler: {name} is not installed; run pip install 'nlt[cluster]'") from None


def _wait(futures: dict[Any, Any], submit: Callable[[Any], Any], died: dict[Any, str]) -> Ticks:
    """Until all are done: each returns what the user is to be told, or raises because it died."""
    tried = set()
    while futures:
        time.sleep(_POLL)
        yield None
        for future in [future for future in futures if future.done()]:
            job = futures.pop(future)
            try:
                mistake = future.result()
            except Exception as error:  # Dask and submitit each have their own for a lost worker
                if job in tried:
                    died[job] = " ".join(str(error).split())
                else:
                    tried.add(job)
                    futures[submit(job)] = job
                continue
            if mistake:
                raise UserError(mistake)


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
    # Multiprocessing denies them to daemons, as Dask's workers and our processes are. Ours watch whether we live.
    multiprocessing.current_process()._config["daemon"] = False  # type: ignore[attr-defined]


def _on_slurm(work: Work, job: Any) -> str | None:
    try:
        work(job, available_cpus(), lambda _: None)
    except UserError as error:
        return str(error)
    return None


def _counter() -> Any:
    # Without a lock, so that a killed process cannot leave one held.
    return _CONTEXT.RawValue("q", 0)


def _work(content: bytes, threads: int, counter: Any) -> None:
    work, job = pickle.loads(content)
    parent = multiprocessing.parent_process()
    assert parent is not None
    _allow_children()
    multiprocessing.set_start_method(None, force=True)  # else loaders' processes would start as this one did, slowly

    def tick(samples: int) -> None:
        if not parent.is_alive():
            os._exit(1)  # the run was killed: nobody waits for this
        counter.value += samples

    work(job, threads, tick)


def _forking(preload: tuple[str, ...]) -> Any:
    """A context whose processes are forked from one that has imported these modules and nothing else."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(preload))
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join(sys.path)  # else it imports from elsewhere than we, before Python 3.13
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
    """Calls a function in a process that ends afterwards, into which `preload` was imported once for all processes."""

    def __init__(self, function: Callable, *arguments: Any, preload: tuple[str, ...] = ()) -> None:
        context: Any = _forking(preload) if preload else _CONTEXT
        self._receive, send = context.Pipe(duplex=False)
        self._process = context.Process(target=_send_result, args=(send, function, arguments), daemon=True)
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
