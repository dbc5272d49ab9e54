"""Methods under matched compute: budgets, rounds, the paper's weights, shared checkpoints, adaptation."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.kinds.methods import METHODS
from benchmarks.report import write_report
from benchmarks.rows import Row, read_rows
from benchmarks.runner import run as run_studies
from benchmarks.score import figures, score
from benchmarks.study import Study, read_study
from g2ard import io
from g2ard.rendering.targets import TeacherRenders
from g2ard.scene.splats import Splats
from g2ard.stages.evaluate import evaluate
from g2ard.stages.recover.anchors import PAPER_REGULARIZERS
from g2ard.stages.simplify import round_counts
from helpers.scenes import around, checkered_ball
from helpers.studies import STUDY, check_page, study
from helpers.systems import needs_processes

HEAD = 'title = "Balls"\nratios = [4]\nsteps = [12]\n'
SCENE = '\n[[scene]]\nname = "ball"\nprior = "ball.ply"\ntrain = "views.json"\n'
CITY = """
[[scene]]
name = "city"
synth = { points = 2000, views = 40, size = [48, 36], blocks = 1 }
train = "train.json"
score = { val = "val.json", ood = "ood.json" }
adapt = "adapt.json"
targets = "photos"
train_prior = 4
"""


def jobs(out: Path, kind: str) -> list[dict]:
    found = [json.loads(p.read_text()) for p in out.glob("work/*/stages/*/job.json")]
    return [job for job in found if job["kind"] == kind]


def run(folder: Path, text: str) -> tuple[Study, list[Row], Path]:
    made = read_study(study(folder, text))
    rows = run_studies([made], folder / "out", keep=True)
    assert [row["error"] for row in rows if "error" in row] == []
    return made, rows, folder / "out"


@needs_processes
def test_every_cell_gets_the_same_budget_steps_and_views(tmp_path: Path) -> None:
    made = read_study(study(tmp_path))
    out = tmp_path / "out"
    rows = run_studies([made], out)
    assert [(r["method"], r["matched"]) for r in rows] == [
        (name, kind)
        for name in ("g2ard", "pup", "rounds", "nanogs")
        for kind in ("steps", "seconds")
    ]
    for row in rows:
        assert "error" not in row, row
        assert (row["count"], row["budget"], row["input_count"]) == (300, 300, 1200)
        assert (row["views"], row["against"], row["prior"]) == (2, "teacher", "given")
        assert row["bytes"] == 300 * 4 * (14 + 9)
        assert 5 < row["psnr"] < 60
        assert row["reduce_cpu_s"] > 0
        assert row["recover_peak_mb"] > 20
        if row["matched"] == "steps":
            assert row["steps"] == 9
        else:
            assert row["steps"] > 9
            assert row["seconds"] == pytest.approx(1, abs=0.7)
    assert not (out / "work").exists()  # nothing is left to do
    write_report(out, [made], rows)
    html = (out / "report.html").read_text()
    check_page(html)
    assert html.count('class="dot') >= len(rows)
    assert html.count("<select>") == 2  # both test views


@needs_processes
def test_stages_survive_an_interruption_and_failures_are_rows(tmp_path: Path) -> None:
    text = HEAD + 'methods = ["g2ard", "splat-transform", "random"]\n' + SCENE
    made, out = read_study(study(tmp_path, text)), tmp_path / "out"

    def stop(stage: str, done: int, total: int, info: dict | None = None) -> None:
        if done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_studies([made], out, progress=stop)
    stages = {p: p.stat().st_mtime_ns for p in (out / "work").glob("*/stages/*/usage.json")}
    assert len(stages) == 2
    rows = run_studies([made], out)
    assert {p: p.stat().st_mtime_ns for p in stages} == stages
    assert ["not on PATH" in row.get("error", "") for row in rows] == [False, True, False]
    assert (out / "work").exists()  # kept for another try
    run_studies([made], out, again=True)
    assert all(p.stat().st_mtime_ns > then for p, then in stages.items())
    nowhere = replace(made, scenes=(replace(made.scenes[0], prior="nowhere.ply"),))
    assert all("nowhere.ply" in row["error"] for row in run_studies([nowhere], out))


@needs_processes
def test_a_reduction_that_uses_all_the_time_is_scored_without_recovery(tmp_path: Path) -> None:
    text = STUDY.replace("seconds = [1]", "seconds = [1e-5]").replace("steps = [9]", "")
    _, rows, _ = run(tmp_path, text)
    assert [(row["steps"], row["count"]) for row in rows] == [(0, 300)] * 4
    assert all(row["seconds"] > row["amount"] and row["recover_cpu_s"] == 0 for row in rows)


@needs_processes
def test_a_city_is_made_lifted_trained_and_adapted_and_its_teacher_scored(tmp_path: Path) -> None:
    text = (
        HEAD.replace("[4]", "[4, 8]").replace("12", "4")
        + 'methods = ["g2ard", "lifted", "teacher"]\n'
    )
    text += 'adapt_steps = 3\n[method.lifted]\nprior = "lift"\npolicy = "random"\nk = 0.5\n'
    made, rows, out = run(tmp_path, text + CITY)
    teachers = [row for row in rows if row["method"] == "teacher"]
    others, splits = (
        [row for row in rows if row["method"] != "teacher"],
        ("val", "ood", "adapt-val"),
    )
    assert {(r["ratio"], r["method"], r["prior"], r["split"], r["count"]) for r in others} == {
        (ratio, *method, split, 2000 // ratio)
        for ratio in (4, 8)
        for method in (("g2ard", "trained"), ("lifted", "lift"))
        for split in splits
    }
    assert all(r["against"] == "photos" and r["adapt_cpu_s"] > 0 for r in others)
    selected, whole = (
        next(out.glob("work/*/stages/*/views.json")),
        next(out.glob("work/*/train.json")),
    )
    assert len(io.read_views(selected)) == round(len(io.read_views(whole)) / 2)
    assert [(row["split"], row["matched"], row["ratio"], row["steps"]) for row in teachers] == [
        (split, "none", 1.0, 0) for split in splits
    ]
    assert all(row["count"] == row["input_count"] and "delta_psnr" not in row for row in teachers)
    of = {row["split"]: row["psnr"] for row in teachers}
    for row in others:
        if row["prior"] == teachers[0]["prior"]:
            assert row["delta_psnr"] == pytest.approx(row["psnr"] - of[row["split"]], abs=1e-4)
    assert len(read_rows(out / "rows.csv")) == len(rows)
    elsewhere = {name: value for name, value in others[0].items() if name != "delta_psnr"} | {
        "scene": "moon"
    }
    assert "delta_psnr" not in made.derived([elsewhere, *teachers])[0]


@needs_processes
def test_released_schedules_run_beside_the_matched_ones(tmp_path: Path) -> None:
    text = HEAD.replace("steps = [12]", "released = true")
    text += 'methods = ["light", "pair", "nanogs", "random"]\n'
    text += '[method.light]\nbase = "lightgaussian"\nreleased_steps = 7\n'
    text += '[method.pair]\nbase = "pup"\nreleased_steps = 3\n'
    _, rows, out = run(tmp_path, text + SCENE)
    assert [(r["method"], r["matched"], r["steps"]) for r in rows] == [
        ("light", "released", 7),
        ("pair", "released", 6),  # two rounds
        ("nanogs", "released", 0),
    ]
    assert {job["schedule"] for job in jobs(out, "recover")} == {"3dgs"}
    assert METHODS["lightgaussian"].released_steps == 5000
    assert METHODS["g2ard-paper"].released_schedule == "paper"


def test_legs_are_those_of_the_releases() -> None:
    paper = METHODS["g2ard-paper"].legs(12)
    assert [leg.final for leg in paper] == [False] * 12 + [True]
    assert sum(leg.share for leg in paper) == pytest.approx(1)
    assert paper[0].share == pytest.approx(8 / 126)
    assert paper[-1].share == pytest.approx(30 / 126)
    assert [(leg.round, leg.share) for leg in METHODS["pup"].legs(2)] == [(0, 0.5), (1, 0.5)]
    assert [leg.share for leg in METHODS["g2ard"].legs(1)] == [1]
    shared = replace(METHODS["g2ard-paper"], shared_start=True).legs(3)
    assert [(leg.round, leg.final) for leg in shared] == [(0, False), (1, False), (2, True)]
    assert shared[-1].share == 1


def test_a_given_prior_has_the_weights_of_the_kind_that_its_scene_states(tmp_path: Path) -> None:
    text = (
        HEAD.replace("12", "6")
        + 'methods = ["a"]\n[method.a]\nbase = "g2ard-paper"\nrounds = "one"\n'
    )
    for kind in ("noisy", "trained"):
        (folder := tmp_path / kind).mkdir()
        _, _, out = run(folder, f'{text}{SCENE}regularizers = "{kind}"\n')
        weights = [job["regularizers"] for job in jobs(out, "recover")]
        assert vars(PAPER_REGULARIZERS[kind]) in weights


@needs_processes
def test_policies_continue_from_one_checkpoint(tmp_path: Path) -> None:
    text = HEAD + 'seeds = [0, 1]\nmethods = ["random", "directional", "own"]\n'
    for name, base in (("random", "g2ard-paper"), ("directional", "g2ard-paper"), ("own", "g2ard")):
        policy = "random" if name == "own" else name
        text += (
            f'[method.{name}]\nbase = "{base}"\npolicy = "{policy}"\nk = 0.5\nshared_start = true\n'
        )
    _, rows, out = run(tmp_path, text + SCENE)
    counts = round_counts(1200, 300)
    # once for all rows, and once for g2ard's own
    assert len(jobs(out, "reduce")) == len(counts) + 1
    recoveries = jobs(out, "recover")
    early = [job for job in recoveries if not job["final"]]
    assert len(early) == len(counts) - 1
    assert {(Path(job["views"]).name, job["seed"]) for job in early} == {("train.json", 0)}
    final = [job for job in recoveries if job["final"]]
    assert len(final) == 6
    assert {(job["steps"], Path(job["views"]).name) for job in final} == {(12, "views.json")}
    assert len({row["psnr"] for row in rows}) == 6


def test_scores_are_those_of_evaluate_and_black_renders_are_left_out(tmp_path: Path) -> None:
    ball, views = checkered_ball(400), around(4)
    targets = TeacherRenders(ball, views)
    small = ball.take(slice(0, 200))
    scored = score(small, targets, pictures=tmp_path / "p")
    assert figures(scored)["psnr"] == evaluate(small, targets).psnr
    assert len(list((tmp_path / "p").iterdir())) == 4
    toward = np.asarray(views.positions[0]) / 3.0
    # in the first view alone
    hidden = replace(ball, means=(ball.means - 6 * toward).astype(np.float32))
    scored = score(hidden, targets)
    lit = [view["psnr"] for view in scored if not view["black"]]
    assert 0 < len(lit) < 4
    assert figures(scored)["black"] == 4 - len(lit)
    assert figures(scored)["psnr"] == np.mean(lit)
    nothing = Splats.create([[0, 0, 0]], scales=[[1e-3] * 3], logit_opacities=[-20])
    everywhere = score(nothing, targets)
    assert figures(everywhere)["black"] == 4
    assert figures(everywhere)["psnr"] == np.mean([view["psnr"] for view in everywhere])


@needs_processes
def test_scored_views_are_not_trained_on(tmp_path: Path) -> None:
    views = around(16, size=(48, 36))
    io.write_views(tmp_path / "val.json", views.take(range(4)))
    text = (
        HEAD.replace("12", "4")
        + 'methods = ["random"]\n'
        + SCENE
        + 'score = { val = "val.json" }\n'
    )
    made, (row,), out = run(tmp_path, text)
    assert (row["views"], row["dropped"]) == (4, 4)
    (train,) = out.glob("work/*/train.json")
    assert sorted(io.read_views(train).names) == sorted(views.names[4:])
    write_report(out, [made], [row])
    assert "4 views to train on are scored on" in (out / "report.html").read_text()


@needs_processes
def test_the_last_training_views_may_be_the_new_trajectory(tmp_path: Path) -> None:
    text = HEAD.replace("12", "4") + 'adapt_steps = 3\nmethods = ["random"]\n'
    _, (row,), out = run(tmp_path, text + SCENE + "adapt_last = 5\n")
    (adapt,), (train,) = out.glob("work/*/adapt.json"), out.glob("work/*/train.json")
    adapted, trained = io.read_views(adapt).names, io.read_views(train).names
    assert len(adapted) == 5
    assert min(adapted) > max(trained)
    assert len(adapted) + len(trained) + row["views"] == len(io.read_views(tmp_path / "views.json"))
    none_left = study(tmp_path / "more", text + SCENE + "adapt_last = 14\n")
    (failed,) = run_studies([read_study(none_left)], tmp_path / "none")
    assert "adapt_last: 14 of 14 views leave none to train on" in failed["error"]
