"""The pipeline: exact budgets, one shot and rounds, resumable; and its command as a user types it."""

import json
import re
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

import g2ard
from g2ard.config.schema import changed
from g2ard.io import read_splats, write_splats
from g2ard.jobs.budget import Budget
from g2ard.jobs.distill import prepare
from g2ard.jobs.distill_options import DistillOptions
from g2ard.pipeline.config import DistillConfig, SelectConfig
from g2ard.pipeline.distill import distill
from g2ard.rendering.targets import Targets, TeacherRenders
from g2ard.stages.recover.config import PAPER, TUNED, RecoverConfig
from g2ard.stages.simplify import SimplifyConfig
from helpers.cloud_files import las
from helpers.commands import CommandLine, refused, succeeds
from helpers.photos import cloud_with_photos, photographed, photos_of
from helpers.scenes import around, assert_same_bits, checkered_ball

PRIOR = checkered_ball()
ROUNDS = replace(TUNED, steps=20, round_steps=10)
PAPER_ROUNDS = DistillConfig(
    SelectConfig(), SimplifyConfig(method="paper"), RecoverConfig(schedule=ROUNDS)
)


@pytest.fixture(scope="module")
def targets() -> TeacherRenders:
    return TeacherRenders(PRIOR, around())


def test_views_of_another_kind_are_handed_on(targets: TeacherRenders, tmp_path: Path) -> None:
    near = TeacherRenders(PRIOR, around(4, (64, 48), 2.0))
    config = DistillConfig(recover=RecoverConfig(steps=20))
    done = distill(PRIOR, 300, targets, config, validation=near, work=tmp_path)
    assert done.report.rounds[0].recover[0].validation.looks
    assert (
        not distill(PRIOR, 300, targets, config, work=tmp_path)
        .report.rounds[0]
        .recover[0]
        .validation
    )


def test_one_step_per_round_makes_rounds(targets: TeacherRenders) -> None:
    rounds = changed(PAPER_ROUNDS, {"recover.schedule.round_steps": 1, "recover.schedule.steps": 2})
    assert len(distill(PRIOR, 1000, targets, rounds).report.rounds) == 4


def test_only_steps_of_a_changed_setting_or_a_damaged_file_are_repeated(
    targets: TeacherRenders, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = DistillConfig(recover=RecoverConfig(steps=20))
    first = distill(PRIOR, 300, targets, config, work=tmp_path)
    monkeypatch.setattr("g2ard.pipeline.dense.simplify", None)
    again = distill(PRIOR, 300, targets, changed(config, {"recover.steps": 9}), work=tmp_path)
    assert again.report.rounds[0].simplify == first.report.rounds[0].simplify
    assert again.report.rounds[0].recover[0].steps == 9
    monkeypatch.setattr("g2ard.pipeline.steps.recover", None)
    assert_same_bits(distill(PRIOR, 300, targets, config, work=tmp_path).splats, first.splats)
    for path in tmp_path.iterdir():
        path.write_bytes(b"PK")
    monkeypatch.undo()
    assert_same_bits(distill(PRIOR, 300, targets, config, work=tmp_path).splats, first.splats)


def test_command_on_a_trained_scene(command_line: CommandLine, tmp_path: Path) -> None:
    write_splats(tmp_path / "ball.ply", PRIOR)
    ask = (
        "distill",
        "ball.ply",
        "-r",
        10,
        "-o",
        "run",
        "--steps",
        60,
        "--method",
        "paper",
        "--size",
        100,
    )
    ask = (*ask, "--json", "-")
    out, error = succeeds(command_line, tmp_path, *ask)
    report = json.loads(out)
    assert report["output_count"] == len(read_splats(tmp_path / "run" / "scene.ply")) == 300
    assert report["scores"]["recovered"]["psnr"] > report["scores"]["simplified"]["psnr"]
    assert report["against"] == "the dense scene"
    apart = report["apart"]
    assert "near" in {view["kind"] for view in apart["recovered"]["views"]}
    assert not {view["name"] for view in report["scores"]["recovered"]["views"]} & {
        view["name"] for view in apart["recovered"]["views"]
    }
    assert 0 <= report["unseen"] < 0.5
    assert all(line.startswith("warning: ") and line in error for line in report["warnings"])
    assert [row["kind"] for row in report["kinds"]][:2] == ["usual", "near"]
    near = (view for view in apart["recovered"]["views"] if view["kind"] == "near")
    worst = min(near, key=lambda view: view["psnr"])
    assert (report["kinds"][1]["worst"], report["kinds"][1]["worst_psnr"]["after"]) == (
        worst["name"],
        worst["psnr"],
    )
    assert re.search(r"│ near +│", error)
    assert max(len(line) for line in error.splitlines() if "│" in line) <= 80
    for kind in report["kinds"]:
        assert 0 < kind["detail"]["before"] <= kind["detail"]["after"] <= 1
        assert f"{kind['detail']['before']:.2f} → {kind['detail']['after']:.2f}" in error
    left = sorted(p.name for p in (tmp_path / "run").iterdir())
    assert left == [
        *(
            "preview.png",
            "report.html",
            "report.json",
            "scene.ply",
            "scored.json",
            "view.html",
            "views.json",
        )
    ]
    assert report["bytes"]["view"] == (tmp_path / "run" / "view.html").stat().st_size
    assert "view: run/view.html" in error
    status, _, error = command_line(*ask, cwd=tmp_path)
    assert status == 1
    assert "run" in error
    assert "-w" in error


def test_a_loss_in_any_kind_of_view_is_reported() -> None:
    from g2ard.report.run import RunReport, describe_loss, list_remarks, summarize_by_kind
    from g2ard.stages.evaluate import ViewScore

    def said(
        usual: float, near: float | None, unseen: float | None, ssim: float = 0.0
    ) -> list[str]:
        before, after = [], []
        for kind, gain in (("usual", usual), ("near", near)):
            for i, share in enumerate((2.5, -0.5) if gain is not None else ()):
                view = ViewScore(30.0, 0.9, name=f"{kind}_{i}", kind=kind)
                before.append(view)
                after.append(replace(view, psnr=30.0 + share * gain, ssim=0.9 + ssim))
        found = {"rounds": (), "kinds": summarize_by_kind(before, after), "unseen": unseen}
        return list_remarks(
            RunReport(**{field.name: found.get(field.name) for field in fields(RunReport)})
        )

    assert said(1.0, None, None) == [
        "1 of 2 usual views lost PSNR; the mean of all 2 gained 1.00 dB"
    ]
    assert said(0.02, 0.02, 0.0) == []
    line = said(0.02, -0.5, 0.0)[0]
    assert line.startswith(
        "warning: recovery lost 0.50 dB in near views (worst view near_0: 30.00 → 28.75"
    )
    mixed = said(0.3, 0.3, 0.0, ssim=-0.004)[0]
    assert mixed == "recovery lost 0.004 SSIM and gained 0.30 dB in usual views"
    assert said(0.0, None, 0.0, ssim=-0.004)[0].startswith("warning: recovery lost 0.004 SSIM")
    before = [ViewScore(15.0, name="a"), ViewScore(30.0, name="b")]
    after = [ViewScore(15.5, name="a"), ViewScore(29.0, name="b")]
    line = describe_loss(summarize_by_kind(before, after)[0], "")
    # the worst view gained
    assert "recovery lost 0.25 dB in usual views (1 of 2 views lost PSNR)" in line
    lines = said(-0.2, -0.3, 0.25)
    assert "lost 0.20 dB in usual views" in lines[0]
    assert "25% of the scene is in no view" in lines[2]


def test_steps_by_need_are_for_teachers() -> None:
    from g2ard.pipeline.distill import _configure_recovery

    # a sixteenth of the ball in each
    part = replace(around(12), Ks=around(12).Ks * [[[4], [4], [1]]])

    def horizon(targets: Targets, config: DistillConfig) -> int | None:
        return _configure_recovery(
            config.recover, PRIOR, targets.cameras, 1, of_photos=False, final=True
        ).steps

    teacher, config = (
        TeacherRenders(PRIOR, part, lazy=True),
        DistillConfig(recover=RecoverConfig(schedule=TUNED)),
    )
    assert horizon(teacher, config) > 1.2 * TUNED.steps
    assert horizon(TeacherRenders(PRIOR, around(12), lazy=True), config) < TUNED.steps
    mixed = replace(around(40), kinds=("usual", "usual", *["near"] * 38))
    assert horizon(TeacherRenders(PRIOR, mixed, lazy=True), config) == 2.4 * TUNED.steps
    assert horizon(teacher, changed(config, {"recover.steps": 7})) == 7
    assert horizon(teacher, changed(config, {"recover.schedule": PAPER})) == PAPER.steps


def test_command_on_a_cloud_with_photos(command_line: CommandLine, tmp_path: Path) -> None:
    cloud_with_photos(tmp_path, PRIOR)
    ask = ("distill", "cloud.ply", "-n", 400, "-o", "run", "--steps", 80, "--json", "-")
    out = succeeds(command_line, tmp_path, *ask, "--views", "views.json").out
    report = json.loads(out)
    assert report["against"] == "photos"
    assert report["apart"] is None  # photos are only where they were taken
    assert 0 <= report["unseen"] < 0.05
    simplified, recovered = (
        report["scores"][stage]["psnr"] for stage in ("simplified", "recovered")
    )
    assert simplified > 20.5
    assert recovered > max(21.5, simplified)
    result = read_splats(tmp_path / "run" / "scene.ply")
    assert (len(result), result.sh_degree) == (400, 3)


def test_a_scanned_cloud_and_photos_are_distilled(
    command_line: CommandLine, tmp_path: Path
) -> None:
    """Positions of a million metres, one offset, photos in the same coordinates."""
    place, colors = (
        np.array([443_000.0, 4_428_000.0, 1600.0]),
        np.uint16(65535 * PRIOR.colors.clip(0, 1)),
    )
    points = PRIOR.means + place
    for name in ("a.las", "b.LAZ"):
        las(tmp_path / name, points, colors)
        np.testing.assert_allclose(g2ard.load_points(tmp_path / name).positions, points, atol=6e-4)
    views = around(16, (32, 24)).recentred(-place)
    g2ard.save_views(
        tmp_path / "views.json", photographed(tmp_path, replace(PRIOR, offset=place), views)
    )
    ask = (
        "distill",
        name,
        "--views",
        "views.json",
        "-n",
        400,
        "-o",
        "run",
        "--steps",
        3,
        "--no-page",
    )
    assert " → 400 Gaussians; 14 training views" in succeeds(command_line, tmp_path, *ask).err
    np.testing.assert_allclose(g2ard.load(tmp_path / "run" / "scene.ply").offset, place, rtol=1e-4)
    las(tmp_path / "plain.las", PRIOR.means, None)
    error = refused(command_line, tmp_path, "lift", "plain.las", "-o", "p.ply", status=1)
    assert (
        "has no colours ('red', 'green', 'blue'), and intensities are equal; add colours" in error
    )


@pytest.mark.parametrize(("ratio", "measured"), [(1.0, False), (10.0, True)])
def test_no_coverage_is_measured_where_nothing_is_learned(ratio: float, measured: bool) -> None:
    stages: set[str] = set()
    options = DistillOptions(progress=lambda stage, *_: stages.add(stage))
    prepare(PRIOR, Budget(ratio=ratio), options)
    assert ("coverage" in stages) == measured


def test_a_scene_that_fits_is_written_as_it_is(command_line: CommandLine, tmp_path: Path) -> None:
    """Nothing is merged or recovered, unless photos or a smaller SH degree ask for it."""
    g2ard.save(tmp_path / "scene.ply", PRIOR)
    ask = ("distill", "scene.ply", "-n", len(PRIOR), "--size", 32, "--steps", 4, "--no-page", "-w")
    ask = (*ask, "--focus", "far", "--json", "-")
    out, error = succeeds(command_line, tmp_path, *ask, "-o", "run")
    assert "nothing to simplify" in error
    assert "recovery skipped" in error
    assert "teacher:" not in error
    assert json.loads(out)["rounds"][0]["recover"][0]["steps"] == 0
    made = read_splats(tmp_path / "run" / "scene.ply")
    rows = np.lexsort(made.means.T), np.lexsort(PRIOR.means.T)
    np.testing.assert_array_equal(made.means[rows[0]], PRIOR.means[rows[1]])
    assert json.loads(succeeds(command_line, tmp_path, *ask, "--dry-run").out)["steps"] == 0
    photos_of(tmp_path / "photos", scene=checkered_ball(1200), count=8)
    for more in (("--views", "photos", "--photos"), ("--set", "recover.sh_degree=0")):
        error = succeeds(command_line, tmp_path, *ask, *more, "-o", "run").err
        assert "recovery skipped" not in error
