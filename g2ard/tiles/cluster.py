"""Tasks on a Dask cluster: the same functions, the same files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from g2ard.errors import InputError
from g2ard.progress import Progress, silent
from g2ard.tiles.task import Task, run_task

__all__ = ["DaskExecutor"]

_TRIES = 5
"""How often in a row Dask may give up a task, on which four workers died, with none done between."""


class DaskExecutor:
    """Runs tasks on the workers of a scheduler, which must see the same files under the same paths.

    Results are paths: what workers hold in memory is Rust's, which Dask's spilling does not know of.

    Raises:
        InputError: Dask is not installed, or the scheduler does not answer.
    """

    def __init__(self, scheduler: str, workers: int, threads: int):
        try:
            from distributed import Client, LocalCluster
        except ImportError:
            raise InputError(
                '--scheduler: Dask is not installed; pip install "g2ard[distributed]" brings it'
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
                f"--scheduler {scheduler}: does not answer ({error}); `dask scheduler` starts one and prints "
                "its address"
            ) from None

    def __enter__(self) -> DaskExecutor:
        return self

    def __exit__(self, *_: object) -> None:
        self.client.close()
        if self._cluster is not None:
            self._cluster.close()

    def run(self, tasks: Sequence[Task], stage: str, progress: Progress = silent) -> list[Path]:
        """As `Executor.run`; a worker's death costs a retry."""
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
                        f"{stage}: workers die before they finish anything; give them memory"
                    ) from None
                continue
            if missing := [task.output for task in tasks if not task.done]:
                raise InputError(
                    f"{missing[0]}: a worker made it, but it is not here; share that folder with all workers"
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
    from g2ard import _core

    _core.set_num_threads(threads)
    return str(run_task(task))
