"""Methods compared under matched compute: rows, budgets, resuming, failures, the report."""

from __future__ import annotations

import json
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from benchmarks.definition import METHODS, read_definition
from benchmarks.report import write_report
from benchmarks.run import bench_run
from benchmarks.run_rows import read_rows
from benchmarks.score import Scored, ViewFigures, luma
from g2ard import io
from g2ard.errors import InputError
from g2ard.report.charts import Point, chart, pareto
from g2ard.report.page import Comparison, Page, Shown
from g2ard.scene.targets import TeacherRenders
from helpers.commands import CommandLine
from helpers.project import ROOT
from helpers.scenes import around, checkered_ball
from helpers.studies import STUDY, check_page, study
from helpers.systems import needs_processes


@needs_processes
def test_every_cell_gets_the_same_budget_steps_and_views(tmp_path: Path) -> None:
    definition = read_definition(study(tmp_path))
    out = tmp_path / "out"
    rows = bench_run([definition], out)
    assert [(r.method, r.matched) for r in rows] == [
        (name, kind) for name in ("g2ard", "pup", "rounds", "nanogs") for kind in ("steps", "seconds")
    ]
    for row in rows:
        assert row.error == "", row
        assert (row.count, row.budget, row.input_count) == (300, 300, 1200)
        assert (row.views, row.against, row.prior) == (2, "teacher", "given")
        assert row.bytes == 300 * 4 * (14 + 9)
        assert 5 < row.psnr < 60
        assert row.reduce_cpu_s > 0
        assert row.recover_peak_mb > 20
        if row.matched == "steps":
            assert row.steps == 9
        else:
            assert row.steps > 9
            assert row.seconds == pytest.approx(3, abs=0.7)
    assert [r.submethod for r in read_rows(out / "rows.csv")] == [r.submethod for r in rows]
    head = (out / "rows.csv").read_text().splitlines()[0].split(",")
    assert {"Submethod", "PSNR", "SSIM", "LPIPS", "Size [Bytes]", "#Gaussians"} <= set(head)
    assert not (out / "work").exists()  # nothing is left to do

    before = {p.name: p.stat().st_mtime_ns for p in (out / "cells").iterdir()}
    assert bench_run([definition], out) == rows  # nothing was measured twice
    assert {p.name: p.stat().st_mtime_ns for p in (out / "cells").iterdir()} == before

    write_report(out, [definition], rows)
    html = (out / "report.html").read_text()
    check_page(html)
    assert html.count('class="dot') >= len(rows)
    assert html.count("<select>") == 2  # both test views


def test_the_page_works_in_a_browser(tmp_path: Path) -> None:
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no chromium on PATH")
    page = Page("A page")
    target = np.zeros((30, 40, 3), np.uint8)
    shown = [Shown(name, np.full_like(target, shade), "9 dB") for name, shade in (("one", 90), ("two", 200))]
    page.comparison(Comparison("a view", target, shown))
    page.write(tmp_path / "page.html")
    options = ["--headless=new", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=2000", "--dump-dom"]
    dom = subprocess.run(
        [browser, *options, (tmp_path / "page.html").as_uri()], capture_output=True, text=True, timeout=120
    ).stdout
    assert '<span class="tag right">one 9 dB</span>' in dom  # the script has run
    assert dom.count('src="data:image/jpeg;base64,') == 8  # a pair and two crops of three


@needs_processes
def test_stages_survive_an_interruption_and_failures_are_rows(tmp_path: Path) -> None:
    text = STUDY.replace('"pup", "rounds", "nanogs"', '"splat-transform", "random"')
    text = text.replace("seconds = [3]", "")
    definition = read_definition(study(tmp_path, text))
    out = tmp_path / "out"

    def stop(stage: str, done: int, total: int, info: dict | None = None) -> None:
        if done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        bench_run([definition], out, progress=stop)
    (first,) = read_rows(out / "rows.csv")
    assert first.method == "g2ard"
    stages = {p: p.stat().st_mtime_ns for p in (out / "work").glob("*/stages/*/usage.json")}
    assert len(stages) == 2

    rows = bench_run([definition], out)
    assert {p: p.stat().st_mtime_ns for p in stages} == stages
    assert "not on PATH" in rows[1].error
    assert rows[1].psnr is None
    assert rows[2].error == ""
    assert (out / "work").exists()  # kept for another try
    assert read_rows(out / "rows.csv")[1].error == rows[1].error
    write_report(out, [definition], rows)
    assert "Failed: ball 4× splat-transform" in (out / "report.html").read_text()


@needs_processes
def test_a_missing_scene_is_an_error_of_its_cells(tmp_path: Path) -> None:
    text = STUDY.replace("ball.ply", "nowhere.ply")
    rows = bench_run([read_definition(study(tmp_path, text))], tmp_path / "out")
    assert len(rows) == 8
    assert all("nowhere.ply" in row.error for row in rows)


@needs_processes
def test_reduction_that_takes_all_the_time_is_scored_without_recovery(tmp_path: Path) -> None:
    text = STUDY.replace("seconds = [3]", "seconds = [1e-5]").replace("steps = [9]", "")
    rows = bench_run([read_definition(study(tmp_path, text))], tmp_path / "out")
    assert [(row.error, row.steps, row.count) for row in rows] == [("", 0, 300)] * 4
    assert all(row.seconds > row.amount and row.recover_cpu_s == 0 for row in rows)


@needs_processes
def test_a_city_is_made_lifted_trained_and_adapted(tmp_path: Path) -> None:
    path = tmp_path / "city.toml"
    path.write_text("""
        ratios = [5]
        steps = [5]
        adapt_steps = 4
        methods = ["g2ard", "lifted"]
        [method.lifted]
        prior = "lift"
        policy = "random"
        k = 0.5
        [[scene]]
        name = "city"
        synth = { points = 3000, views = 40, size = [48, 36], blocks = 1 }
        train = "train.json"
        score = { val = "val.json", ood = "ood.json" }
        adapt = "adapt.json"
        targets = "photos"
        train_prior = 5
        background = [0.6, 0.8, 1.0]
    """)
    rows = bench_run([read_definition(path)], tmp_path / "out", keep=True)
    assert [(r.method, r.prior, r.split, r.error) for r in rows] == [
        (method, prior, split, "")
        for method, prior in (("g2ard", "trained"), ("lifted", "lift"))
        for split in ("val", "ood", "adapt-val")
    ]
    assert all(r.against == "photos" and r.adapt_cpu_s > 0 and r.count == 600 for r in rows)
    selected = next((tmp_path / "out" / "work").glob("*/stages/*/views.json"))
    whole = next((tmp_path / "out" / "work").glob("*/train.json"))
    assert len(io.read_views(selected)) == round(len(io.read_views(whole)) / 2)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("ratios", "rations"), "no key 'rations'"),
        (('"pup"', '"pop"'), "no 'pop'"),
        (('base = "g2ard-paper"', 'base = "x"'), "method rounds: base"),
        (("protection = 0.0", 'rounds = "many"'), "rounds: expected one of"),
        (('name = "ball"', 'nam = "ball"'), "lacks 'name'"),
        (("ratios = [4]", "ratios = [4"), "balls.toml"),
        (("ratios = [4]", "ratios = []"), "no ratios"),
        (("steps = [9]\nseconds = [3]\n", ""), "no steps"),
        (("[[scene]]", '[[scene]]\nname = "ball"\n[[scene]]'), "there are two of that name"),
        (('title = "Balls"', "title = 3"), "title: expected text"),
    ],
)
def test_definitions_say_what_is_wrong(tmp_path: Path, change: tuple[str, str], message: str) -> None:
    with pytest.raises(InputError, match=re.escape(message)) as caught:
        read_definition(study(tmp_path, STUDY.replace(*change)))
    assert "balls.toml" in str(caught.value)


def test_the_papers_studies_can_be_read() -> None:
    found = {
        path.stem: read_definition(path) for path in (ROOT / "benchmarks" / "definitions").rglob("*.toml")
    }
    for name in ("compression", "geobase", "k_sweep", "policies", "ablations", "source", "bounded"):
        assert found[name].methods
        assert found[name].scenes
    assert [m.name for m in found["ablations"].methods][:3] == ["full", "one-shot", "-shape"]
    assert set(found["compression"].ratios) == {5, 10, 20, 30}


def test_paths_may_name_environment_variables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for path in (ROOT / "benchmarks" / "definitions").rglob("*.toml"):
        for name in re.findall(r"\$(\w+)", path.read_text()):
            monkeypatch.setenv(name, str(tmp_path))
        assert "$" not in repr([asdict(scene) for scene in read_definition(path).scenes]), path


def test_pareto_is_what_no_other_beats() -> None:
    rng = np.random.default_rng(0)
    points = [Point(x, y, 0) for x, y in rng.normal(size=(60, 2)).round(1)]
    expected = {
        (p.x, p.y)
        for p in points
        if not any((q.x <= p.x and q.y >= p.y and (q.x, q.y) != (p.x, p.y)) for q in points)
    }
    assert {(p.x, p.y) for p in pareto(points)} == expected
    assert chart([], x_label="x", y_label="y") == ""
    assert "NaN" not in chart([Point(1, 2, 0)], x_label="x", y_label="y", log=True, joined=True, front=True)


def test_luma_drift_is_the_mean_distance_of_lumas() -> None:
    views = (ViewFigures("a", 30, 0.9, 0.1), ViewFigures("b", 20, 0.8, -0.3))
    assert Scored(views).luma_drift == pytest.approx(0.2)
    assert Scored(views).mean("psnr") == 25
    assert Scored(views).mean("lpips_vgg") is None
    assert luma(np.array([[[1, 0, 0], [0, 1, 0]]], np.float32)) == pytest.approx((0.2126 + 0.7152) / 2)


@needs_processes
def test_released_schedules_run_beside_the_matched_ones(tmp_path: Path) -> None:
    text = STUDY.replace('["g2ard", "pup", "rounds", "nanogs"]', '["light", "pair", "nanogs", "random"]')
    text = text.replace("steps = [9]", "released = true").replace("seconds = [3]", "")
    text = text.replace(
        '[method.rounds]\nbase = "g2ard-paper"\nprotection = 0.0',
        '[method.light]\nbase = "lightgaussian"\nreleased_steps = 7\n'
        '[method.pair]\nbase = "pup"\nreleased_steps = 3',
    )
    rows = bench_run([read_definition(study(tmp_path, text))], tmp_path / "out", keep=True)
    assert [(r.method, r.matched, r.steps, r.error) for r in rows] == [
        ("light", "released", 7, ""),
        ("pair", "released", 6, ""),  # two rounds
        ("nanogs", "released", 0, ""),
    ]
    jobs = [json.loads(p.read_text()) for p in (tmp_path / "out" / "work").glob("*/stages/*/job.json")]
    assert {job["schedule"] for job in jobs if job["kind"] == "recover"} == {"3dgs"}


def test_released_schedules_are_those_of_the_papers() -> None:
    assert METHODS["lightgaussian"].released_steps == 5000
    assert METHODS["pup"].rounds == "pup"
    assert METHODS["nanogs"].released_steps == 0
    assert METHODS["g2ard-paper"].released_schedule == "paper"


@needs_processes
def test_command(command_line: CommandLine, tmp_path: Path) -> None:
    study(tmp_path)
    options = ["--methods", "g2ard,random", "--ratios", "5", "--steps", "3", "--json", "-", "-o", "out"]
    status, out, err = command_line(
        "bench", "run", "--scene", "ball.ply", "--views", "views.json", *options, cwd=tmp_path
    )
    assert status == 0, err
    assert [row["method"] for row in json.loads(out)["rows"]] == ["g2ard", "random"]
    check_page((tmp_path / "out" / "report.html").read_text())
    status, _, err = command_line("bench", "run", "balls.toml", "--only", "moon", "-o", "x", cwd=tmp_path)
    assert status == 1
    assert "no scene 'moon'" in err
    assert command_line("bench", "run", "-o", "x", cwd=tmp_path)[0] == 2


def test_distill_writes_such_a_report(command_line: CommandLine, tmp_path: Path) -> None:
    study(tmp_path)
    options = ["-r", "4", "--views", "views.json", "--steps", "5", "-o", "run"]
    status, _, err = command_line("distill", "ball.ply", *options, cwd=tmp_path)
    assert status == 0, err
    html = (tmp_path / "run" / "report.html").read_text()
    check_page(html)
    assert "Worst views first" in html
    assert "ball.ply" in html


def test_scores_are_those_of_evaluate(tmp_path: Path) -> None:
    from benchmarks.score import score
    from g2ard.stages.evaluate import evaluate

    ball, views = checkered_ball(400), around(3)
    targets = TeacherRenders(ball, views)
    small = ball.take(slice(0, 200))
    scored = score(small, targets, (0.0, 0.0, 0.0), pictures=tmp_path / "p")
    assert scored.mean("psnr") == evaluate(small, targets).psnr
    assert len(list((tmp_path / "p").iterdir())) == 3


SMALL = STUDY.replace("seconds = [3]\n", "").replace(
    'methods = ["g2ard", "pup", "rounds", "nanogs"]', 'methods = ["random"]'
)


@needs_processes
def test_a_run_touches_nothing_of_others_and_knows_its_files(tmp_path: Path) -> None:
    path, out = study(tmp_path, SMALL), tmp_path / "out"
    thesis = out / "work" / "thesis.txt"
    thesis.parent.mkdir(parents=True)
    thesis.write_text("precious")
    first = bench_run([read_definition(path)], out)
    assert [p.name for p in (out / "work").iterdir()] == ["thesis.txt"]
    assert first[0].input_count == 1200
    io.write_splats(tmp_path / "ball.ply", checkered_ball(800), overwrite=True)
    second = bench_run([read_definition(path)], out)
    assert second[0].input_count == 800
    other = tmp_path / "other.toml"
    other.write_text(SMALL)
    bench_run([read_definition(other)], out)
    rows = read_rows(out / "rows.csv")
    assert [(row.study, row.input_count) for row in rows] == [("other", 800), ("balls", 800)]


@needs_processes
def test_rows_of_other_ratios_stay(tmp_path: Path) -> None:
    path, out = read_definition(study(tmp_path, SMALL)), tmp_path / "out"
    bench_run([path.narrowed(ratios=(4.0, 8.0))], out)
    assert len(bench_run([path.narrowed(ratios=(2.0,))], out)) == 1
    assert {row.ratio for row in read_rows(out / "rows.csv")} == {2.0, 4.0, 8.0}


@needs_processes
def test_one_reduction_a_round(tmp_path: Path) -> None:
    """The paper's method takes its 75 % where the study has rounds, and one shot where it has not."""
    text = STUDY.replace('methods = ["g2ard", "pup", "rounds", "nanogs"]', 'methods = ["rounds", "shot"]')
    text = text.replace("seconds = [3]\n", "").replace("ratios = [4]", "ratios = [10]")
    shot = '[method.shot]\nbase = "g2ard-paper"\nprotection = 0.0\nrounds = "one"\n'
    out = tmp_path / "out"
    rows = bench_run(
        [read_definition(study(tmp_path, text.replace("[[scene]]", shot + "[[scene]]")))], out, keep=True
    )
    assert [row.count for row in rows] == [120, 120]
    jobs = [json.loads(p.read_text()) for p in out.glob("work/*/stages/*/job.json")]
    assert sorted(job["count"] for job in jobs if job["kind"] == "reduce")[:2] == [120, 120]
    made = {
        tuple(io.read_splats(p.parent / "out.ply").means.ravel())
        for p in out.glob("work/*/stages/*/job.json")
        if json.loads(p.read_text()).get("count") == 120
    }
    assert len(made) == 2


@needs_processes
def test_nothing_is_left_running(tmp_path: Path) -> None:
    mark = tmp_path / "alive"
    late = f"import time; time.sleep(1.5); open({str(mark)!r}, 'w')"
    code = (
        "from pathlib import Path; import sys; from benchmarks.process import measured;"
        f"measured([sys.executable, '-c', {late!r}], Path({str(tmp_path / 'log')!r}))"
    )
    with subprocess.Popen([sys.executable, "-c", code]) as parent:
        time.sleep(0.8)
        parent.kill() if sys.platform == "linux" else parent.send_signal(signal.SIGINT)
    time.sleep(1.5)
    assert not mark.exists()


@needs_processes
def test_w_measures_again(tmp_path: Path) -> None:
    path, out = study(tmp_path, SMALL), tmp_path / "out"
    bench_run([read_definition(path)], out, keep=True)
    made = {p: p.stat().st_mtime_ns for p in out.glob("work/*/stages/*/usage.json")}
    cell = next((out / "cells").iterdir())
    cell.write_text(cell.read_text().replace('"psnr": ', '"psnr": 1'))
    wrong = bench_run([read_definition(path)], out, keep=True)[0].psnr
    assert bench_run([read_definition(path)], out, keep=True, again=True)[0].psnr < wrong - 50
    assert made
    assert all(p.stat().st_mtime_ns > then for p, then in made.items())


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("ratios = [0]", "ratios"),
        ('ratios = ["x"]', "ratios"),
        ("ratios = 10", "ratios: expected a list"),
        ("steps = [-1]", "steps"),
        ("steps = [2.5]", "steps"),
        ("seconds = [nan]", "seconds"),
        ("seeds = [-1]", "seeds"),
        ("size = 0", "size"),
        ('schedule = "nope"', "schedule"),
        ('methods = "g2ard"', "methods: expected a list"),
    ],
)
def test_a_study_is_checked_before_it_runs(tmp_path: Path, line: str, words: str) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(line + '\n[[scene]]\nname = "ball"\nprior = "ball.ply"\n')
    with pytest.raises(InputError, match=words) as error:
        read_definition(path)
    assert str(path) in str(error.value)
