"""The raster benchmark's figures hang together (their size is the machine's affair)."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.raster import bench_raster, built_in_view, drawn
from g2ard import _core
from g2ard.errors import InputError
from g2ard.rendering.renderer import render
from g2ard.scene.splats import Splats


def cloud(n: int = 3000) -> Splats:
    rng = np.random.default_rng(0)
    scales = np.full((n, 3), 0.03, np.float32)
    return Splats.create(rng.normal(size=(n, 3)), scales=scales, sh0=rng.normal(size=(n, 1, 3)))


def test_figures_hang_together() -> None:
    isas = _core.instruction_sets()
    before = _core.num_threads()
    bench = bench_raster(
        cloud(), counts=[1000, 10**9], sizes=[(96, 64)], isas=isas, threads=[1, 2], repeats=2
    )
    assert _core.num_threads() == before
    assert [(s.isa, s.threads) for s in bench.scenes] == [(i, t) for i in isas for t in (1, 2)]
    for s in bench.scenes:
        assert (s.count, s.width, s.height) == (1000, 96, 64)
        assert s.pairs > 0
        assert s.contributing > 1000
        parts = {k: v for k, v in s.ms.items() if k != "total"}
        assert set(parts) == {"project", "sort", "bin", "forward", "backward", "loss", "adam"}
        assert sum(parts.values()) == pytest.approx(s.ms["total"])
        assert 0 < s.limit_share < 1
        # 3 × 59 values and a step count at the least: parameters, two moments; and not twice what is asked.
        assert 4 * 178 < s.memory["per_gaussian"] == s.memory["gaussians"] / 1000 < 3000
        assert s.memory["images"] > 2 * 3 * 4 * 96 * 64
    assert len({s.contributing for s in bench.scenes}) == 1
    assert bench.as_dict()["machine"]["fma_gflops"] > 1


def test_the_built_in_view_sees_the_scene() -> None:
    image = render(drawn(cloud(), 2000), built_in_view(cloud(), 96, 64)[0])
    assert image.alpha[24:40, 36:60].mean() > 0.3


def test_a_count_must_fit() -> None:
    with pytest.raises(InputError, match="counts: the scene has only 3,000"):
        bench_raster(cloud(), counts=[5000])
    with pytest.raises(InputError, match="count: expected 1 to 3000"):
        drawn(cloud(), 0)
