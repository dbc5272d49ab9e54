"""Work interrupted or killed at any point: made again, it returns the bits of an uninterrupted call."""

import math
import os
import re
import signal
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from g2ard.config.schema import changed
from g2ard.pipeline.adapt import AdaptConfig, adapt
from g2ard.pipeline.config import DistillConfig, SelectConfig
from g2ard.pipeline.distill import distill
from g2ard.pipeline.presets import configure
from g2ard.rendering.targets import Photos, TeacherRenders
from g2ard.scene.splats import ARRAYS
from g2ard.stages.recover import checkpoint
from g2ard.stages.recover.anchors import REGULARIZERS
from g2ard.stages.recover.config import PAPER as PAPER_SCHEDULE
from g2ard.stages.recover.config import TUNED, RecoverConfig
from g2ard.stages.recover.optimize import recover
from helpers.scenes import around, checkered_ball

Call = Callable[..., Any]

_TIMES = re.compile(r"seconds|resumed|^share$")
"""Fields of reports that hold durations: an interruption may change them, and nothing else."""

VIEWS = around(7, (24, 18))
BALL, SMALL = checkered_ball(90), checkered_ball(40, seed=3)
IMAGES = list(TeacherRenders(BALL, VIEWS))
WEIGHTS = np.linspace(0, 3, len(VIEWS)) ** 2
NOISY = replace(REGULARIZERS["lift"], period=4)
WILD = replace(TUNED, multiplier=20.0, reach=math.inf)  # goes back to the start


class Broken:
    """Targets of which one gives gradients that are not finite."""

    cameras = VIEWS

    def __getitem__(self, view: int) -> Any:
        return IMAGES[view] * np.float32(np.nan if view == 4 else 1)


def renders() -> TeacherRenders:
    """Return targets that were in no call before: what a call computes is not known to the next."""
    return TeacherRenders(BALL, VIEWS)


def near() -> TeacherRenders:
    return TeacherRenders(BALL, around(3, (24, 18), 2.0))


def photos(image: Callable[[int], Any]) -> Photos:
    return Photos(VIEWS, [image(view) for view in range(len(VIEWS))])


def made(given: dict[str, Any]) -> dict[str, Any]:
    """Return arguments, those that are functions called."""
    return {name: value() if callable(value) else value for name, value in given.items()}


def recovery(**settings: Any) -> Call:
    given = {
        name: settings.pop(name)
        for name in ("weights", "validation", "frozen", "targets")
        if name in settings
    }
    config = RecoverConfig(**{"steps": 24, "regularizers": NOISY, **settings})

    def call(work: Path | None, progress: Any) -> Any:
        file = None if work is None else work / "c.npz"
        return recover(
            SMALL,
            config=config,
            checkpoint=file,
            progress=progress,
            **made({"targets": renders, **given}),
        )

    return call


def distillation(config: DistillConfig, **more: Any) -> Call:
    return lambda work, progress: distill(
        BALL, 30, renders(), config, work=work, progress=progress, **made(more)
    )


ROUNDS = replace(TUNED, steps=9, round_steps=5)
PAPER = changed(
    configure(DistillConfig(), "paper"),
    {"recover.steps": 6, "recover.schedule.round_steps": 3, "simplify.iterations": 3},
)

CASES: dict[str, Call] = {
    "recover": recovery(),
    "recover-torch": recovery(engine="torch", steps=12, targets=Broken, schedule=PAPER_SCHEDULE),
    "recover-weights": recovery(weights=WEIGHTS, sh_degree=2),
    "recover-trials": recovery(steps=100),
    "recover-back": recovery(schedule=WILD),
    "recover-validation": recovery(validation=near),
    "recover-exposures": recovery(
        targets=partial(photos, lambda view: IMAGES[view] * 0.8 ** (view % 3)), steps=60
    ),
    "recover-frozen": recovery(frozen=np.arange(len(SMALL)) % 3 == 0),
    "recover-skipping": recovery(targets=Broken, schedule=PAPER_SCHEDULE),
    "distill": distillation(DistillConfig(recover=RecoverConfig(steps=12)), validation=near),
    "distill-rounds": distillation(
        DistillConfig(
            SelectConfig(views_count=4, reselect=True),
            recover=RecoverConfig(schedule=ROUNDS, sh_degree=0),
        )
    ),
    "paper": distillation(PAPER),
    "adapt": lambda work, progress: adapt(
        SMALL,
        photos(lambda view: 1 - IMAGES[view]),
        AdaptConfig(steps=21, first_stretch=5, tolerance=0, sh_degree=1),
        work=work,
        progress=progress,
    ),
}


class PowerCutError(BaseException):
    """The end of a killed process, which nothing catches or cleans up after."""


def content(result: Any) -> dict[str, Any]:
    """Return a result's arrays and its report without durations."""
    scenes = {"splats": result.splats, "simplified": getattr(result, "simplified", result.splats)}
    arrays = {
        f"{key}.{name}": getattr(each, name) for key, each in scenes.items() for name in ARRAYS
    }
    return {**arrays, "report": _timeless(result.report.as_dict())}


def _timeless(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _timeless(item) for key, item in value.items() if not _TIMES.search(key)}
    return [_timeless(item) for item in value] if isinstance(value, list) else value


def assert_same(found: dict[str, Any], whole: dict[str, Any], what: str) -> None:
    for name, value in whole.items():
        np.testing.assert_equal(found[name], value, err_msg=f"{what}: {name}")


def counted(do: Callable[[], None]) -> tuple[list[int], Callable[..., Any]]:
    """Return a counter of calls, and a function that counts them and then acts."""
    calls = [0]

    def count(*_: Any, **__: Any) -> None:
        calls[0] += 1
        do()

    return calls, count


def moments(total: int) -> list[int]:
    """Return up to five moments among `total`, the first, the last and others between."""
    return sorted({1 + round(i * (total - 1) / 4) for i in range(5)})


@pytest.mark.parametrize("name", CASES)
def test_after_ctrl_c_at_any_report(name: str, tmp_path: Path) -> None:
    call = CASES[name]
    told, count = counted(lambda: None)
    whole = content(call(None, count))
    assert told[0] > 10
    for moment in moments(told[0]):
        work = tmp_path / str(moment)
        work.mkdir()
        calls, progress = counted(lambda: None)

        def press(
            *_: Any,
            calls: list[int] = calls,
            progress: Any = progress,
            moment: int = moment,
            **__: Any,
        ) -> None:
            progress()
            if calls[0] == moment:
                signal.raise_signal(signal.SIGINT)

        with pytest.raises(KeyboardInterrupt):
            call(work, press)
        assert_same(content(call(work, count)), whole, f"stopped at report {moment} of {told[0]}")


@pytest.mark.parametrize("name", CASES)
def test_after_a_power_cut_at_any_file(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Checkpoints are written after every step here. The cut comes after a file is renamed or removed."""
    call = CASES[name]
    whole = content(call(None, lambda *_: None))
    monkeypatch.setattr(checkpoint, "PERIOD", -1.0)
    done, until = [0], [0]

    def cutting(original: Callable[..., Any], *args: Any, **more: Any) -> Any:
        result = original(*args, **more)
        done[0] += 1
        if done[0] == until[0]:
            raise PowerCutError
        return result

    def run(moment: int, work: Path) -> Any:
        work.mkdir(exist_ok=True)
        done[0], until[0] = 0, moment
        with monkeypatch.context() as patched:
            for function in ("replace", "link", "unlink"):
                patched.setattr(os, function, partial(cutting, getattr(os, function)))
            return call(work, lambda *_: None)

    assert_same(content(run(0, tmp_path / "whole")), whole, "with checkpoints")
    files = done[0]
    assert files > 5
    for moment in moments(files):
        with pytest.raises(PowerCutError):
            run(moment, tmp_path / str(moment))
        ended = content(call(tmp_path / str(moment), lambda *_: None))
        assert_same(ended, whole, f"cut after {moment} of {files} files")


def test_runs_that_share_a_folder_do_not_mix(tmp_path: Path) -> None:
    config, brighter = AdaptConfig(steps=9), replace(SMALL, sh0=SMALL.sh0 + np.float32(0.1))
    rounds = replace(PAPER, recover=replace(PAPER.recover, seed=1))
    calls: list[Call] = [
        *(
            partial(adapt, scene, targets(), how)
            for scene, targets, how in (
                (SMALL, renders, config),
                (SMALL, renders, replace(config, seed=1)),
                (brighter, renders, config),
                (SMALL, near, config),
            )
        ),
        *(
            partial(distill, scene, budget, targets(), how, weights=weights)
            for scene, budget, targets, how, weights in (
                (BALL, 30, renders, PAPER, None),
                (BALL, 30, renders, rounds, None),
                (BALL, 29, renders, PAPER, None),
                (BALL, 30, renders, PAPER, WEIGHTS),
                (replace(BALL, sh0=BALL.sh0 + np.float32(0.1)), 30, renders, PAPER, None),
                (BALL, 30, near, PAPER, None),
            )
        ),
    ]
    for number, call in enumerate(calls):
        found, alone = (content(call(work=work)) for work in (tmp_path, None))
        assert_same(found, alone, f"call {number}")
