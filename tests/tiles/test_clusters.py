"""Clusters that cannot do the work say so: another program, no worker, a scheduler that ends."""

import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from g2ard.errors import InputError
from g2ard.tiles import executor as module
from g2ard.tiles.executor import Workers, _Pool, _Worker, executor
from g2ard.tiles.tasks import Task

pytest.importorskip("distributed")


def _tasks(folder: Path) -> list[Task]:
    """Return a task of a function that is nowhere: no test here comes as far as to run it."""
    return [Task("nowhere:nothing", "nothing", folder)]


@pytest.fixture
def scheduler(tmp_path: Path) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """A scheduler in a process of its own, without workers."""
    words = [
        sys.executable,
        "-m",
        "distributed.cli.dask_scheduler",
        "--port",
        "0",
        "--no-dashboard",
    ]
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True, cwd=tmp_path) as running:
        assert running.stderr is not None
        lines = iter(running.stderr.readline, "")
        found = next(match for line in lines if (match := re.search(r"tcp://[\w.]+:\d+", line)))
        yield found[0], running
        running.kill()


def _run(scheduler: str, folder: Path) -> str:
    with pytest.raises(InputError) as caught, executor(2, scheduler=scheduler) as runs:
        Workers(runs, folder).run(_tasks(folder), "nothing")
    return str(caught.value)


def test_a_cluster_without_workers_is_not_waited_for(
    scheduler: tuple[str, subprocess.Popen[str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_WORKER_SECONDS", 1.0)
    monkeypatch.setattr(module, "_POLL_SECONDS", 0.3)
    address, _ = scheduler
    said = _run(address, tmp_path)
    assert f"--scheduler {address}: no worker for" in said
    assert f"`dask worker {address}`" in said


def test_a_scheduler_that_ends_is_named(
    scheduler: tuple[str, subprocess.Popen[str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_POLL_SECONDS", 0.3)
    address, running = scheduler
    check = module._Cluster.check

    def ending(cluster: module._Cluster) -> None:
        if running.poll() is None:
            running.kill()
            running.wait()
            time.sleep(0.5)
        check(cluster)

    monkeypatch.setattr(module._Cluster, "check", ending)
    said = _run(address, tmp_path)
    assert f"--scheduler {address}: the connection was lost" in said
    assert "run the same command again" in said


@pytest.mark.parametrize("cluster", ["local", None])
def test_a_worker_with_another_program_is_refused(
    cluster: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = module.program()
    monkeypatch.setattr(module, "program", lambda: "0.0.9-other")
    with pytest.raises(InputError) as caught, executor(2, scheduler=cluster) as runs:
        Workers(runs, tmp_path).run(_tasks(tmp_path), "nothing")
    assert f"runs g2ard {own}, this program is 0.0.9-other" in str(caught.value)
    assert not list(tmp_path.glob("*.npz"))


def test_workers_of_two_kinds_are_refused() -> None:
    pool = _Pool(lambda: pytest.fail("opened"), 1)
    for _ in range(2):
        pool._check_lanes(_Worker("here", 1, None, "avx2"))
    with pytest.raises(InputError, match="avx2 on here and neon on there"):
        pool._check_lanes(_Worker("there", 1, None, "neon"))
