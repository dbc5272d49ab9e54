"""Views generated where none are given."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from g2ard.io import write_views
from g2ard.io.types import ViewSet
from g2ard.jobs.distill_options import DistillOptions
from g2ard.jobs.run_views import _double_size, choose_views
from g2ard.pipeline.dense import InMemory
from g2ard.pipeline.distill import RunViews, choose_draw_weights
from g2ard.poses import plan_pool
from g2ard.rendering.visibility import visibility_source
from g2ard.scene.cameras import Cameras, rows_by_kind
from helpers.commands import CommandLine, refused, succeeds
from helpers.scenes import around
from reference import poses as naive


def test_views_are_made_where_none_are_given(command_line: CommandLine, folder: Path) -> None:
    ask = ("render", "ball.ply", "--size", 64)
    error = succeeds(command_line, folder, *ask, "-k", 4, "--sheet", "a/look.png").err
    assert "4 images in a/look.png" in error
    with Image.open(folder / "a" / "look.png") as picture:
        assert picture.width > 128
    assert not (folder / "renders").exists()
    assert (
        "1 image in renders"
        in succeeds(
            command_line, folder, "render", "ball.ply", "-k", 1, "-o", "renders", "--size", 32
        ).err
    )
    assert len(list((folder / "renders").iterdir())) == 1
    command_line("simplify", "ball.ply", "-r", 5, "-o", "small.ply", cwd=folder)
    given = ("--teacher", "ball.ply", "--size", 48)
    out = succeeds(command_line, folder, "evaluate", "small.ply", *given, "--json", "-").out
    before = json.loads(out)["scenes"][0]
    ask = ("recover", "small.ply", *given, "--steps", 60, "-o", "better.ply")
    succeeds(command_line, folder, *ask)
    out = command_line("evaluate", "better.ply", *given, "--json", "-", cwd=folder)[1]
    after = json.loads(out)["scenes"][0]
    assert len(before["views"]) == 16
    assert after["psnr"] > before["psnr"] + 1
    for command in (("evaluate", "small.ply"), ("recover", "small.ply", "-o", "x.ply")):
        assert "--views, or a --teacher" in refused(command_line, folder, *command)


@pytest.mark.parametrize(
    ("make", "focus", "kinds"),
    [
        (naive.room, None, {"usual", "near", "standing", "anywhere"}),
        (naive.room, "far", {"usual"}),
        (naive.room, "standing", {"usual", "standing"}),
        (naive.statue, None, {"usual", "near", "standing", "anywhere"}),
        (naive.statue, "near", {"usual", "near"}),
        (naive.statue, "anywhere", {"usual", "anywhere"}),
    ],
)
def test_views_of_other_kinds_join_the_usual_ones(make, focus: str | None, kinds: set[str]) -> None:
    scene = make()
    options = DistillOptions(views="made", settings={"focus": focus, "schedule": "best"})
    views = choose_views(InMemory(scene), options, len(scene) // 10)
    rows = rows_by_kind(views.train.cameras.kinds)
    assert set(rows) <= kinds
    assert len(rows["usual"]) == (224 if make is naive.room else 112)
    share = {kind: len(found) / len(views.train.cameras) for kind, found in rows.items()}
    if focus is None:
        assert len(rows) >= 2
        assert share["usual"] >= 0.5
        assert views.unseen is not None
        assert views.unseen < 0.01
    elif focus != "far":
        assert share[focus] == pytest.approx(0.5, abs=0.02)
    assert (views.train.cameras.widths == 800).all()
    assert set(views.test.kinds) == {"usual"}
    assert views.apart is not None
    assert set(views.apart.kinds) >= {"near"} | set(rows) - {"usual"}
    assert not set(views.apart.names) & set(views.train.cameras.names)
    assert views.pool is not None
    assert len(views.pool.cameras) == len(views.train.cameras) + len(views.test)


@pytest.mark.parametrize("focus", ["far", "near", "standing", "anywhere"])
def test_runs_with_a_focus_are_scored_in_the_views_of_others(focus: str) -> None:
    """So their scores can be compared, and none of the views trains the other run."""
    statue = naive.statue()
    plain, focused = (
        choose_views(
            InMemory(statue),
            DistillOptions(views="made", settings={"focus": kind, "steps": 1400}),
            300,
        )
        for kind in (None, focus)
    )
    np.testing.assert_array_equal(focused.test.viewmats, plain.test.viewmats)
    assert focused.apart is not None
    assert plain.apart is not None
    for kind, rows in rows_by_kind(focused.apart.kinds).items():
        same = rows_by_kind(plain.apart.kinds)[kind]
        np.testing.assert_array_equal(focused.apart.viewmats[rows], plain.apart.viewmats[same])
    scored, trained = (
        {tuple(pose) for pose in cameras.viewmats.round(9).reshape(-1, 16)}
        for cameras in (focused.apart, focused.train.cameras)
    )
    assert not scored & trained


def test_views_of_other_kinds_weigh_a_twentieth_in_simplification() -> None:
    statue = naive.statue()
    pool = plan_pool(statue, 16)
    others = [*pool.more("anywhere", 8), *pool.more("near", 4)]
    usual, other, mixed = (
        visibility_source(Cameras.of(views))(statue)
        for views in (pool.cameras, others, [*others, *pool.cameras])
    )
    weight = usual.weight + 0.05 * len(pool.cameras) / len(others) * other.weight
    np.testing.assert_allclose(mixed.weight, weight, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(mixed.pixel_size, usual.pixel_size)


def test_given_views_stay_first(tmp_path: Path) -> None:
    statue = naive.statue()
    write_views(tmp_path / "views.json", plan_pool(statue, 16).cameras)
    views = [
        choose_views(
            InMemory(statue), DistillOptions(views=tmp_path / "views.json", settings=settings), 500
        )
        for settings in ({"focus": "far"}, {"focus": "anywhere", "focus_share": 0.25})
    ]
    plain, mixed = (found.train.cameras for found in views)
    assert mixed.names[: len(plain)] == plain.names
    assert set(mixed.kinds[len(plain) :]) == {"anywhere"}
    assert len(mixed) - len(plain) == round(len(plain) / 3)


@pytest.mark.parametrize("focus", [None, "near", "standing", "anywhere"])
@pytest.mark.parametrize("crowded", [0, 31])
def test_crowded_views_have_their_weights_whatever_joins(crowded: int, focus: str | None) -> None:
    """Among views of other kinds, the others are drawn as often relative to each other as alone."""
    room, rng = naive.room(), np.random.default_rng(0)
    pool = plan_pool(room, 12).cameras

    def moved(viewmat: np.ndarray) -> np.ndarray:
        return viewmat + np.pad(rng.normal(0, 1e-3, (3, 1)), ((0, 1), (3, 0)))

    crowd = [
        replace(pool[0], viewmat=moved(pool[0].viewmat), name=f"crowd_{row}")
        for row in range(crowded)
    ]
    given = Cameras.of([*pool, *crowd])

    def found(focus: str | None, **settings: object) -> ViewSet:
        views = ViewSet(given, splits=("train",) * (len(given) - 1) + ("test",))
        return choose_views(
            InMemory(room), DistillOptions(views=views, settings={"focus": focus, **settings}), 300
        ).train

    alone, mixed = found("far"), found(focus)
    usual = len(alone.cameras)
    assert len(mixed.cameras) > usual or focus is None
    expected = choose_draw_weights(room, alone, DistillOptions().config)
    assert expected is not None
    own = mixed.weights if mixed.weights is not None else expected
    np.testing.assert_allclose(own[:usual], expected / expected.mean(), rtol=1e-9)
    np.testing.assert_array_equal(own[usual:], 1.0)
    if crowded:
        assert own[12:usual].sum() < 0.3 * own[:usual].sum()
    even = found(focus, **{"select.weighted": False})
    assert even.weights is None or np.ptp(even.weights) == 0


def test_runs_of_few_steps_use_few_views() -> None:
    """Fewer views are a subset of more, those that are scored too."""
    scene = naive.statue()

    def made(**recover: object) -> RunViews:
        return choose_views(
            InMemory(scene), DistillOptions(views="made", settings=recover), len(scene) // 10
        )

    whole, fast, few = made(schedule="best"), made(schedule="fast"), made(steps=20)
    counts = [len(views.train.cameras) for views in (whole, fast, few)]
    assert counts[0] > 2 * counts[1] > 2 * counts[2] > 20
    usual = [
        {tuple(place) for place in views.train.cameras.usual().positions.round(9)}
        for views in (whole, fast, few)
    ]
    assert len(usual[2] & usual[1]) > 0.6 * len(usual[2])  # a zoom stands where its view stood
    assert [len(views.test) for views in (whole, fast, few)] == [16, 6, 6]
    assert [len(views.apart or ()) for views in (whole, fast, few)] == [24, 12, 12]
    assert [len(views.validation or ()) for views in (whole, fast, few)] == [24, 12, 12]


def test_a_few_views_are_scored_at_twice_their_size(
    command_line: CommandLine, folder: Path
) -> None:
    ask = ("distill", "ball.ply", "-r", 4, "--steps", 20, "--size", 64, "-o", "run", "--no-page")
    told = json.loads(succeeds(command_line, folder, *ask, "--json", "-").out)
    kinds = {row["kind"]: row["views"] for row in told["kinds"]}
    assert kinds["usual at 2×"] == 2


@pytest.mark.parametrize(("side", "some"), [(1200, True), (1201, False)])
def test_very_large_views_are_not_scored_at_twice_their_size(side: int, some: bool) -> None:
    """Twice 1,200 pixels is the most: a score of larger ones would take longer than the run."""
    found = _double_size(around(9, (side, 40)), 3)
    assert (found is not None) == some
    if found is not None:
        assert {*found.widths.tolist()} == {2 * side}
        assert {*found.kinds} == {"usual at 2×"}
