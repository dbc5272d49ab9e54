"""Executors of tasks: this process, processes of this machine, or a Dask cluster."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import get_context, parent_process
from pathlib import Path
from typing import Any, Protocol

from g2ard import _core
from g2ard.errors import InputError
from g2ard.progress import Progress, silent
from g2ard.system.memory import forget_workers, note_worker, peak_rss
from g2ard.tiles.tasks import Task, run_task

_TRIES = 5
"""Worker deaths in a row, without a finished task, before giving up. Dask gives up a task after four."""

_MANAGER = 5.0
"""Seconds to wait for the pool's manager thread after its workers are dead.

The thread releases semaphores; otherwise Python warns about them at exit.
"""


class Executor(Protocol):
    """Runner for tasks that do not read each other's files."""

    def run(self, tasks: Sequence[Task], stage: str, progress: Progress = silent) -> list[Path]:
        """Run the tasks that are not done; return the files of all, in order."""


@dataclass(frozen=True)
class Workers:
    executor: Executor
    folder: Path
    progress: Progress = silent

    def run(self, tasks: Sequence[Task], stage: str) -> list[Path]:
        """Run tasks; return their files in order."""
        return self.executor.run(tasks, stage, self.progress)


@contextmanager
def executor(
    workers: int = 1, threads: int | None = None, scheduler: str | None = None
) -> Iterator[Executor]:
    """Yield an executor.

    Args:
        workers: number of processes; 1 runs tasks in this process.
        threads: threads per worker; None divides the cores among workers.
        scheduler: `tcp://HOST:PORT` of a Dask scheduler whose workers see the same files, or `local` for a
            Dask cluster of `workers` processes on this machine.
    """
    forget_workers()
    threads = threads or max(1, (os.cpu_count() or 1) // workers)
    if scheduler:
        with DaskExecutor(scheduler, workers, threads) as cluster:
            yield cluster
    elif workers == 1:
        yield _Here()
    else:
        with _Processes(workers, threads) as processes:
            yield processes


class _Here:
    def run(self, tasks: Sequence[Task], stage: str, progress: Progress = silent) -> list[Path]:
        todo = [task for task in tasks if not task.done]
        done = total = sum(task.cost for task in tasks)
        done -= sum(task.cost for task in todo)
        for task in todo:
            progress(stage, done, total)
            run_task(task)
            done += task.cost
        progress(stage, total, total)
        return [task.output for task in tasks]


class _Processes:
    """A pool of processes; if one is killed, the pool is recreated and unfinished tasks run again."""

    def __init__(self, workers: int, threads: int):
        self._workers, self._threads = workers, threads
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> _Processes:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        self._stop(at_once=kind is not None)

    def run(self, tasks: Sequence[Task], stage: str, progress: Progress = silent) -> list[Path]:
        total, failures = sum(task.cost for task in tasks), 0
        _sweep(tasks)
        while todo := [task for task in tasks if not task.done]:
            before = len(todo)
            try:
                self._round(todo, total, stage, progress)
            except BrokenProcessPool:
                self._stop(at_once=True)
                _sweep(tasks)
                left = sum(not task.done for task in tasks)
                failures = failures + 1 if left == before else 0
                if failures == _TRIES:
                    raise InputError(
                        f"{stage}: workers were killed before finishing a task; lower --memory or "
                        "--workers so that they need less memory"
                    ) from None
        progress(stage, total, total)
        return [task.output for task in tasks]

    def _round(self, todo: Sequence[Task], total: int, stage: str, progress: Progress) -> None:
        if self._pool is None:
            context = get_context("spawn")
            self._pool = ProcessPoolExecutor(self._workers, context, _begin, (self._threads,))
        futures: dict[Future[tuple[int, int | None]], Task] = {
            self._pool.submit(_run_noted, task): task for task in todo
        }
        done, pending = total - sum(task.cost for task in todo), set(futures)
        while pending:
            progress(stage, done, total)
            finished, pending = wait(pending, timeout=0.2, return_when=FIRST_COMPLETED)
            for future in finished:
                note_worker(*future.result())
                done += futures[future].cost

    def _stop(self, at_once: bool) -> None:
        if self._pool is None:
            return
        processes = list((self._pool._processes or {}).values())
        manager: threading.Thread | None = getattr(self._pool, "_executor_manager_thread", None)
        self._pool.shutdown(wait=not at_once, cancel_futures=True)
        if at_once:
            for process in processes:
                with suppress(OSError, ValueError):
                    process.kill()
            for process in processes:
                process.join()
            if manager is not None:
                manager.join(timeout=_MANAGER)
        self._pool = None


def _sweep(tasks: Sequence[Task]) -> None:
    """Remove what killed workers left: partial files, or the empty folder of `check_output`."""
    for task in tasks:
        for begun in task.folder.glob(f".{task.output.stem}.*"):
            begun.rmdir() if begun.is_dir() else begun.unlink(missing_ok=True)


def _run_noted(task: Task) -> tuple[int, int | None]:
    """Run a task in a worker; return the worker's process ID and its peak memory."""
    run_task(task)
    return os.getpid(), peak_rss()


def _begin(threads: int) -> None:
    """Initialise a worker: leave Ctrl-C to the parent, and exit when the parent dies."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _core.set_num_threads(threads)


def _end_with_parent() -> None:
    """Exit when the parent is gone; a killed parent cannot tell its workers, which would wait forever."""
    parent = parent_process()
    if parent is not None:
        parent.join()
    os._exit(1)


class DaskExecutor:
    """Executor on the workers of a Dask scheduler, which must see the same files under the same paths.

    Results are paths, because Dask cannot spill what workers hold in Rust's memory.
    """

    def __init__(self, scheduler: str, workers: int, threads: int):
        try:
            from distributed import Client, LocalCluster
        except ImportError:
            raise InputError(
                '--scheduler: Dask is not installed; run pip install "g2ard[distributed]"'
            ) from None
        self._threads = threads
        self._cluster: Any = None
        if scheduler == "local":
            self._cluster = LocalCluster(  # type: ignore[no-untyped-call]
                n_workers=workers,
                threads_per_worker=1,
                processes=True,
                dashboard_address=None,
                memory_limit=0,
            )
            scheduler = self._cluster.scheduler_address
        try:
            self.client: Any = Client(  # type: ignore[no-untyped-call]
                scheduler, timeout="10s", set_as_default=False
            )
        except (OSError, TimeoutError, ValueError) as error:
            raise InputError(
                f"--scheduler {scheduler}: no answer ({error}); start one with `dask scheduler`, which "
                "prints its address"
            ) from None

    def __enter__(self) -> DaskExecutor:
        return self

    def __exit__(self, *_: object) -> None:
        self.client.close()
        if self._cluster is not None:
            self._cluster.close()

    def run(self, tasks: Sequence[Task], stage: str, progress: Progress = silent) -> list[Path]:
        """Run tasks like `Executor.run`, retrying after a worker's death."""
        from distributed import KilledWorker

        deaths = 0
        while todo := {task.key: task for task in tasks if not task.done}:
            before = len(todo)
            try:
                self._round(todo, sum(task.cost for task in tasks), stage, progress)
            except KilledWorker:
                left = sum(not task.done for task in tasks)
                deaths = deaths + 1 if left == before else 0
                if deaths == _TRIES:
                    raise InputError(
                        f"{stage}: workers were killed before finishing a task; give them more memory"
                    ) from None
                continue
            if missing := [task.output for task in tasks if not task.done]:
                raise InputError(
                    "written by a worker but missing here; share the folder with all workers", path=missing[0]
                )
        return [task.output for task in tasks]

    def _round(self, todo: dict[str, Task], total: int, stage: str, progress: Progress) -> None:
        from distributed import as_completed

        done = total - sum(task.cost for task in todo.values())
        futures = [
            self.client.submit(_work, task, self._threads, key=f"g2ard-{key}", pure=True)
            for key, task in todo.items()
        ]
        try:
            progress(stage, done, total)
            for future in as_completed(futures, loop=self.client.loop):  # type: ignore[no-untyped-call]
                future.result()
                done += todo[future.key.removeprefix("g2ard-")].cost
                progress(stage, done, total)
        except BaseException:
            self.client.cancel(futures, force=True)
            raise


def _work(task: Task, threads: int) -> str:
    _core.set_num_threads(threads)
    return str(run_task(task))
