"""Objects of the API in several threads at once."""

import pickle
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from g2ard.errors import InputError
from g2ard.rendering.renderer import Renderer
from g2ard.rendering.targets import Photos, Targets, TeacherRenders
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
        for thread, images in enumerate(at_once(lambda t: [shared.image(VIEWS[i]) for i in in_turn(8, t)])):
            for view, image in zip(in_turn(8, thread), images, strict=True):
                np.testing.assert_array_equal(image, alone[view])


def test_a_pose_gradient_is_of_the_own_threads_render() -> None:
    renderer, gradient = Renderer(BALL), np.ones((72, 96, 3), np.float32)
    renderer.image(VIEWS[0])
    own = renderer.pose_gradient(gradient)
    with ThreadPoolExecutor(1) as pool:
        with pytest.raises(InputError, match="another thread"):
            pool.submit(renderer.pose_gradient, gradient).result()
        pool.submit(renderer.image, VIEWS[3]).result()
    with pytest.raises(InputError, match="another thread"):
        renderer.pose_gradient(gradient)
    renderer.image(VIEWS[0])
    np.testing.assert_array_equal(renderer.pose_gradient(gradient), own)


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


def test_every_class_of_the_extension_is_usable_from_threads() -> None:
    """PyO3 refuses a second caller of a class that is not frozen: "Already borrowed"."""
    sources = sorted((ROOT / "rust" / "g2ard-py" / "src").glob("*.rs"))
    classes = [line for path in sources for line in path.read_text().splitlines() if "#[pyclass" in line]
    assert len(classes) >= 6
    assert [line for line in classes if "frozen" not in line] == []
