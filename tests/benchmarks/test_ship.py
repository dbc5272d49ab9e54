"""The study of formats on a small scene."""

from pathlib import Path

from helpers.studies import ball_of, measured


def test_formats_lose_as_much_as_their_quanta(tmp_path: Path) -> None:
    ball = ball_of(tmp_path, 600, views=False)
    rows = measured("ship", ball, tmp_path / "out", ratios="1,5", methods="sog,splat", size="64")
    pool = {(r["ratio"], r["format"]): r for r in rows if r["views_kind"] == "pool"}
    assert set(pool) == {(r, f) for r in (1, 5) for f in ("ply", "sog", "splat")}
    assert pool[1, "ply"]["psnr"] > 90
    assert pool[1, "sog"]["bytes"] < pool[1, "ply"]["bytes"] / 2
    assert pool[5, "ply"]["lost"] == 0
    assert abs(pool[5, "sog"]["lost"]) < 0.1
    assert pool[1, "splat"]["psnr"] < pool[1, "sog"]["psnr"]  # no harmonics, coarse rotations
    assert {r["views_kind"] for r in rows} >= {"pool", "near", "standing"}
