"""The raster study's figures are consistent (their size depends on the machine)."""

from pathlib import Path

import numpy as np

import g2ard._core as _core
from benchmarks.kinds.raster import built_in_view, copied_behind, drawn
from benchmarks.study import SceneSpec
from g2ard.io import write_splats
from g2ard.rendering.renderer import render
from g2ard.scene.splats import Splats
from g2ard.system import devices
from helpers.gpus import skip_without_gpu
from helpers.studies import ball_of, measured


def cloud(n: int = 3000) -> Splats:
    rng = np.random.default_rng(0)
    scales = np.full((n, 3), 0.03, np.float32)
    return Splats.create(rng.normal(size=(n, 3)), scales=scales, sh0=rng.normal(size=(n, 1, 3)))


def test_figures_hang_together(tmp_path: Path) -> None:
    write_splats(tmp_path / "cloud.ply", cloud())
    isas, before = _core.instruction_sets(), _core.num_threads()
    options = {
        "counts": "1000,9000",
        "image": "96,64",
        "threads": "1,2",
        "repeats": "2",
        "methods": "all",
    }
    rows = measured(
        "raster", SceneSpec("cloud", str(tmp_path / "cloud.ply")), tmp_path / "out", **options
    )
    assert _core.num_threads() == before
    assert {row["error"] for row in rows if "error" in row} == {
        "the scene has 3,000 Gaussians, expected at least 9,000"
    }
    rows = [row for row in rows if "error" not in row]
    assert [(row["isa"], row["threads"]) for row in rows] == [(i, t) for i in isas for t in (1, 2)]
    for row in rows:
        assert (row["count"], row["width"], row["height"]) == (1000, 96, 64)
        assert row["total_ms"] > 0
        assert row["image_ms"] > 0
        assert row["contributing"] > 1000
    assert len({row["contributing"] for row in rows}) == 1


def test_a_gpu_is_measured_beside_the_cpu(tmp_path: Path) -> None:
    skip_without_gpu()
    scene, options = (
        ball_of(tmp_path, 600),
        {"ratios": "5", "repeats": "1", "steps": "3", "size": "24"},
    )
    rows = measured("gpu", scene, tmp_path / "out", methods="cpu,gpu", **options)
    adapters = devices.adapters()
    assert adapters
    assert [row["isa"] for row in rows] == [_core.instruction_sets()[0], f"gpu: {adapters[0].name}"]
    assert devices.state().served == 0
    columns = ("total_ms", "steps_per_s", "targets_s", "recover_s", "score_s", "peak_mb", "psnr")
    for row in rows:
        assert row["count"] == 120
        assert all(row[name] > 0 for name in columns)
    assert abs(rows[0]["psnr"] - rows[1]["psnr"]) < 0.05
    if adapters[0].timestamps:
        assert all(
            rows[1][f"{name}_ms"] > 0 for name in ("project", "sort", "draw", "backward", "update")
        )
    assert "draw_ms" not in rows[0]


def test_copies_are_out_of_view() -> None:
    shown, view = drawn(cloud(), 500), built_in_view(cloud(), 96, 64)
    many = copied_behind(shown, view, 4)
    assert len(many) == 2000
    np.testing.assert_array_equal(render(many, view[0]).image, render(shown, view[0]).image)


def test_the_built_in_view_sees_the_scene() -> None:
    image = render(drawn(cloud(), 2000), built_in_view(cloud(), 96, 64)[0])
    assert image.alpha[24:40, 36:60].mean() > 0.3
