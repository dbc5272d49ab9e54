"""Choice and weights of a distillation's views, and messages about skipped ones."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from g2ard.config.schema import changed
from g2ard.errors import InputError
from g2ard.io import write_splats, write_views
from g2ard.pipeline.config import DistillConfig
from g2ard.pipeline.distill import distill
from g2ard.rendering.targets import TeacherRenders
from g2ard.scene.cameras import Cameras, look_at
from g2ard.scene.splats import ARRAYS
from g2ard.stages.recover.config import TUNED, RecoverConfig
from g2ard.stages.select import select
from g2ard.stages.simplify import SimplifyConfig
from helpers.commands import CommandLine, refused, succeeds
from helpers.scenes import around, checkered_ball

PRIOR = checkered_ball(1500)
SHORT = DistillConfig(simplify=SimplifyConfig(method="paper"), recover=RecoverConfig(steps=20))


def crowded() -> Cameras:
    """12 views around, 20 more in one spot, and one that sees nothing."""
    even = around(12)
    rng = np.random.default_rng(0)
    crowd = [look_at([3, 0, 0.5] + 0.05 * rng.standard_normal(3), [0, 0, 0]) for _ in range(20)]
    poses = [*even.viewmats, *crowd, look_at([30.0, 0, 0], [60, 0, 0])]
    n = len(poses)
    return Cameras.from_lists(
        poses, [even.Ks[0]] * n, [(64, 48)] * n, [f"v{i:02d}" for i in range(n)]
    )


class Watched(TeacherRenders):
    """Targets that remember which views were read."""

    def __init__(self, cameras: Cameras) -> None:
        super().__init__(PRIOR, cameras, lazy=True)
        self.asked: set[int] = set()

    def __getitem__(self, view: int) -> Any:
        self.asked.add(view)
        return super().__getitem__(view)


def test_all_views_are_drawn_by_weight_unless_told_otherwise() -> None:
    targets = TeacherRenders(PRIOR, crowded())
    done = distill(PRIOR, 200, targets, SHORT)
    said = done.report.views
    assert (said.candidates, len(said.chosen), said.refused) == (33, 32, ["v32"])
    assert said.weighted
    assert said.left_out == 0
    plain = distill(PRIOR, 200, targets, changed(SHORT, {"select.weighted": False}))
    assert plain.report.views is None
    assert any(
        not np.array_equal(getattr(done.splats, a), getattr(plain.splats, a)) for a in ARRAYS
    )


def test_only_chosen_views_are_looked_at_and_the_rest_is_accounted_for() -> None:
    targets = Watched(crowded())
    report = distill(PRIOR, 200, targets, changed(SHORT, {"select.views_count": 8})).report
    chosen = select(PRIOR, targets.cameras, 8)
    assert report.views.chosen == [targets.cameras.names[i] for i in chosen.order]
    assert targets.asked == set(chosen.order.tolist())
    assert 0 < report.views.left_out == chosen.left_out < 1
    assert report.seconds.select > 0


def test_given_weights_stand() -> None:
    cameras = around(12)
    targets, weights = Watched(cameras), np.r_[np.zeros(11), 1.0]
    report = distill(PRIOR, 200, targets, SHORT, weights=weights).report
    assert report.views is None
    with pytest.raises(InputError, match="expected 12"):
        distill(PRIOR, 200, targets, SHORT, weights=[1.0])
    with pytest.raises(InputError, match="policy"):
        distill(
            PRIOR, 200, targets, changed(SHORT, {"select.views_count": 3, "select.policy": "best"})
        )


def test_views_are_selected_once_by_default(monkeypatch: pytest.MonkeyPatch) -> None:
    import g2ard.pipeline.distill as stage

    counts: list[int] = []
    whole = stage.select

    def counted(splats: Any, *rest: Any, **options: Any) -> Any:
        counts.append(len(splats))
        return whole(splats, *rest, **options)

    monkeypatch.setattr(stage, "select", counted)
    config = changed(
        SHORT,
        {"select.views_count": 6, "recover.schedule": replace(TUNED, steps=10, round_steps=5)},
    )
    targets = TeacherRenders(PRIOR, crowded())
    distill(PRIOR, 600, targets, config)
    assert counts == [1500]
    counts.clear()
    distill(PRIOR, 600, targets, changed(config, {"select.reselect": True}))
    assert counts == [1500, 1125, 844, 633]


def test_the_command_reports_unchosen_views(command_line: CommandLine, tmp_path: Path) -> None:
    write_splats(tmp_path / "ball.ply", PRIOR)
    write_views(tmp_path / "pool.json", crowded())
    ask = (
        "distill",
        "ball.ply",
        "-n",
        200,
        "--views",
        "pool.json",
        "--method",
        "paper",
        "--steps",
        20,
    )
    out, error = succeeds(
        command_line, tmp_path, *ask, "--set", "views_count=0.25", "-o", "run", "--json", "-"
    )
    report = json.loads(out)
    assert len(report["views"]["chosen"]) == 7  # of 28 that are not held out
    share = f"{100 * report['views']['left_out']:.1f} %"
    assert f"views: 7 of 28 by auto; the rest would have added {share}" in error
    stored = json.loads((tmp_path / "run" / "report.json").read_text())
    assert stored["views"] == report["views"]
    for wrong, words in (("views_count=0.0", "views_count"), ("select.policy=best", "best")):
        assert words in refused(command_line, tmp_path, *ask, "--set", wrong, "-o", "bad")
        assert not (tmp_path / "bad").exists()
