"""Values that the documentation allows work, others are refused where they enter."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import g2ard
from g2ard.errors import InputError, OutputError
from g2ard.io.atomic import hidden_name
from g2ard.io.lock import locked
from g2ard.rendering.renderer import render
from g2ard.rendering.targets import TeacherRenders
from g2ard.scene.splats import ARRAYS
from helpers.scenes import around, checkered_ball

BALL = checkered_ball(400)
VIEWS = around(4, (40, 30))


@pytest.mark.parametrize("length", [1e-24, 1e37])
@pytest.mark.parametrize("engine", ["fused", "torch"])
def test_quaternions_of_any_length_recover_like_unit_ones(engine: Any, length: float) -> None:
    student = g2ard.simplify(BALL, ratio=4, blind=True).splats
    scaled = replace(student, quats=(student.quats * np.float32(length)).astype(np.float32))
    targets = TeacherRenders(BALL, VIEWS)
    config = g2ard.RecoverConfig(steps=8, engine=engine)
    unit, odd = (g2ard.recover(scene, targets, config) for scene in (student, scaled))
    assert unit.report.psnr.after > unit.report.psnr.before
    assert odd.report.psnr.after == pytest.approx(unit.report.psnr.after, abs=0.2)


@pytest.mark.parametrize("length", [1e-24, 1e37])
def test_quaternions_of_any_length_render_simplify_and_select_like_unit_ones(length: float) -> None:
    scaled = replace(BALL, quats=(BALL.quats * np.float32(length)).astype(np.float32))
    np.testing.assert_allclose(
        render(scaled, VIEWS[0]).image, render(BALL, VIEWS[0]).image, atol=1e-4
    )
    near, odd = (g2ard.simplify(scene, ratio=4).splats for scene in (BALL, scaled))
    scores = [g2ard.evaluate(scene, TeacherRenders(BALL, VIEWS)).psnr for scene in (near, odd)]
    # rounding decides which of equal merges come first
    assert abs(scores[1] - scores[0]) < 1, scores
    orders = [g2ard.select(scene, VIEWS, 2).order.tolist() for scene in (BALL, scaled)]
    assert orders[0] == orders[1]


def rotated(R: Any, last: Any = (0, 0, 0, 1)) -> NDArray[np.float64]:
    """Poses of the views, the third of which has another upper left 3×3 part."""
    poses = VIEWS.viewmats.copy()
    poses[2, :3, :3] = np.asarray(R, float) @ poses[2, :3, :3]
    poses[2, 3] = last
    return poses


@pytest.mark.parametrize(
    ("poses", "fault"),
    [
        (rotated(2 * np.eye(3)), "scales by 2"),
        (rotated(0.99 * np.eye(3)), "scales by 0.99"),
        (rotated(np.diag([1, 1, -1])), "mirrors"),
        (rotated(-np.eye(3)), "mirrors"),
        (rotated([[1, 0.1, 0], [0, 1, 0], [0, 0, 1]]), "skews"),
        (rotated(np.diag([1, 1, 1.05])), "skews"),
        (rotated(np.zeros((3, 3))), "skews"),
        (rotated(np.eye(3), (0, 0, 0, 2)), "last row"),
        (rotated(np.eye(3), (0.1, 0, 0, 1)), "last row"),
    ],
)
def test_poses_that_are_not_rigid_are_refused_with_their_view(
    poses: NDArray[np.float64], fault: str
) -> None:
    with pytest.raises(InputError, match=fault) as caught:
        replace(VIEWS, viewmats=poses)
    assert (caught.value.index, caught.value.item) == (2, "view")
    assert VIEWS.names[2] in str(caught.value)
    with pytest.raises(InputError, match=fault):
        render(BALL, replace(VIEWS[2], viewmat=poses[2]))


def test_rounded_poses_are_accepted() -> None:
    replace(VIEWS, viewmats=VIEWS.viewmats.round(4))
    replace(VIEWS, viewmats=VIEWS.viewmats.astype(np.float32).astype(np.float64))


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_integer_colours_are_shares_of_their_largest_value(kind: Any) -> None:
    points = BALL.means.astype(np.float64)
    colors = np.random.default_rng(0).integers(0, np.iinfo(kind).max, (400, 3)).astype(kind)
    shares = colors / np.iinfo(kind).max
    np.testing.assert_allclose(g2ard.lift(points, colors).colors, shares, atol=1e-5)
    np.testing.assert_allclose(g2ard.Points(points, colors).colors, shares, atol=1e-6)


@pytest.mark.parametrize("kind", [float, np.float32, int, np.int64, np.uint32])
def test_colours_above_one_are_refused_with_their_row(kind: Any) -> None:
    points, colors = BALL.means.astype(np.float64), np.zeros((400, 3)).astype(kind)
    colors[7, 1] = 200
    for function in (g2ard.lift, g2ard.Points):
        with pytest.raises(InputError, match="0 to 1") as caught:
            function(points, colors)
        assert (caught.value.parameter, caught.value.index) == ("colors", 7)


@pytest.mark.parametrize("name", ARRAYS)
@pytest.mark.parametrize("kind", ["float64", "float16", "list", "strided"])
def test_arrays_of_any_number_type_work(name: str, kind: str) -> None:
    values: Any = getattr(BALL, name)
    if kind == "list":
        if not values.size:
            return
        values = values.tolist()
    elif kind == "strided":
        values = np.repeat(values, 2, axis=0)[::2]
    else:
        values = values.astype(kind)
    scene = replace(BALL, **{name: values})
    assert getattr(scene, name).dtype == np.float32 or name == "means"
    assert len(g2ard.simplify(scene, ratio=4, blind=True).splats) == 100
    assert len(g2ard.select(scene, VIEWS, 2).order) == 2


@pytest.mark.parametrize("name", [*ARRAYS, "offset"])
@pytest.mark.parametrize("values", [None, "abc", [[1, 2], [3]], np.array([1j])], ids=str)
def test_what_is_no_array_of_numbers_is_refused_by_name(name: str, values: Any) -> None:
    with pytest.raises(InputError) as caught:
        replace(BALL, **{name: values})
    assert caught.value.parameter == name


@pytest.mark.parametrize("array", ["means", "quats", "scales", "sh0"])
def test_rows_that_are_not_finite_are_counted_and_named(array: str, tmp_path: Path) -> None:
    values = getattr(BALL, array).copy()
    values[[7, 9]] = np.nan
    scene = replace(BALL, **{array: values})
    calls: dict[str, Any] = {
        "splats": lambda: g2ard.select(scene, VIEWS, 2),
        "scene": lambda: g2ard.clean(scene),
        "levels": lambda: g2ard.save_levels(tmp_path / "levels", [BALL, scene]),
    }
    for parameter, call in calls.items():
        with pytest.raises(InputError, match=r"first of 2|level 1") as caught:
            call()
        assert (caught.value.parameter, caught.value.index) == (parameter, 7)


@pytest.mark.skipif(sys.platform == "win32", reason="names have another limit")
@pytest.mark.parametrize("length", [240, 255])
@pytest.mark.parametrize("letter", ["a", "ü"])
def test_long_names_can_be_written(tmp_path: Path, length: int, letter: str) -> None:
    for suffix in (".ply", ".sog", ".compressed.ply"):
        name = letter * ((length - len(suffix)) // len(letter.encode())) + suffix
        g2ard.save(tmp_path / name, BALL)
        assert len(g2ard.load(tmp_path / name)) == 400
        with locked(tmp_path, name):
            pass
    g2ard.save_levels(tmp_path / (letter * (length // len(letter.encode()))), [BALL])
    assert len(list(tmp_path.iterdir())) == 4


def test_hidden_names_are_unique_and_fit() -> None:
    names = ["a" * n + "ü" * m for n in (1, 200, 240, 250) for m in (0, 1, 5)]
    hidden = {
        hidden_name(name, ending) for name in names for ending in (".lock", ".unfinished", ".tiles")
    }
    assert len(hidden) == 36
    assert max(len(name.encode()) for name in hidden) <= 255


@pytest.mark.parametrize("error", ["tf", "runtime", "os"])
def test_failures_of_usd_core_are_output_errors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: str
) -> None:
    pxr = pytest.importorskip("pxr")
    from g2ard.io import usd

    def full(*_: Any) -> None:
        if error == "tf":
            pxr.Tf.RaiseRuntimeError("no space left on device")
        raise (
            OSError(28, "No space left on device")
            if error == "os"
            else RuntimeError("no space left")
        )

    monkeypatch.setattr(usd, "_save", full)
    path = tmp_path / "a.usdc"
    with pytest.raises(OutputError, match=r"(?i)no space left") as caught:
        g2ard.save(path, BALL)
    assert caught.value.path == path
    assert not list(tmp_path.iterdir())
