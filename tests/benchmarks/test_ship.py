"""The study of formats on a small scene."""

from dataclasses import replace
from pathlib import Path

from benchmarks.runner import run
from benchmarks.study import DEFINITIONS, SceneSpec, read_study
from g2ard.io import write_splats
from helpers.scenes import checkered_ball


def test_formats_lose_as_much_as_their_quanta(tmp_path: Path) -> None:
    write_splats(tmp_path / "ball.ply", checkered_ball(600))
    made = read_study(DEFINITIONS / "ship.toml").narrowed({"ratios": "1,5", "methods": "sog,splat"})
    rows = run([replace(made, scenes=(SceneSpec("ball", str(tmp_path / "ball.ply")),))], tmp_path / "out")
    pool = {(r["ratio"], r["format"]): r for r in rows if r["views_kind"] == "pool"}
    assert set(pool) == {(r, f) for r in (1, 5) for f in ("ply", "sog", "splat")}
    assert pool[1, "ply"]["psnr"] > 90
    assert pool[1, "sog"]["bytes"] < pool[1, "ply"]["bytes"] / 2
    assert pool[5, "ply"]["lost"] == 0
    assert abs(pool[5, "sog"]["lost"]) < 0.1
    assert pool[1, "splat"]["psnr"] < pool[1, "sog"]["psnr"]  # no harmonics, coarse rotations
    assert {r["views_kind"] for r in rows} >= {"pool", "near", "standing"}
