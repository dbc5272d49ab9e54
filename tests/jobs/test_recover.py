"""`g2ard.recover` with views or a teacher, as the command decides them."""

from pathlib import Path
from typing import Any

import pytest

import g2ard
from g2ard.errors import InputError
from g2ard.io import write_views
from g2ard.jobs.recover import prepare
from g2ard.stages.recover.config import count_steps_for_renders
from helpers.commands import CommandLine, succeeds
from helpers.photos import photographed
from helpers.scenes import around, checkered_ball
from reference import poses as naive

BALL, VIEWS = checkered_ball(400), around(16, (48, 36))


@pytest.mark.parametrize(
    "source",
    [
        {"teacher": "ball.ply"},
        {"views": "photos.json"},
        {"views": "photos.json", "teacher": "ball.ply"},
        {"views": "photos.json", "anchors": "ball.ply"},
    ],
)
def test_python_recovers_as_the_command_does(
    source: dict[str, str], folder: Path, command_line: CommandLine
) -> None:
    write_views(folder / "photos.json", photographed(folder, BALL, VIEWS), weights=range(1, 17))
    flags = [word for name, path in source.items() for word in (f"--{name}", path)]
    ask = ("recover", "ball.ply", *flags, "--steps", 4, "--size", 40, "--set", "ssim_weight=0.3")
    succeeds(command_line, folder, *ask, "-o", "out.ply")
    paths: dict[str, Any] = {name: folder / path for name, path in source.items()}
    settings = {"recover.steps": 4, "ssim_weight": 0.3}
    done = g2ard.recover(folder / "ball.ply", **paths, size=40, settings=settings)
    g2ard.save(folder / "python.ply", done.splats)
    assert (folder / "python.ply").read_bytes() == (folder / "out.ply").read_bytes()


def test_a_student_that_is_its_teacher_takes_no_step(
    folder: Path, command_line: CommandLine
) -> None:
    ask = ("recover", "ball.ply", "--teacher", "ball.ply", "--views", "views.json", "-o", "out.ply")
    told = succeeds(command_line, folder, *ask).err
    assert "recovery skipped: the scene already renders as its targets\n" in told
    assert "steps/s" not in told
    assert (folder / "out.ply").read_bytes() == (folder / "ball.ply").read_bytes()


def test_a_generated_pool_is_completed_for_the_student(folder: Path) -> None:
    """Views of other kinds train, validate and are scored, and more views get more steps, as in `distill`."""
    student = g2ard.simplify(naive.statue(), ratio=10, method="fast").splats
    job = prepare(student, views="made", teacher=naive.statue(), size=32)
    kinds = job.targets.train.cameras.kinds
    assert kinds.count("usual") == 112
    assert {"usual"} < set(kinds)
    assert job.targets.validation is not None
    assert "usual" not in job.targets.validation.cameras.kinds
    assert job.held_out is not None
    assert job.held_out.cameras.kinds.count("usual") == 16
    assert set(job.targets.validation.cameras.kinds) <= set(job.held_out.cameras.kinds)
    assert job.config.steps == count_steps_for_renders(student, job.targets.train.cameras, 800)
    names = [
        *job.targets.train.cameras.names,
        *job.targets.validation.cameras.names,
        *job.held_out.cameras.names,
    ]
    assert len(set(names)) == len(names)
    given = prepare(student, views=job.targets.views.train, teacher=naive.statue(), size=32)
    assert given.targets.validation is None


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"targets": g2ard.TeacherRenders(BALL, VIEWS), "views": VIEWS}, "views: goes with"),
        ({"targets": g2ard.TeacherRenders(BALL, VIEWS), "settings": {}}, "settings: goes with"),
        (
            {"views": VIEWS, "teacher": BALL, "config": g2ard.RecoverConfig()},
            "config: goes with targets",
        ),
        ({}, "there are no targets; give views, or a teacher"),
        ({"views": VIEWS, "teacher": BALL, "anchors": BALL.take(range(9))}, "the student has 400"),
    ],
)
def test_arguments_of_one_source_of_targets_do_not_go_with_another(
    given: dict[str, Any], words: str
) -> None:
    with pytest.raises(InputError, match=words):
        g2ard.recover(BALL, **given)
