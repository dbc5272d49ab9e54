"""A limit on the time of a whole distillation."""

import json
import signal
from dataclasses import replace
from pathlib import Path

import pytest

from g2ard import save
from g2ard.errors import InputError
from g2ard.jobs import distill_job as jobs
from g2ard.jobs.budget import Budget
from g2ard.jobs.distill import prepare
from g2ard.jobs.distill_options import DistillOptions
from g2ard.rendering.targets import Targets, TeacherRenders
from g2ard.stages.recover.config import RecoverConfig
from g2ard.stages.recover.loop import Loop
from g2ard.stages.recover.optimize import recover
from helpers.commands import CommandLine, succeeds
from helpers.scenes import around, checkered_ball


@pytest.fixture(scope="module")
def job() -> jobs.DistillJob:
    return prepare(checkered_ball(1200), Budget(ratio=8), DistillOptions(size=48, time=60.0))


def test_recovery_gets_what_the_rest_leaves(
    job: jobs.DistillJob, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(jobs.DistillJob, "_scoring_seconds", lambda self: 4.0)
    monkeypatch.setattr(jobs.time, "monotonic", lambda: 12.0)
    assert replace(job, began=2.0).time_left(60.0) == 60 - 10 - 4


def test_scoring_is_timed_in_some_views(
    job: jobs.DistillJob, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A second per view, of which the larger ones count by their pixels."""
    now = [0.0]

    def score(splats: object, targets: Targets, **options: object) -> None:
        now[0] += len(targets.cameras)

    monkeypatch.setattr(jobs, "evaluate", score)
    monkeypatch.setattr(jobs.time, "monotonic", lambda: now[0])
    views = job.views
    twice = 4 * len(views.twice or ())
    scored = len(views.test) + len(job.targets.apart.cameras if job.targets.apart else ()) + twice
    assert job._scoring_seconds() == pytest.approx(2 * scored)
    assert 0 < now[0] <= 8


def test_too_short_a_time_is_told(job: jobs.DistillJob, monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    monkeypatch.setattr(jobs.DistillJob, "_scoring_seconds", lambda self: 4.0)
    monkeypatch.setattr(jobs.time, "monotonic", lambda: 50.0)
    assert replace(job, began=2.0, say=said.append).time_left(40.0) == 2.0
    assert said == ["warning: 40 s are short; after 48.0 s recovery still gets 2.0 s"]


def test_views_are_planned_for_the_time(job: jobs.DistillJob) -> None:
    short = prepare(checkered_ball(1200), Budget(ratio=8), DistillOptions(size=48, time=5.0))
    assert len(short.views.train.cameras) < len(job.views.train.cameras)


def test_an_interrupted_run_keeps_its_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The limit is decided once, and stored with the steps."""
    limits = iter([1.5, 99.0])
    monkeypatch.setattr(jobs.DistillJob, "time_left", lambda self, limit: next(limits))

    def stop(stage: str, done: int, total: int, info: object = None) -> None:
        if stage == "recover" and done >= 3:
            signal.raise_signal(signal.SIGINT)

    scene, budget = checkered_ball(1200), Budget(ratio=8)
    options = DistillOptions(size=48, time=60.0, progress=stop)
    with pytest.raises(KeyboardInterrupt):
        prepare(scene, budget, options).run(tmp_path)
    done = prepare(scene, budget, DistillOptions(size=48, time=60.0)).run(tmp_path)
    assert done.report.rounds[-1].recover[-1].seconds < 10
    assert next(limits) == 99.0


@pytest.mark.parametrize("other", ["steps", "recovery_time"])
def test_other_limits_are_excluded(other: str) -> None:
    with pytest.raises(InputError, match=other):
        DistillOptions(time=60.0, settings={f"recover.{other}": 5}).config


LIMITED = {
    "distill": "distill ball.ply -r 8 -o run --size 48 --time",
    "the paper": "distill ball.ply -r 8 -o run --size 48 --preset paper --time",
    "views": "distill ball.ply -r 8 -o run --views views.json --time",
    "recovery": "distill ball.ply -r 8 -o run --size 48 --recovery-time",
    "the paper's recovery": "distill ball.ply -r 8 -o run --size 48 --preset paper --recovery-time",
    "recover": "recover small.ply --teacher ball.ply -o out.ply --size 48 --recovery-time",
}


@pytest.mark.parametrize("name", LIMITED)
def test_a_dry_run_leaves_the_steps_open(
    name: str, folder: Path, command_line: CommandLine
) -> None:
    save(folder / "small.ply", checkered_ball(50))
    told = succeeds(command_line, folder, *LIMITED[name].split(), "60s", "--dry-run", "--json", "-")
    assert json.loads(told.out)["steps"] is None
    assert "as many steps as fit" in told.err


def test_the_time_of_trials_is_not_taken_from_the_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Loop, "choose_rates", lambda self, start: setattr(self, "seconds", 5.0))
    ball, views = checkered_ball(100), around(4, (24, 18))
    config = RecoverConfig(recovery_time=9.0)
    done = recover(ball.take(slice(50)), TeacherRenders(ball, views), config, time_left=lambda: 0.3)
    assert done.report.steps > 0
    assert 5.3 <= done.report.seconds < 8
