"""`import g2ard`: its names, and results with the same bits as the commands'."""

import ast
import inspect
import json
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

import g2ard
from g2ard.io.reports import Report
from g2ard.io.types import Points
from g2ard.scene.splats import ARRAYS, Splats
from helpers.commands import CommandLine, succeeds
from helpers.scenes import around, checkered_ball

BALL = checkered_ball(1500)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    g2ard.save(tmp_path / "ball.ply", BALL)
    return tmp_path


def assert_same_bits(ours: Splats, theirs: Splats, path: Path) -> None:
    """Compare as files, because a file holds logarithms of scales."""
    g2ard.save(path, ours)
    written = g2ard.load(path)
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(written, name), getattr(theirs, name))


def test_every_public_name_exists_and_no_function_is_a_module() -> None:
    for name in g2ard.__all__:
        found = getattr(g2ard, name)
        assert not inspect.ismodule(found), name
        assert name == "__version__" or found.__doc__, name
    import_module("g2ard.stages.simplify")  # the stage's import leaves the function alone
    assert callable(g2ard.simplify)
    assert set(dir(g2ard)) == set(g2ard.__all__)
    with pytest.raises(AttributeError, match="no attribute 'simplfy'"):
        g2ard.simplfy  # type: ignore[attr-defined]


def test_every_parameter_is_explained_where_it_stands() -> None:
    for name in g2ard.__all__:
        function = getattr(g2ard, name)
        if not inspect.isfunction(function):
            continue
        text = (inspect.getdoc(function) or "").partition("Args:")[2].partition("\n\n")[0]
        told = dict(re.findall(r"(?m)^    ([\w, ]+): (.*)$", text))
        explained = {one for names in told for one in names.split(", ")}
        assert {*inspect.signature(function).parameters} <= explained | {"options"}, name
        assert ">>>" in (function.__doc__ or "") or name == "distill_against", name
        referred = [one for one, words in told.items() if words.startswith(("see ", "as for "))]
        assert set(referred) <= {"config"}, name  # a dataclass with a page entry of its own


def test_no_text_has_doubled_braces() -> None:
    """Only f-strings halve them; in any other text a user reads {{ratio}}."""
    package = Path(g2ard.__file__).parent
    found = [
        f"{path.relative_to(package)}:{node.lineno}"
        for path in package.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and "{{" in node.value
    ]
    assert not found


def test_results_print_as_one_short_line() -> None:
    views = around(6)
    done = g2ard.distill(BALL, count=150, views=views, steps=2, size=64, settings={"focus": "far"})
    recovered = g2ard.recover(BALL, done.held_out, g2ard.RecoverConfig(steps=2))
    for result, expected in (
        (BALL, "Splats(1,500 Gaussians, SH degree 1)"),
        (views, "Cameras(6 views)"),
        (g2ard.simplify(BALL, count=1, blind=True), "Simplified(1,500 → 1 Gaussian)"),
        (g2ard.select(BALL, views, 2), "Selection(2 views, policy="),
        (done, "Distilled(150 Gaussians, PSNR "),
        (recovered, "Recovered(1,500 Gaussians, PSNR "),
        (
            g2ard.evaluate(BALL, done.held_out),
            "Evaluation(1,500 Gaussians, 1 view against the dense scene, 64×48 px: PSNR ",
        ),
        (g2ard.render(BALL, views[0]), "Rendered(64 × 48)"),
    ):
        assert repr(result).startswith(expected)
        assert len(repr(result)) < 120
    assert "64×48 px" in repr(recovered)
    assert "64×48 px" in repr(recovered.report)


@pytest.mark.parametrize(
    ("typed", "given"),
    [
        (["-n", 200], {"count": 200}),
        (
            ["-r", 6, "--method", "fast", "--views", "made"],
            {"ratio": 6, "method": "fast", "views": "made"},
        ),
        (["-r", 5, "--no-views"], {"ratio": 5, "blind": True}),
        (["-r", 7, "--preset", "paper"], {"ratio": 7, "method": "paper"}),
        (["--fit", "20kB"], {"fit": "20kB"}),
        (["--min-psnr", 24, "--min-ssim", 0.5], {"min_psnr": 24, "min_ssim": 0.5}),
    ],
)
def test_simplify_equals_the_command(
    typed: list[object], given: dict[str, object], command_line: CommandLine, folder: Path
) -> None:
    succeeds(command_line, folder, "simplify", "ball.ply", "-o", "small.ply", *typed)
    ours = g2ard.simplify(g2ard.load(folder / "ball.ply"), **given)  # type: ignore[arg-type]
    assert_same_bits(ours.splats, g2ard.load(folder / "small.ply"), folder / "ours.ply")


@pytest.mark.parametrize(
    ("typed", "given"),
    [
        (["--fit", "30kB", "--clean", "--steps", 10], {"fit": "30kB", "clean": True, "steps": 10}),
        (
            ["-r", 10, "--preset", "paper", "--steps", 30, "--set", "schedule.round_steps=4"],
            {"ratio": 10, "preset": "paper", "steps": 30, "schedule.round_steps": 4},
        ),
    ],
)
def test_distill_equals_the_command(
    typed: list[object], given: dict[str, object], command_line: CommandLine, folder: Path
) -> None:
    ask = (
        "distill",
        "ball.ply",
        "-o",
        "run",
        "--size",
        64,
        "--seed",
        3,
        "--focus",
        "far",
        "--no-page",
    )
    succeeds(command_line, folder, *ask, *typed)
    settings = {"focus": "far"} | {name: given.pop(name) for name in [*given] if "." in name}
    ours = g2ard.distill(folder / "ball.ply", size=64, seed=3, settings=settings, **given)  # type: ignore
    assert_same_bits(ours.splats, g2ard.load(folder / "run" / "scene.ply"), folder / "ours.ply")
    told = json.loads((folder / "run" / "report.json").read_text())
    rounds = ours.report.as_dict()["rounds"]
    assert [r["recover"][-1]["loss"] for r in rounds] == [
        r["recover"][-1]["loss"] for r in told["rounds"]
    ]
    score = g2ard.evaluate(ours.splats, ours.held_out)
    assert score.psnr == pytest.approx(told["scores"]["recovered"]["psnr"], abs=1e-9)


def test_errors_speak_of_parameters(folder: Path) -> None:
    for wrong, words in (
        ({}, "expected exactly one kind of budget"),
        ({"count": 5, "ratio": 2}, "expected exactly one kind of budget"),
        ({"count": 1501}, "at most 1,500, got 1,501"),
        ({"ratio": 0.5}, "ratio: expected a finite number of at least 1"),
        ({"ratio": 2, "method": "magic"}, "method: expected one of default, fast, paper"),
    ):
        for function in (g2ard.simplify, g2ard.distill):
            with pytest.raises(g2ard.InputError, match=words) as caught:
                function(BALL, **wrong)
            assert "--" not in str(caught.value)
    with pytest.raises(g2ard.InputError, match="at most 1, got 5"):
        g2ard.distill(Points(np.zeros((9, 3)), np.zeros((9, 3), "f4")), count=5)


def test_reports_are_dataclasses_that_json_gives_back() -> None:
    small = g2ard.simplify(BALL, ratio=10)
    report = small.report
    assert isinstance(report, Report)
    assert (report.input_count, report.output_count, report.rounds[-1].after) == (1500, 150, 150)
    assert type(report).of(json.loads(json.dumps(report.as_dict()))) == report
    targets = g2ard.TeacherRenders(BALL, g2ard.make_pool(BALL, 8).resized(48))
    done = g2ard.recover(small.splats, targets, g2ard.RecoverConfig(steps=10)).report
    assert done.psnr.after > done.psnr.before
    assert type(done).of(json.loads(json.dumps(done.as_dict()))) == done


def test_one_camera_is_a_view_of_many() -> None:
    pool = g2ard.make_pool(BALL, 8)
    together = g2ard.Cameras.of(pool)
    np.testing.assert_array_equal(together.viewmats, pool.viewmats)
    np.testing.assert_array_equal(together.Ks, pool.Ks)
    assert (together.names, pool[-1].name, len(list(pool))) == (pool.names, pool.names[-1], 8)
    with pytest.raises(IndexError):
        pool[8]
    assert g2ard.render(BALL, pool[2]).image.shape == (600, 800, 3)


def test_benchmarks_and_torch_are_never_imported() -> None:
    code = """
import sys, numpy as np, g2ard
ball = np.random.default_rng(0).normal(size=(900, 3))
scene = g2ard.Splats.create(ball / np.linalg.norm(ball, axis=1)[:, None], scales=np.full((900, 3), 0.05))
g2ard.distill(scene, ratio=10, steps=3, size=32, settings={"focus": "far"})
apart = ("benchmarks", "benchmarks.synth", "benchmarks.baselines", "g2ard.cli", "torch")
print([m for m in sys.modules if m.startswith(apart)])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
