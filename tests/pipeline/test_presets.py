"""`--preset paper` and `preset("paper")` mean the whole paper; anchors are those of construction."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import g2ard
from g2ard.config.schema import changed, listed
from g2ard.errors import InputError
from g2ard.io import read_splats, write_splats, write_views
from g2ard.pipeline.config import SelectConfig
from g2ard.pipeline.distill import distill
from g2ard.pipeline.presets import preset
from g2ard.rendering.targets import TeacherRenders
from g2ard.stages.recover.anchors import PAPER_REGULARIZERS, Anchors, Regularizers, drift95
from g2ard.stages.recover.config import PAPER, RecoverConfig, Schedule
from g2ard.stages.recover.optimize import recover
from g2ard.stages.simplify import simplify
from helpers.commands import CommandLine, refused, succeeds
from helpers.photos import cloud_with_photos
from helpers.scenes import around, checkered_ball, in_units

PRIOR = checkered_ball()
FEW = PAPER.scaled(75)  # 20 steps a round
FREE = Regularizers(0.0, 0.0, effective_rank=False)


@pytest.fixture(scope="module")
def targets() -> TeacherRenders:
    return TeacherRenders(PRIOR, around())


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_splats(tmp_path / "ball.ply", PRIOR)
    write_views(tmp_path / "v.json", around(24), splits=["train"] * 20 + ["test"] * 4)
    return tmp_path


def run(command_line: CommandLine, folder: Path, *arguments: object) -> dict[str, Any]:
    out = succeeds(command_line, folder, *arguments, "-w", "--json", "-").out
    return json.loads(out)


DISTILL = ("distill", "ball.ply", "-r", 3, "--views", "v.json", "-o", "run", "--steps", 75)
SHORT = (*DISTILL, "--steps", 8)


def test_preset_paper_sets_every_stage_of_distill(folder: Path, command_line: CommandLine) -> None:
    out, error = succeeds(command_line, folder, *DISTILL, "--preset", "paper", "-v", "--json", "-")
    report = json.loads(out)
    assert error.count("never acted") == 1  # the regularisers, in rounds this short
    assert (
        "never acted in round 1, round 2, round 3, round 4, the last recovery of round 4" in error
    )
    assert "there were 20 to 75" in error
    whole = preset("paper")
    used = changed(whole, {"recover.schedule": FEW, "recover.steps": 75})
    wanted = listed(replace(used, simplify=whole.simplify.resolved()))
    assert report["settings"] == json.loads(json.dumps(wanted))
    views = report["views"]
    assert (views["policy"], len(views["chosen"]), views["weighted"]) == ("directional", 10, False)
    assert [entry["count"] for entry in report["rounds"]] == [2250, 1688, 1266, 1000]
    taken = [[done["steps"] for done in entry["recover"]] for entry in report["rounds"]]
    assert taken == [[20], [20], [20], [20, 75]]
    assert not any(done["kept_start"] for entry in report["rounds"] for done in entry["recover"])
    assert read_splats(folder / "run" / "scene.ply").sh_degree == 3
    assert (PAPER.steps, PAPER.round_steps) == (30_000, 8_000)


def test_explicit_options_override_the_preset(folder: Path, command_line: CommandLine) -> None:
    (folder / "c.toml").write_text(
        '[distill]\nmethod = "default"\n[distill.set]\npolicy = "auto"\n'
    )
    said = (
        "--config",
        "c.toml",
        "--method",
        "fast",
        "--set",
        "views_count=4",
        "--set",
        "anchor=0.3",
    )
    report = run(command_line, folder, *SHORT, "--preset", "paper", *said, "--set", "sh_degree=1")
    assert (report["views"]["policy"], len(report["views"]["chosen"])) == ("auto", 4)
    settings = report["settings"]
    assert (settings["simplify.method"], settings["recover.schedule.guarded"]) == ("fast", False)
    assert settings["recover.regularizers.anchor"] == 0.3
    assert read_splats(folder / "run" / "scene.ply").sh_degree == 1
    (folder / "c.toml").write_text('[distill]\npreset = "paper-noisy"\n[distill.set]\nperiod = 7\n')
    report = run(command_line, folder, *SHORT, "--config", "c.toml", "--set", "weighted=true")
    settings = report["settings"]
    assert (settings["simplify.method"], report["views"]["weighted"]) == ("paper", True)
    assert settings["recover.regularizers.shape"] == 1e-3
    assert settings["recover.regularizers.period"] == 7


def test_a_point_cloud_gets_the_weights_of_lifts(folder: Path, command_line: CommandLine) -> None:
    cloud_with_photos(folder, PRIOR)
    ask = ("distill", "cloud.ply", "-r", 3, "--views", "views.json", "-o", "run", "--steps", 8)
    report = run(command_line, folder, *ask, "--preset", "paper", "--set", "lift.neighbors=8")
    regularizers = [f"recover.regularizers.{key}" for key in ("anchor", "shape", "effective_rank")]
    assert [report["settings"][path] for path in regularizers] == [1e-3, 1e-4, True]
    assert report["preset"].startswith("the paper's for lift (as requested)")
    assert report["settings"]["lift.neighbors"] == 8


def test_schedule_and_preset_differ_in_recover(folder: Path, command_line: CommandLine) -> None:
    write_views(folder / "w.json", around(24), weights=[1.0] * 24)
    ask = (
        "recover",
        "ball.ply",
        "--views",
        "w.json",
        "--teacher",
        "ball.ply",
        "-o",
        "o.ply",
        "--steps",
        4,
    )
    for option, weighted in (("--schedule", True), ("--preset", False)):
        report = run(command_line, folder, *ask, option, "paper")
        assert read_splats(folder / "o.ply").sh_degree == 3
        error = command_line(*ask, option, "paper", "-w", cwd=folder)[2]
        assert ("views by weight" in error) is weighted
        assert report["settings"]["recover.schedule.guarded"] is False
    run(command_line, folder, *ask, "--preset", "paper", "--sh-degree", 0)
    assert read_splats(folder / "o.ply").sh_degree == 0


def test_the_other_commands_know_it(folder: Path, command_line: CommandLine) -> None:
    (folder / "c.toml").write_text('preset = "paper-lift"\n[recover]\nsteps = 2\n')
    for asked in (("--method", "paper"), ("--preset", "paper"), ("--config", "c.toml")):
        run(
            command_line,
            folder,
            "simplify",
            "ball.ply",
            "-r",
            3,
            "-o",
            f"{asked[0][2:]}.ply",
            *asked,
        )
    made = {(folder / f"{name}.ply").read_bytes() for name in ("method", "preset", "config")}
    assert len(made) == 1
    found = run(
        command_line,
        folder,
        "select",
        "ball.ply",
        "--views",
        "v.json",
        "-o",
        "k.json",
        "--preset",
        "paper",
    )
    assert (found["policy"], len(found["views"])) == ("directional", 10)
    ask = (
        "adapt",
        "ball.ply",
        "--views",
        "v.json",
        "--teacher",
        "ball.ply",
        "-o",
        "o.ply",
        "--steps",
        6,
    )
    done = run(command_line, folder, *ask, "--preset", "paper")
    rates = {**vars(PAPER.rates), **dict.fromkeys(("means", "log_scales", "quats"), 0.0)}
    for name in ("means", "log_scales", "quats", "logit_opacities", "sh0", "shN"):
        assert done["settings"][f"adapt.recovery.rates.{name}"] == rates[name]
    assert (done["steps"], done["settings"]["adapt.schedule"], done["colour_change"]) == (
        6,
        "paper",
        None,
    )


def test_in_python() -> None:
    noisy = g2ard.preset("paper-noisy")
    assert noisy.recover.regularizers == PAPER_REGULARIZERS["noisy"]
    assert g2ard.preset("paper", g2ard.AdaptConfig()).stretches(4) == [7000]
    with pytest.raises(InputError, match="expected"):
        preset("peer")
    with pytest.raises(InputError, match=r"views_count: .* in \(0, 1\]"):
        SelectConfig(views_count=1.5)


def test_anchors_hold_from_construction_to_the_end(targets: TeacherRenders) -> None:
    config = changed(
        preset("paper"),
        {"recover.schedule": FEW, "recover.regularizers": FREE, "select.views_count": None},
    )
    result = distill(PRIOR, 1000, targets, config)
    first, last = result.report.rounds[-1].recover
    anchors = Anchors.of(result.simplified)
    assert last.drift95 == drift95(anchors, result.splats.means)
    # The round's drift is not forgotten.
    assert last.geometry[0].drift95 > 0.5 * first.drift95 > 0.05
    tight = Regularizers(100.0, 0.0, effective_rank=False, period=1)
    held = changed(config, {"recover.regularizers": tight})
    assert distill(PRIOR, 1000, targets, held).report.rounds[-1].recover[-1].drift95 < last.drift95


def test_the_papers_schedule_keeps_losing_steps(targets: TeacherRenders) -> None:
    config = RecoverConfig(schedule=PAPER, steps=30, regularizers=FREE)
    grain = np.random.default_rng(0).normal(0, 1e-3, PRIOR.sh0.shape).astype(np.float32)
    start = replace(PRIOR, sh0=PRIOR.sh0 + grain)  # so near that such steps only lose
    done = recover(start, targets, config, validation=targets)
    assert done.report.psnr.after < done.report.psnr.before
    assert (done.report.kept_start, done.report.blend, done.report.validation) == (False, 1.0, None)
    assert (done.splats.sh0 != start.sh0).any()
    guarded = replace(config, schedule=replace(PAPER, guarded=True))
    assert recover(start, targets, guarded).report.kept_start


def test_the_paper_s_rates_do_not_depend_on_the_unit() -> None:
    student = simplify(PRIOR, 500, method="paper").splats

    def moved(unit: float, schedule: Schedule = PAPER) -> float:
        start, cameras = in_units(student, around(), unit)
        teacher, _ = in_units(PRIOR, around(), unit)
        config = RecoverConfig(schedule=schedule, steps=60, regularizers=FREE)
        done = recover(start, TeacherRenders(teacher, cameras), config).splats
        return float(np.abs(done.means - start.means).mean()) / unit

    assert math.isclose(moved(64.0), moved(1.0), rel_tol=0.02)
    stated = replace(PAPER, reference_extent=None)
    assert moved(64.0, stated) < 0.1 * moved(1.0, stated)
    assert math.isclose(around().extent, 1.1 * 3.0, rel_tol=0.1)
    assert around().take([0]).extent == 0.0
    assert PAPER.within(0.0) == PAPER


def test_a_kept_scene_reproduces_the_drift(folder: Path, command_line: CommandLine) -> None:
    report = run(command_line, folder, *SHORT, "--preset", "paper", "--keep")
    kept = folder / "run" / "simplified" / "scene.ply"
    ask = (
        "evaluate",
        "run/scene.ply",
        "--views",
        "v.json",
        "--teacher",
        "ball.ply",
        "--anchors",
        kept,
    )
    found = run(command_line, folder, *ask)["scenes"][0]["drift95"]
    assert math.isclose(found, report["rounds"][-1]["recover"][-1]["drift95"], rel_tol=1e-4)
    ask = (
        "recover",
        "run/scene.ply",
        "--views",
        "v.json",
        "--teacher",
        "ball.ply",
        "-o",
        "more.ply",
    )
    short = ("--schedule", "paper", "--steps", 2)
    again = run(command_line, folder, *ask, *short, "--anchors", kept)["drift95"]
    assert abs(again - found) < abs(run(command_line, folder, *ask, *short)["drift95"] - found)
    status, _, error = command_line(*ask, *short, "-w", "--anchors", "ball.ply", cwd=folder)
    assert (status, error.splitlines()[-1]) == (
        1,
        "g2ard: ball.ply: has 3,000 Gaussians, the student has 1,000; anchors are the student before any "
        "recovery",
    )
    run(command_line, folder, *SHORT, "--schedule", "fast")
    assert not kept.exists()  # it would not be of this run


VIEWED = ("--views", "v.json", "--teacher", "ball.ply", "-w", "--json", "-")


def test_the_paper_s_adaptation_blends_nothing(folder: Path, command_line: CommandLine) -> None:
    ask = ("adapt", "ball.ply", "-o", "o.ply", "--steps", 2, *VIEWED)
    for paper in (("--preset", "paper"), ("--schedule", "paper")):
        assert "--prior-views" in refused(command_line, folder, *ask, *paper, "--prior-views", 3)
        out = succeeds(command_line, folder, *ask, *paper).out
        assert json.loads(out)["prior_share"] == 0
    assert g2ard.preset("paper", g2ard.AdaptConfig()).prior_views == 0
    out = succeeds(command_line, folder, *ask).out
    assert json.loads(out)["prior_share"] > 0
