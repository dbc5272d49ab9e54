"""Float64 means far from the origin: every stage and writer takes their middle out before float32."""

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import g2ard
from g2ard.rendering.targets import TeacherRenders
from g2ard.scene.splats import Splats, far_middle
from g2ard.stages.recover.config import PAPER
from helpers.scenes import around, checkered_ball

UTM = np.array([500_123.0, 6_600_456.0, 40.0])
BALL = checkered_ball(1500)
VIEWS = around(6, (48, 36))


def far_of(splats: Splats, shift: Any = UTM) -> Splats:
    """The scene with float64 means in map coordinates and no offset."""
    return replace(splats, means=splats.means.astype(np.float64) + shift)


def worlds(splats: Splats) -> Any:
    return splats.means.astype(np.float64) + splats.offset


@pytest.mark.parametrize("shift", [UTM, 1e9 * np.ones(3), [-3e5, 0, 0]])
@pytest.mark.parametrize("unit", [1e-3, 1, 50])
def test_narrowed_means_keep_their_digits(unit: float, shift: Any) -> None:
    far = far_of(replace(BALL, means=BALL.means * np.float32(unit)), shift)
    near = far.narrowed()
    assert near.means.dtype == np.float32
    coarse = np.spacing(np.abs(far.means).max())  # of float64
    np.testing.assert_allclose(worlds(near), far.means, rtol=0, atol=1e-6 * unit + 2 * coarse)
    assert near.narrowed() is near


def test_scenes_around_the_origin_keep_their_offset() -> None:
    plain = replace(BALL, means=BALL.means.astype(np.float64))
    assert not plain.narrowed().offset.any()
    np.testing.assert_array_equal(plain.narrowed().means, BALL.means)
    assert BALL.narrowed() is BALL
    assert not far_middle(np.array([[0.1, 0.2, 0.3]])).any()
    outlier = np.concatenate([BALL.means, [[1e7, 0, 0]]]).astype(np.float64)
    assert not far_middle(outlier).any()


@pytest.mark.parametrize(
    "config",
    [
        g2ard.RecoverConfig(steps=40),
        g2ard.RecoverConfig(steps=40, engine="torch"),
        g2ard.RecoverConfig(schedule=PAPER.scaled(60)),
    ],
)
def test_recovery_in_map_coordinates_is_that_of_the_centred_scene(
    config: g2ard.RecoverConfig,
) -> None:
    student = g2ard.simplify(BALL, ratio=5).splats
    far_views = VIEWS.recentred(-UTM)
    near = g2ard.recover(student, TeacherRenders(BALL, VIEWS), config)
    far = g2ard.recover(far_of(student), TeacherRenders(far_of(BALL), far_views), config)
    assert near.report.psnr.after > near.report.psnr.before + 1
    assert far.report.psnr.after == pytest.approx(near.report.psnr.after, abs=0.01)
    assert far.report.drift95 == pytest.approx(near.report.drift95, rel=0.01)


def test_anchors_in_map_coordinates_are_those_of_the_student() -> None:
    student = g2ard.simplify(BALL, ratio=5).splats
    moved = far_of(student)
    targets = TeacherRenders(far_of(BALL), VIEWS.recentred(-UTM))
    config = g2ard.RecoverConfig(steps=10)
    given = g2ard.recover(moved, targets, config, anchors=moved)
    own = g2ard.recover(moved, targets, config)
    np.testing.assert_array_equal(given.splats.means, own.splats.means)


def test_distillation_and_adaptation_in_map_coordinates() -> None:
    config = g2ard.DistillConfig(recover=g2ard.RecoverConfig(steps=40))
    near = g2ard.distill_against(BALL, 300, TeacherRenders(BALL, VIEWS), config)
    far_targets = TeacherRenders(far_of(BALL), VIEWS.recentred(-UTM))
    far = g2ard.distill_against(far_of(BALL), 300, far_targets, config)
    scores = [
        g2ard.evaluate(done.splats, targets).psnr
        for done, targets in ((near, TeacherRenders(BALL, VIEWS)), (far, far_targets))
    ]
    assert scores[1] == pytest.approx(scores[0], abs=0.05)
    scene = far_of(BALL)
    adapted = g2ard.adapt(scene, far_targets, g2ard.AdaptConfig(steps=5)).splats
    np.testing.assert_array_equal(adapted.means, scene.means)
    np.testing.assert_array_equal(adapted.offset, scene.offset)


FORMATS = ["ply", "compressed.ply", "sog", "spz", "glb", "usda"]


@pytest.mark.parametrize("suffix", FORMATS)
def test_writers_store_map_coordinates_with_an_offset(tmp_path: Path, suffix: str) -> None:
    if suffix == "usda":
        pytest.importorskip("pxr")
    path, far = tmp_path / f"far.{suffix}", far_of(BALL)
    with warnings.catch_warnings(record=True):
        warnings.simplefilter("always")
        g2ard.save(path, far)
    again = g2ard.load(path)
    assert again.offset.any()
    rows = np.lexsort(np.round(worlds(again) - UTM, 2).T), np.lexsort(np.round(BALL.means, 2).T)
    found, wanted = (worlds(again) - UTM)[rows[0]], BALL.means[rows[1]]
    lossy = suffix in ("sog", "compressed.ply", "spz")
    assert np.abs(np.sort(found, axis=0) - np.sort(wanted, axis=0)).max() < (
        0.02 if lossy else 1e-5
    )


@pytest.mark.parametrize("suffix", ["ply", "compressed.ply", "sog", "glb", "splat"])
def test_writers_say_how_far_they_round(tmp_path: Path, suffix: str) -> None:
    """Two clusters 20 km apart, which no offset brings near, and Gaussians of a few millimetres."""
    rng = np.random.default_rng(0)
    means = rng.normal(size=(600, 3)) + np.where(np.arange(600)[:, None] % 2, 2e4, 0)
    scene = Splats.create(means, scales=np.full((600, 3), 0.003))
    path = tmp_path / f"wide.{suffix}"
    with pytest.warns(UserWarning, match=r"rounded by up to") as said:
        g2ard.save(path, scene)
    text = str(said[0].message)
    assert text.startswith(str(path))
    error = float(text.split("rounded by up to ")[1].split()[0])
    found = worlds(g2ard.load(path))
    true = max(np.abs(found[:, None, 0] - means[None, :, 0]).min(1).max(), 1e-9)
    assert true <= 1.05 * error  # the nearest coordinate may be another Gaussian's
    assert error < 100


@pytest.mark.parametrize("suffix", ["ply", "glb", "usda", "spz"])
def test_writers_say_nothing_about_invisible_rounding(tmp_path: Path, suffix: str) -> None:
    plain = replace(BALL, means=BALL.means.astype(np.float64))
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        g2ard.save(tmp_path / f"a.{suffix}", plain)


def test_writers_tell_every_rounding_of_far_scenes(tmp_path: Path) -> None:
    """Coordinates of a map in float64, moved to fit float32, which still rounds what is finer."""
    fine = np.random.default_rng(0).normal(scale=1e-8, size=BALL.means.shape)
    far = far_of(replace(BALL, means=BALL.means + fine))
    for suffix in ("ply", "glb", "usda", "sog", "compressed.ply"):
        with pytest.warns(UserWarning, match="rounded by up to") as said:
            g2ard.save(tmp_path / f"far.{suffix}", far)
        assert len(said) == 1


@pytest.mark.parametrize("kind", ["sog", "3dtiles"])
def test_levels_of_map_coordinates_stand_where_they_belong(tmp_path: Path, kind: str) -> None:
    """They get one offset, whatever their files would choose, and one warning names the rounding."""
    fine = np.random.default_rng(0).normal(scale=1e-8, size=BALL.means.shape)
    far = far_of(replace(BALL, means=BALL.means + fine))
    levels = [far, far.take(slice(0, 40)), far.take(slice(40, 60))]
    near = [level.narrowed(levels[0].narrowed().offset) for level in levels]

    def write(folder: Path, levels: list[Splats], say: Any = None) -> None:
        if kind == "sog":
            g2ard.save_levels(folder, levels, say=say)
        else:
            g2ard.save_tileset(folder, levels, up=(0, 0, 1), place="EPSG:32635", say=say)

    with pytest.warns(UserWarning, match="rounded by up to") as said:
        write(tmp_path / "far", levels)
    assert len(said) == 1
    assert said[0].filename == __file__
    lines: list[str] = []
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        write(tmp_path / "told", levels, lines.append)
        write(tmp_path / "near", near)
    assert [line for line in lines if "rounded by up to" in line] == [
        f"note: {said[0].message}".replace("far", "told")
    ]
    names = [
        path.relative_to(tmp_path / "near")
        for path in (tmp_path / "near").rglob("*")
        if path.is_file()
    ]
    for name in names:
        assert (tmp_path / "far" / name).read_bytes() == (tmp_path / "near" / name).read_bytes()


def test_levels_say_what_can_be_visible(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    means = rng.normal(size=(600, 3)) + np.where(np.arange(600)[:, None] % 2, 2e4, 0)
    wide = Splats.create(means.astype(np.float32), scales=np.full((600, 3), 0.003))
    with pytest.warns(UserWarning, match="rounded by up to"):
        g2ard.save_levels(tmp_path / "wide", [wide])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        g2ard.save_levels(tmp_path / "ball", [BALL])
