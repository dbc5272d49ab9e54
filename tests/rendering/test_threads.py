"""Objects of the API in several threads at once."""

import pickle
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import g2ard._core as _core
from g2ard.rendering.renderer import RasterSettings, Renderer, arrays_of, view_of
from g2ard.rendering.targets import Photos, Targets, TeacherRenders
from g2ard.scene.prepared import finite_rows_of
from g2ard.stages.recover.config import Rates
from helpers.photos import photographed
from helpers.project import ROOT
from helpers.scenes import around, checkered_ball

VIEWS = around(8, (96, 72))
BALL = checkered_ball(2000)

THREADS = 6


def at_once(work: Callable[[int], Any]) -> list[Any]:
    """Return what a function of a thread's number returns in threads that start together."""
    start = threading.Barrier(THREADS)

    def one(thread: int) -> Any:
        start.wait()
        return work(thread)

    with ThreadPoolExecutor(THREADS) as pool:
        return list(pool.map(one, range(THREADS), timeout=120))


def in_turn(count: int, thread: int) -> list[int]:
    """Return all of `count`, beginning elsewhere in each thread."""
    return [(thread + i) % count for i in range(count)]


def test_one_renderer_renders_as_in_one_thread() -> None:
    alone = [Renderer(BALL).image(view) for view in VIEWS]
    shared = Renderer(BALL)
    for _ in range(3):
        for thread, images in enumerate(
            at_once(lambda t: [shared.image(VIEWS[i]) for i in in_turn(8, t)])
        ):
            for view, image in zip(in_turn(8, thread), images, strict=True):
                np.testing.assert_array_equal(image, alone[view])


IMAGE_BYTES = 3 * 4 * 96 * 72


def _renders(folder: Path, limit: int) -> Targets:
    return TeacherRenders(BALL, VIEWS, lazy=True, limit=limit)


def _photos(folder: Path, limit: int) -> Targets:
    return Photos(photographed(folder, BALL, VIEWS), limit=limit)


def _images(folder: Path, limit: int) -> Targets:
    renderer = Renderer(BALL)
    return Photos(VIEWS, [renderer.clipped(view) for view in VIEWS], limit=limit)


@pytest.mark.parametrize("limit", [0, 3 * IMAGE_BYTES, 100 * IMAGE_BYTES])
@pytest.mark.parametrize("make", [_renders, _photos, _images])
def test_targets_are_those_of_one_thread_and_keep_no_more(
    tmp_path: Path, make: Callable[[Path, int], Any], limit: int
) -> None:
    targets, alone = make(tmp_path / "shared", limit), make(tmp_path / "alone", limit)
    for thread, images in enumerate(at_once(lambda t: [targets[i] for i in in_turn(8, t)])):
        for view, image in zip(in_turn(8, thread), images, strict=True):
            np.testing.assert_array_equal(image, alone[view])
    kept = [array for array in targets._kept.values() if array is not None]
    assert targets._bytes == sum(array.nbytes for array in kept) <= limit


def test_targets_can_be_sent_to_another_process() -> None:
    for targets in (_renders(Path(), 0), _images(Path(), 0)):
        there: Any = pickle.loads(pickle.dumps(targets))
        np.testing.assert_array_equal(there[2], targets[2])


def test_sums_of_visibility_lose_no_view() -> None:
    scene, _ = finite_rows_of(BALL)
    settings = RasterSettings(antialiased=False)
    views = [view_of(VIEWS, i, settings) for i in range(len(VIEWS))]
    alone, shared = _core.VisibilityAccumulator(scene.core), _core.VisibilityAccumulator(scene.core)
    for _ in range(THREADS):
        alone.add(views, settings, None)

    def add(thread: int) -> None:
        for i in in_turn(8, thread):
            shared.add([views[i]], settings, None)
            shared.by_row()

    at_once(add)
    for got, want in zip(shared.by_row(), alone.by_row(), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-5)


def test_a_trainer_takes_every_step() -> None:
    objective: Any = SimpleNamespace(
        settings=RasterSettings(antialiased=False), background=(0.0, 0.0, 0.0), ssim_weight=0.2
    )
    trainer = _core.Trainer(arrays_of(BALL), objective)
    target = np.zeros((72, 96, 3), np.float32)
    view = view_of(VIEWS, 0, objective.settings)
    rates = Rates(1e-4, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4)

    def step(thread: int) -> None:
        for _ in range(3):
            trainer.step(view, target, rates)
            trainer.arrays()
            trainer.state()

    at_once(step)
    assert trainer.state()["steps"].max() == 3 * THREADS
    assert trainer.skipped == 0


def test_every_class_of_the_extension_is_usable_from_threads() -> None:
    """PyO3 refuses a second caller of a class that is not frozen: "Already borrowed"."""
    sources = sorted((ROOT / "rust" / "g2ard-py" / "src").glob("*.rs"))
    classes = [
        line for path in sources for line in path.read_text().splitlines() if "#[pyclass" in line
    ]
    assert len(classes) >= 6
    assert [line for line in classes if "frozen" not in line] == []
