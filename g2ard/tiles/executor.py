"""Executors of tasks: this process, processes of this machine, or a Dask cluster."""

import concurrent.futures
import os
import platform
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache, partial
from multiprocessing import get_context, parent_process
from pathlib import Path
from typing import Any

import g2ard._core as _core
from g2ard.errors import G2ardError, InputError, missing
from g2ard.io.atomic import drop_temporaries
from g2ard.progress import Progress, silent
from g2ard.system.keys import key_of
from g2ard.system.peak_memory import forget_workers, note_worker, peak_rss
from g2ard.tiles.tasks import Arrays, Given, Task, run_task

_MOST_WORKER_DEATHS = 5
"""Worker deaths in a row, without a finished task, before giving up. Dask gives up a task after four."""

_POOL_SHUTDOWN_SECONDS = 5.0
"""Seconds to wait for the pool's manager thread after its workers are dead.

The thread releases semaphores; otherwise Python warns about them at exit.
"""

_WORKER_SECONDS = 60.0
"""Seconds that a cluster may be without a worker."""

_POLL_SECONDS = 5.0
"""Seconds between two questions to a scheduler whether it has workers."""

Told = Callable[[Task, float], None]
Executor = Callable[[Sequence[Task], Told], None]
"""Runs tasks that do not read each other's files, and calls back with the finished share of each, 1 at its
end; may raise `WorkerDiedError`."""


class WorkerDiedError(Exception):
    """A worker was killed; unfinished tasks can be run again."""


@dataclass(frozen=True)
class Workers:
    """An executor, and the folder of its tasks' files."""

    executor: Executor
    folder: Path
    progress: Progress = silent

    def run(self, tasks: Sequence[Task], stage: str) -> list[Path]:
        """Run the tasks that are not done; return the files of all, in order."""
        total = sum(task.cost for task in tasks)
        deaths = 0
        while todo := [task for task in tasks if not task.done]:
            drop_temporaries(self.folder)  # of workers that were killed, as the shares
            for task in todo:
                task.share_file.unlink(missing_ok=True)
            try:
                self._round(todo, stage, total)
            except WorkerDiedError:
                left = sum(not task.done for task in tasks)
                deaths = deaths + 1 if left == len(todo) else 0
                if deaths == _MOST_WORKER_DEATHS:
                    raise InputError(
                        f"{stage}: workers were killed before finishing a task; give them more memory, or "
                        "lower --memory or --workers"
                    ) from None
            else:
                if absent := [task.output for task in todo if not task.done]:
                    raise InputError(
                        "written by a worker but missing here; share the folder with all workers",
                        path=absent[0],
                    )
        self.progress(stage, total, total)
        return [task.output for task in tasks]

    def map(
        self,
        function: Callable[[Given], Arrays],
        stage: str,
        calls: Iterable[tuple[Given, int]],
        places: Given,
    ) -> list[Path]:
        """Run the calls of a function, each with its cost, that are not done; return their files, in order.

        Args:
            calls: what is given to each, see `Task`, and its cost.
            places: given to all.
        """
        name = f"{function.__module__}:{function.__name__}"
        tasks = [
            Task(name, f"{stage}-{number:05}", self.folder, given, places, cost)
            for number, (given, cost) in enumerate(calls)
        ]
        return self.run(tasks, stage)

    def _round(self, todo: Sequence[Task], stage: str, total: int) -> None:
        before = total - sum(task.cost for task in todo)
        done: dict[str, float] = {}

        def told(task: Task, share: float) -> None:
            if share * task.cost > done.get(task.label, 0.0):
                done[task.label] = share * task.cost
                now = before + int(sum(done.values()))
                self.progress(stage, min(now, total - 1), total)  # the last task is not written yet

        self.progress(stage, before, total)
        self.executor(todo, told)


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
    if workers == 1 and not scheduler:
        yield run_here
        return
    with ExitStack() as opened:
        pool: Any = partial(ProcessPoolExecutor, workers, get_context("spawn"), _begin)
        cluster = None
        if scheduler:
            cluster = _Cluster(scheduler, _dask_client(scheduler, workers, opened))
            pool = partial(cluster.client.get_executor, pure=False)
        yield opened.enter_context(closing(_Pool(pool, threads, cluster))).run


def run_here(tasks: Sequence[Task], told: Told) -> None:
    """Run tasks in this process."""
    for task in tasks:
        run_task(task, partial(told, task))
        told(task, 1.0)


@dataclass(eq=False)
class _Cluster:
    """A connection to a Dask scheduler, which is asked from time to time whether it has workers."""

    scheduler: str
    client: Any

    def __post_init__(self) -> None:
        self._asked = self._manned = time.monotonic()

    def check(self) -> None:
        """Raise an `InputError` if the scheduler has had no worker for a while."""
        now = time.monotonic()
        if now < self._asked + _POLL_SECONDS:
            return
        self._asked = now
        if self.client.nthreads():
            self._manned = now
        elif now > self._manned + _WORKER_SECONDS:
            raise InputError(
                f"--scheduler {self.scheduler}: no worker for {now - self._manned:.0f} s; start some with "
                f"`dask worker {self.scheduler}`, then run the same command again"
            )

    def check_answer(self, error: Exception) -> None:
        """Raise an `InputError` if an error is due to a scheduler that no longer answers."""
        try:
            if self.client.status == "running" and self.client.nthreads() is not None:
                return
        except Exception as found:  # whatever the connection raises
            error = found
        raise InputError(
            f"--scheduler {self.scheduler}: the connection was lost ({type(error).__name__}); start the "
            "scheduler, and run the same command again"
        ) from None


@dataclass(eq=False)
class _Pool:
    """A pool of processes or of Dask's workers, opened again after one of them is killed.

    Results are what workers tell of themselves, because Dask cannot spill what they hold in Rust's memory.
    """

    _opened: Callable[[], concurrent.futures.Executor]
    _threads: int
    _cluster: _Cluster | None = None
    _lanes: dict[str, str] = field(default_factory=dict)  # instruction set → one worker that has it
    _pool: concurrent.futures.Executor | None = None

    def run(self, tasks: Sequence[Task], told: Told) -> None:
        try:
            self._pool = self._pool or self._opened()
        except (OSError, ImportError) as error:  # of semaphores
            text = f"processes cannot be started ({error}): they need a /dev/shm that can be written to"
            raise InputError(text, hint="--workers 1 needs none") from error
        try:
            asked = self._threads, program()
            futures = {self._pool.submit(_work, task.absolute(), *asked): task for task in tasks}
            pending = set(futures)
            while pending:  # wait briefly: Ctrl-C does not end a longer wait on Windows
                done, pending = wait(pending, timeout=0.2, return_when=FIRST_COMPLETED)
                for future in done:
                    worker = future.result()
                    note_worker(worker.process, worker.peak)
                    self._check_lanes(worker)
                    told(futures[future], 1.0)
                if self._cluster is not None:
                    self._cluster.check()
                for future in pending:
                    if future.running():
                        told(futures[future], futures[future].share)
        except Exception as error:
            self.close()
            if isinstance(error, BrokenProcessPool) or type(error).__name__ == "KilledWorker":
                raise WorkerDiedError from None
            if self._cluster is not None and not isinstance(error, G2ardError):
                self._cluster.check_answer(error)
            raise

    def _check_lanes(self, worker: "_Worker") -> None:
        """Raise an `InputError` if two workers have other instructions, which round differently."""
        self._lanes.setdefault(worker.lanes, worker.host)
        if len(self._lanes) > 1:
            told = " and ".join(f"{lanes} on {host}" for lanes, host in self._lanes.items())
            raise InputError(
                f"workers compute with {told}, whose last bits differ; use workers of one kind"
            )

    def close(self) -> None:
        """Cancel unfinished tasks, and kill the processes of this pool."""
        if self._pool is None:
            return
        processes = list((getattr(self._pool, "_processes", None) or {}).values())
        manager: threading.Thread | None = getattr(self._pool, "_executor_manager_thread", None)
        self._pool.shutdown(wait=False)
        for process in processes:
            with suppress(OSError, ValueError):
                process.kill()
        for process in processes:
            process.join()
        if manager is not None:
            manager.join(timeout=_POOL_SHUTDOWN_SECONDS)
        self._pool = None


@dataclass(frozen=True)
class _Worker:
    """A worker after a task: host, process ID, peak memory in bytes, and its fastest instruction set."""

    host: str
    process: int
    peak: int | None
    lanes: str


@cache
def program() -> str:
    """Return the version of g2ard, with a hash of its sources and of the core's defaults."""
    package = Path(__file__).parents[1]
    sources = [path.read_bytes() for path in sorted(package.rglob("*.py"))]
    return f"{_core.__version__}-{key_of([*sources, repr(_core.defaults())])[:8]}"


def _work(task: Task, threads: int, client: str) -> _Worker:
    """Run a task in a worker that has the client's program; return the worker's description."""
    host = platform.node()
    if program() != client:
        raise InputError(
            f"the worker on {host} runs g2ard {program()}, this program is {client}; install the same on all"
        )
    _core.set_num_threads(threads)
    run_task(task)
    return _Worker(host, os.getpid(), peak_rss(), _core.instruction_sets()[0])


def _begin() -> None:
    """Initialise a worker: leave Ctrl-C to the parent, and exit when the parent dies."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Exit when the parent is gone; a killed parent cannot tell its workers, which would wait forever."""
    if (parent := parent_process()) is not None:
        parent.join()
    os._exit(1)


def _dask_client(scheduler: str, workers: int, opened: ExitStack) -> Any:
    """Connect to a Dask scheduler, or start one on this machine; `opened` closes both."""
    try:
        from distributed import Client, LocalCluster
    except ImportError:
        raise missing("Dask", "distributed", parameter="scheduler") from None
    if scheduler == "local":
        cluster = LocalCluster(  # type: ignore[no-untyped-call]
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            dashboard_address=None,
            memory_limit=0,
        )
        scheduler = opened.enter_context(closing(cluster)).scheduler_address
    try:
        client = Client(scheduler, timeout="10s", set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, TimeoutError, ValueError) as error:
        raise InputError(
            f"--scheduler {scheduler}: no answer ({error}); start one with `dask scheduler`, which "
            "prints its address"
        ) from None
    return opened.enter_context(closing(client))
