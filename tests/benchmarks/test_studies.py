"""Studies as the paper has them: its weights and recoveries, shared checkpoints, teachers, black renders."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.definition import Definition, read_definition
from benchmarks.methods import METHODS, Matched
from benchmarks.report import write_report
from benchmarks.run import bench_run
from benchmarks.run_rows import Row, read_rows, with_deltas
from benchmarks.score import score
from g2ard import io
from g2ard.errors import InputError
from g2ard.rendering.renderer import RasterSettings
from g2ard.scene.splats import Splats
from g2ard.scene.targets import TeacherRenders
from g2ard.stages.recover.anchors import PAPER_PRESETS, PRESETS, Anchors, drift95
from g2ard.stages.simplify import round_counts
from helpers.commands import CommandLine
from helpers.project import ROOT
from helpers.scenes import around, checkered_ball
from helpers.studies import check_page, pictured, study
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


def run(folder: Path, text: str) -> tuple[Definition, list[Row], Path]:
    definition = read_definition(study(folder, text))
    rows = bench_run([definition], folder / "out", keep=True)
    assert [row.error for row in rows if row.error] == []
    return definition, rows, folder / "out"


@needs_processes
def test_the_last_round_recovers_twice_and_stays_anchored_where_it_was_built(tmp_path: Path) -> None:
    text = HEAD.replace("[12]", "[60]") + 'methods = ["g2ard-paper"]\n' + SCENE
    _, (row,), out = run(tmp_path, text)
    counts = round_counts(1200, 300)
    recoveries = {job["output"]: job for job in jobs(out, "recover")}
    assert len(recoveries) == len(counts) + 1
    share = 8_000 / (8_000 * len(counts) + 30_000)
    (final,) = (job for job in recoveries.values() if job["final"])
    early = [job for job in recoveries.values() if not job["final"]]
    assert {job["steps"] for job in early} == {int(60 * share)}
    assert final["steps"] == 60 - len(counts) * int(60 * share)
    assert row.steps == 60
    before = recoveries[final["scene"]]  # the last round's own recovery
    assert final["anchors"] == before["scene"]
    assert not any("anchors" in job for job in early)
    anchors = Anchors.of(io.read_splats(final["anchors"]))
    assert row.drift95 == pytest.approx(drift95(anchors, io.read_splats(final["output"]).means), rel=1e-4)


def test_legs_are_those_of_the_releases() -> None:
    paper = METHODS["g2ard-paper"].legs(12)
    assert [leg.final for leg in paper] == [False] * 12 + [True]
    assert sum(leg.share for leg in paper) == pytest.approx(1)
    assert paper[0].share == pytest.approx(8 / 126)
    assert paper[-1].share == pytest.approx(30 / 126)
    assert [(leg.round, leg.share) for leg in METHODS["pup"].legs(2)] == [(0, 0.5), (1, 0.5)]
    assert [leg.share for leg in METHODS["g2ard"].legs(1)] == [1]
    assert [leg.share for leg in replace(METHODS["g2ard-paper"], rounds="one").legs(1)] == [1]
    shared = replace(METHODS["g2ard-paper"], shared_start=True).legs(3)
    assert [(leg.round, leg.final) for leg in shared] == [(0, False), (1, False), (2, True)]
    assert shared[-1].share == 1


@needs_processes
def test_the_papers_method_has_the_papers_weights_of_each_prior(tmp_path: Path) -> None:
    methods = {"a": "trained", "b": "lift"}
    text = HEAD.replace("12", "6") + 'methods = ["a", "b", "c", "d"]\n'
    for name, prior in methods.items():
        text += f'[method.{name}]\nbase = "g2ard-paper"\nrounds = "one"\nprior = "{prior}"\n'
    text += '[method.c]\nprior = "lift"\npreset = "lift"\n'
    text += '[method.d]\nbase = "g2ard-paper"\nrounds = "one"\npreset = "noisy"\neffective_rank = false\n'
    _, rows, out = run(tmp_path, text + CITY)
    assert {(row.method, row.prior) for row in rows} >= {("a", "trained"), ("b", "lift")}
    found = [job["regularizers"] for job in jobs(out, "recover") if job["steps"] == 6]
    as_dicts = [
        vars(PAPER_PRESETS["trained"]),
        vars(PAPER_PRESETS["lift"]),
        vars(PRESETS["lift"]),
        vars(PAPER_PRESETS["noisy"]) | {"effective_rank": False},
    ]
    assert len(found) == 4
    assert all(weights in found for weights in as_dicts)


@needs_processes
def test_policies_go_on_from_one_checkpoint(tmp_path: Path) -> None:
    text = HEAD + 'seeds = [0, 1]\nmethods = ["random", "directional", "own"]\n'
    for name, base in (("random", "g2ard-paper"), ("directional", "g2ard-paper"), ("own", "g2ard")):
        policy = "random" if name == "own" else name
        text += f'[method.{name}]\nbase = "{base}"\npolicy = "{policy}"\nk = 0.5\nshared_start = true\n'
    _, rows, out = run(tmp_path, text + SCENE)
    counts = round_counts(1200, 300)
    assert len(jobs(out, "reduce")) == len(counts) + 1  # once for all rows, and once for g2ard's own
    recoveries = jobs(out, "recover")
    early = [job for job in recoveries if not job["final"]]
    assert len(early) == len(counts) - 1
    assert {(Path(job["views"]).name, job["seed"]) for job in early} == {("train.json", 0)}
    final = [job for job in recoveries if job["final"]]
    assert len(final) == 6
    assert {job["steps"] for job in final} == {12}
    assert {Path(job["views"]).name for job in final} == {"views.json"}
    assert len({job["scene"] for job in final}) == 2
    assert len({row.psnr for row in rows}) == 6


@needs_processes
def test_a_teacher_has_a_row_and_the_others_their_distance_from_it(tmp_path: Path) -> None:
    text = HEAD.replace("[4]", "[4, 8]").replace("12", "4") + 'differs = ["small <balls>"]\n'
    text += 'methods = ["random", "teacher"]\n' + CITY
    definition, rows, out = run(tmp_path, text)
    teachers = [row for row in rows if row.method == "teacher"]
    assert [(row.split, row.matched, row.ratio, row.steps) for row in teachers] == [
        (split, "none", 1.0, 0) for split in ("val", "ood")
    ]
    assert all(row.count == row.input_count and row.delta_psnr is None for row in teachers)
    of = {row.split: row.psnr for row in teachers}
    others = [row for row in rows if row.method == "random"]
    assert len(others) == 4
    assert all(row.delta_psnr == row.psnr - of[row.split] for row in others)
    assert read_rows(out / "rows.csv")[-1].delta_psnr == pytest.approx(others[-1].delta_psnr, abs=1e-3)
    write_report(out, [definition], rows)
    html = (out / "report.html").read_text()
    check_page(html)
    assert "<li>small &lt;balls&gt;</li>" in html
    assert "ΔPSNR" in html
    assert html.count("<td>teacher</td>") == 4  # beside the rows of both ratios, in both splits
    elsewhere = replace(others[0], scene="moon")
    assert with_deltas([elsewhere, *teachers])[0].delta_psnr is None


def test_black_renders_are_counted_and_left_out() -> None:
    ball = checkered_ball(400)
    views = around(4)
    targets = TeacherRenders(ball, views)
    toward = np.asarray(views.positions[0]) / 3.0
    hidden = replace(ball, means=(ball.means - 6 * toward).astype(np.float32))  # in the first view alone
    scored = score(hidden, targets, (0.0, 0.0, 0.0))
    black = [view.black for view in scored.views]
    assert 0 < sum(black) < 4
    assert scored.black == sum(black)
    assert scored.mean("psnr") == np.mean([v.psnr for v in scored.views if not v.black])
    nothing = Splats.create([[0, 0, 0]], scales=[[1e-3] * 3], logit_opacities=[-20])
    everywhere = score(nothing, targets, (0.0, 0.0, 0.0))
    assert everywhere.black == 4
    assert everywhere.mean("psnr") == np.mean([v.psnr for v in everywhere.views])
    assert score(nothing, targets, (0.5, 0.5, 0.5)).black == 0


@needs_processes
def test_black_renders_are_told(tmp_path: Path) -> None:
    text = HEAD.replace("12", "4") + 'methods = ["random"]\n' + SCENE
    definition, (row,), out = run(tmp_path, text)
    assert row.black == 0
    other = replace(row, seed=1, psnr=(row.psnr or 0) + 2)
    write_report(out, [definition], [replace(row, black=11, views=484), other])
    html = (out / "report.html").read_text()
    assert f"random, 2 seeds: {row.psnr + 1:.2f} ± {2**0.5:.2f} dB" in html
    assert "11 of 495 test renders are all black" in html
    assert "random†" in html


@needs_processes
def test_what_is_scored_is_not_trained_on(tmp_path: Path) -> None:
    views = around(16, size=(48, 36))
    scored = views.take(range(0, 4))
    text = HEAD.replace("12", "4") + 'methods = ["random"]\n' + SCENE + 'score = { val = "val.json" }\n'
    io.write_views(tmp_path / "val.json", scored)
    definition, (row,), out = run(tmp_path, text)
    assert row.views == 4
    (train,) = out.glob("work/*/train.json")
    assert sorted(io.read_views(train).names) == sorted(views.names[4:])
    write_report(out, [definition], [row])
    assert "4 views to train on are scored on" in (out / "report.html").read_text()


@needs_processes
def test_adaptation_takes_all_views_in_the_papers_schedule(tmp_path: Path) -> None:
    text = HEAD.replace("12", "4") + 'adapt_steps = 7\nadapt_schedule = "paper"\nadapt_on = "all"\n'
    _, rows, out = run(tmp_path, text + 'methods = ["random"]\n' + CITY)
    assert [row.split for row in rows] == ["val", "ood"]
    (job,) = jobs(out, "adapt")
    assert (job["schedule"], job["steps"]) == ("paper", 7)
    (city,) = out.glob("work/*/city/adapt.json")
    assert len(io.read_views(job["views"])) == len(io.read_views(city))
    (report,) = (
        p.parent / "report.json"
        for p in out.glob("work/*/stages/*/job.json")
        if "adapt" in p.read_text().split('"kind": ')[1][:9]
    )
    assert json.loads(report.read_text())["steps"] == 7


@needs_processes
def test_the_last_training_views_may_be_the_new_trajectory(tmp_path: Path) -> None:
    text = HEAD.replace("12", "4") + 'adapt_steps = 3\nmethods = ["random"]\n'
    _, (row,), out = run(tmp_path, text + SCENE + "adapt_last = 5\n")
    (adapt,), (train,) = out.glob("work/*/adapt.json"), out.glob("work/*/train.json")
    adapted, trained = io.read_views(adapt).names, io.read_views(train).names
    assert len(adapted) == 5
    assert min(adapted) > max(trained)
    assert len(adapted) + len(trained) + row.views == len(io.read_views(tmp_path / "views.json"))
    none_left = study(tmp_path / "more", text + SCENE + "adapt_last = 14\n")
    (failed,) = bench_run([read_definition(none_left)], tmp_path / "none")
    assert "adapt_last: 14 of 14 views leave none to train on" in failed.error
    for line, message in (
        ("adapt_last = -1", "expected a number"),
        ('adapt_last = 2\nadapt = "a"', "without `adapt`"),
    ):
        none_left.write_text(text + SCENE + line)
        with pytest.raises(InputError, match=f"adapt_last.*{message}"):
            read_definition(none_left)


@needs_processes
def test_a_study_may_score_by_inrias_conventions_in_8_bit(tmp_path: Path) -> None:
    text = HEAD.replace("12", "4") + 'methods = ["random"]\n' + SCENE
    _, (plain,), _ = run(tmp_path, text)
    path = tmp_path / "balls.toml"
    path.write_text('convention = "inria"\neight_bit = true\n' + text)
    (row,) = bench_run([read_definition(path)], tmp_path / "out", keep=True)
    assert row.psnr != plain.psnr
    (stored,) = (tmp_path / "out").glob("work/*/targets-test-inria")
    first = np.load(stored / "0.npy")
    (prior,) = (tmp_path / "out").glob("work/*/prior.ply")
    cameras = around(16, size=(48, 36)).take([0])
    again = TeacherRenders(io.read_splats(prior), cameras, settings=RasterSettings(convention="inria"))
    assert np.array_equal(first, again[0])


@needs_processes
def test_either_target_is_the_photo_or_the_priors_render(tmp_path: Path) -> None:
    io.write_views(tmp_path / "some.json", pictured(tmp_path), splits=["train", "train", "test", "test"])
    text = HEAD.replace("12", "4") + 'methods = ["random"]\n' + SCENE.replace("views.json", "some.json")
    _, (row,), out = run(tmp_path, text + 'targets = "either"\n')
    assert (row.views, row.against) == (2, "either")
    kinds = {np.load(path).dtype for path in out.glob("work/*/targets-t*/?.npy")}
    assert kinds == {np.dtype(np.uint8), np.dtype(np.float32)}
    assert len(list(out.glob("work/*/targets-train/?.npy"))) == 2


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("keep = [0.1]", "keep and ratios exclude each other"),
        ('convention = "opengl"', "convention: expected gsplat or inria"),
        ("eight_bit = 3", "eight_bit: expected true or false"),
        ('adapt_on = "some"', "adapt_on: expected train or all"),
        ('lpips_input = "raw"', "lpips_input: expected scaled or unscaled"),
        ('differs = "size"', "differs: expected a list of lines"),
        ('[method.x]\nlambdas = "mine"', "lambdas: expected one of own, paper"),
        ('[method.x]\nshared_start = "yes"', "shared_start: expected true or false"),
    ],
)
def test_new_keys_are_checked(tmp_path: Path, line: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_definition(study(tmp_path, HEAD + line + "\n" + SCENE))


def test_keep_is_a_share_of_the_prior(tmp_path: Path) -> None:
    kept = HEAD.replace("ratios = [4]", "keep = [0.033]") + 'methods = ["random"]\n' + SCENE
    path = study(tmp_path, kept)
    assert read_definition(path).ratios == (1 / 0.033,)
    for bad in ("[0]", "[1.5]", '["x"]', "0.1"):
        path.write_text(kept.replace("[0.033]", bad))
        with pytest.raises(InputError, match="keep: expected a list of shares"):
            read_definition(path)


def test_every_study_says_what_differs_from_the_paper() -> None:
    found = {p.stem: read_definition(p) for p in (ROOT / "benchmarks" / "definitions").rglob("*.toml")}
    assert all(definition.differs for definition in found.values())
    for name in ("ablations", "k_sweep", "policies", "protection", "compression", "geobase", "source"):
        assert any(method.lambdas == "paper" for method in found[name].methods), name
    assert all(method.shared_start for method in found["policies"].methods)
    assert {m.effective_rank for m in found["kings_college_erank"].methods} == {None, False}
    mip = found["mip_nerf_360"]
    assert (mip.convention, mip.eight_bit, mip.lpips_input) == ("inria", True, "unscaled")
    assert [matched.kind for matched in mip.matched(METHODS["teacher"])] == ["none"]
    geobase = found["matrixcity_geobase"]
    assert (geobase.adapt_schedule, geobase.adapt_on, geobase.adapt_steps) == ("paper", "all", 7000)
    assert round(3_001_333 / found["matrixcity_ablations"].ratios[0]) == 99_044
    assert round(3_000_000 / found["matrixcity_source"].ratios[0]) == 285_000
    assert Matched("none").label == "as it is"


@needs_processes
def test_a_study_is_one_command(command_line: CommandLine, tmp_path: Path) -> None:
    study(tmp_path, HEAD.replace("12", "4") + 'methods = ["random", "teacher"]\n' + SCENE)
    status, _, err = command_line("bench", "run", "balls.toml", cwd=tmp_path)
    assert status == 0, err
    assert (tmp_path / "figures" / "report.html").exists()


def test_rows_from_before_later_columns_can_be_read() -> None:
    files = sorted((ROOT / "benchmarks" / "record").glob("amd-epyc-2c/run-*.csv"))
    assert files
    for path in files:
        rows = read_rows(path)
        assert rows
        assert {(row.black, row.delta_psnr) for row in rows} == {(None, None)}


@needs_processes
def test_a_variable_that_is_not_set_is_told_before_anything_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("G2ARD_NOWHERE", raising=False)
    text = HEAD + 'methods = ["random"]\n[[scene]]\nname = "block"\nprior = "${G2ARD_NOWHERE}/block.ply"\n'
    with pytest.raises(InputError, match=r"scene block: \$G2ARD_NOWHERE is not set"):
        bench_run([read_definition(study(tmp_path, text))], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_study_takes_the_row_of_regularisers() -> None:
    from benchmarks.definition import METHODS, Definition
    from benchmarks.paper import as_in_the_paper

    study = Definition("s", "", (), (METHODS["g2ard"], METHODS["pup"]), steps=(5,))
    assert [m.preset for m in as_in_the_paper(study, row="lift").methods] == ["lift", "auto"]
