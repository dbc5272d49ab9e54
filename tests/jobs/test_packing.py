"""The quality that packed formats cost, as `distill` and `convert` report it."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

import g2ard
from g2ard.report.run import Packed, score_lines
from helpers.commands import CommandLine, succeeds
from helpers.scenes import checkered_ball


def test_distill_scores_the_packed_file(command_line: CommandLine, folder: Path) -> None:
    ask = (
        "distill",
        "ball.ply",
        "-r",
        4,
        "--steps",
        20,
        "--size",
        48,
        "--no-page",
        "--focus",
        "far",
    )
    ask = (*ask, "--format", "splat")
    error = succeeds(command_line, folder, *ask, "-o", "run").err
    report = json.loads((folder / "run" / "report.json").read_text())
    packed, unpacked = report["packed"]["psnr"], report["scores"]["recovered"]["psnr"]
    (scored,) = [line for line in error.splitlines() if line.startswith("scene.splat: ")]
    scores = f"{packed:.1f} dB in held-out views, {report['size']} ({unpacked:.1f} as .ply)"
    assert scored == f"scene.splat: 0.00 MB, {scores}"
    assert 10 < packed < unpacked
    assert (
        "dB in held-out views ("
        not in succeeds(command_line, folder, *ask[:-1], "ply", "-o", "plain").err
    )


def test_a_costly_format_names_a_better_one() -> None:
    packed = Packed("scene.spz", 39.74, 0.9)
    assert score_lines(packed, 1_000_000, 40.0, "64×48 px")[1:] == []
    (warning,) = score_lines(packed, 1_000_000, 48.05, "64×48 px")[1:]
    assert warning == "warning: scene.spz: the format costs 8.3 dB; .sog loses less, .ply nothing"
    worse = Packed("scene.SOG", 30, 0.9)
    assert ".sog" not in score_lines(worse, 1, 48, "64×48 px")[1].partition(";")[2]


def test_convert_warns_only_of_a_visible_loss(command_line: CommandLine, tmp_path: Path) -> None:
    ball = checkered_ball(400)
    g2ard.save(tmp_path / "ball.ply", ball)
    for name in ("a.sog", "a.spz", "a.glb", "a.compressed.ply"):
        assert "warning" not in succeeds(command_line, tmp_path, "convert", "ball.ply", name).err, (
            name
        )
    shiny = replace(ball, shN=np.random.default_rng(0).normal(size=(400, 15, 3)).astype(np.float32))
    g2ard.save(tmp_path / "shiny.ply", shiny)
    # .splat drops SH
    error = succeeds(command_line, tmp_path, "convert", "shiny.ply", "b.splat").err
    assert "warning: b.splat: renders are " in error
    assert "; .sog loses less, .ply nothing\n" in error
