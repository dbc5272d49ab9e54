"""Names of views are labels: renaming views changes no result. Kinds are a field of their own."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import g2ard
from g2ard.io import read_view_set, write_views
from g2ard.io.types import ViewSet
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats
from helpers.commands import CommandLine, succeeds
from helpers.scenes import around, assert_same_bits, checkered_ball

SCENE = checkered_ball(400)
SMALL = g2ard.simplify(SCENE, ratio=5, views=None).splats
VIEWS = around(24, (48, 36))
TEST = np.arange(24) % 8 == 3

WORDS = ("middle", "centre", "near", "far", "standing", "anywhere")
NAMES = {
    "words": tuple(f"{WORDS[i % 6]}_{i:02d}" for i in range(24)),
    "permuted": tuple(VIEWS.names[(7 * i + 5) % 24] for i in range(24)),
}


def _selected(cameras: Cameras) -> Splats:
    chosen = g2ard.select(SCENE, cameras, 9)
    return replace(SCENE.take(chosen.order), logit_opacities=np.float32(chosen.weights))


def _recovered(cameras: Cameras) -> Splats:
    targets = g2ard.TeacherRenders(SCENE, cameras.take(~TEST))
    apart = g2ard.TeacherRenders(SCENE, cameras.take(TEST))
    return g2ard.recover(SMALL, targets, g2ard.RecoverConfig(steps=4), validation=apart).splats


def _distilled(cameras: Cameras) -> Splats:
    return g2ard.distill(SCENE, ratio=8, views=_stated(cameras), steps=4, size=48).splats


def _leveled(cameras: Cameras) -> Splats:
    return g2ard.lod(SCENE, ratios=(4, 8), views=_stated(cameras), steps=4, size=48).splats[-1]


def _stated(cameras: Cameras) -> ViewSet:
    return ViewSet(cameras, splits=tuple(np.where(TEST, "test", "train").tolist()))


@pytest.fixture(scope="module")
def usual() -> dict[Callable[[Cameras], Splats], Splats]:
    return {job: job(VIEWS) for job in (_selected, _recovered, _distilled, _leveled)}


@pytest.mark.parametrize("names", NAMES)
@pytest.mark.parametrize("job", [_selected, _recovered, _distilled, _leveled])
def test_renaming_views_leaves_the_bits(
    job: Callable[[Cameras], Splats], names: str, usual: dict[Callable[[Cameras], Splats], Splats]
) -> None:
    assert_same_bits(job(replace(VIEWS, names=NAMES[names])), usual[job])


def test_kinds_are_stored_with_the_views(tmp_path: Path) -> None:
    kinds = ("usual",) * 20 + ("near",) * 4
    cameras = replace(VIEWS, kinds=kinds)
    write_views(tmp_path / "views.json", cameras)
    found = read_view_set(tmp_path / "views.json").cameras
    assert found.kinds == kinds
    assert found.take(TEST).kinds == Cameras.of(found[i] for i in np.flatnonzero(TEST)).kinds
    assert len(found.usual()) == 20
    write_views(tmp_path / "usual.json", VIEWS)
    assert "kind" not in (tmp_path / "usual.json").read_text()
    with pytest.raises(g2ard.InputError, match="kinds: expected 24, got 3"):
        replace(VIEWS, kinds=("near",) * 3)
    with pytest.warns(UserWarning, match="kinds of 4 views"):
        write_views(tmp_path / "transforms.json", cameras)


def test_scores_state_the_kind_of_a_view(command_line: CommandLine, folder: Path) -> None:
    kinds = ("usual",) * 12 + ("close",) * 4
    write_views(folder / "views.json", replace(around(16, (48, 36)), kinds=kinds), overwrite=True)
    g2ard.save(folder / "small.ply", SMALL)
    out = succeeds(
        command_line, folder, "evaluate", "small.ply", "--views", "views.json", "--teacher", "ball.ply",
        "--split", "all", "--json", "-",
    ).out  # fmt: skip
    assert out.count('"kind": "close"') == 4
