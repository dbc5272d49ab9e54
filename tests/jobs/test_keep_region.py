"""`--keep-region`: more of the budget where the user points."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import g2ard
from g2ard.errors import InputError
from g2ard.io import read_splats
from g2ard.rendering.visibility import SampledVisibility, visibility_source
from g2ard.scene.regions import check_region, in_any
from g2ard.stages.simplify import SimplifyConfig
from g2ard.stages.simplify import simplify as reduce
from g2ard.stages.simplify.pairs import emphasised
from helpers.commands import CommandLine, succeeds
from helpers.tiled_scenes import ring, town, town_in

BALL, BOX = (2.5, 0.0, 0.0, 2.0), (-8.0, -4.0, 0.0, -4.0, 0.0, 1.0)


def share(splats: g2ard.Splats, region: tuple[float, ...]) -> float:
    return float(in_any(splats, [region]).mean())


@pytest.mark.parametrize("region", [BALL, BOX])
@pytest.mark.parametrize("method", ["default", "fast"])
def test_a_region_gets_more_at_the_same_budget(region: tuple[float, ...], method: str) -> None:
    dense, look = town(3000), visibility_source(ring())
    shares = []
    for times in (1, 4, 16):
        config = SimplifyConfig(keep_region=(region,), keep_times=times)
        small = reduce(dense, 300, method=method, visibility=look, config=config).splats
        assert len(small) == 300
        shares.append(share(small, region))
    assert shares[0] * 1.3 < shares[1] < shares[2]
    plain = reduce(dense, 300, method=method, visibility=look).splats
    one = SimplifyConfig(keep_region=(region,), keep_times=1)
    same = reduce(dense, 300, method=method, visibility=look, config=one).splats
    assert same.fingerprint() == plain.fingerprint()


def test_views_count_as_if_they_stood_nearer() -> None:
    """A far camera counts like one at half the distance."""
    scene = g2ard.Splats.create([[0, 0, 0]], scales=np.full((1, 3), 0.05), logit_opacities=[3])
    far, near = (
        g2ard.Cameras.of(
            [g2ard.Camera.facing([0, -away, 0], [0, 0, 0], width=200, height=200, fov=30)]
        )
        for away in (4.0, 2.0)
    )
    seen, nearer = (visibility_source(cameras)(scene) for cameras in (far, near))
    config = SimplifyConfig(keep_region=((0, 0, 0, 1),))
    found = emphasised(scene, seen, config)
    np.testing.assert_allclose(found.weight, nearer.weight, rtol=0.05)
    np.testing.assert_allclose(found.pixel_size, nearer.pixel_size, rtol=1e-5)


def test_regions_are_in_world_coordinates() -> None:
    dense = town(1200)
    moved = replace(dense, offset=np.array([4e5, 6e6, 50.0]))
    region = tuple(np.add(BALL, (4e5, 6e6, 50, 0)))
    seen = SampledVisibility(np.ones(1200, np.float32), np.full(1200, 0.02, np.float32))
    here, there = (
        reduce(scene, 120, visibility=seen, config=SimplifyConfig(keep_region=(spot,))).splats
        for scene, spot in ((dense, BALL), (moved, region))
    )
    np.testing.assert_array_equal(here.means, there.means)


@pytest.mark.parametrize(
    ("region", "said"),
    [
        ((1, 2, 3), "expected X,Y,Z,R or X,Y,Z,X,Y,Z, got 1, 2, 3"),
        ((0, 0, 0, 0), "expected a radius > 0"),
        ((0, 0, 0, 1, 1, 0), "the lower corner comes first"),
        ((0, 0, 0, float("nan")), "got 0, 0, 0, nan"),
    ],
)
def test_invalid_regions_are_named(region: tuple[float, ...], said: str) -> None:
    with pytest.raises(InputError, match=said):
        check_region(region)
    with pytest.raises(InputError, match=said):
        SimplifyConfig(keep_region=(region,))


def test_the_commands(command_line: CommandLine, tmp_path: Path) -> None:
    town_in(tmp_path, 3000)

    def run(*args: object) -> str:
        return succeeds(command_line, tmp_path, *args).err

    common = ("town.ply", "-r", 10, "--views", "views.json")
    spot = ("--keep-region", "2.5,0,0,2")
    run("simplify", *common, "-o", "plain.ply")
    assert "in the regions to keep" in run(
        "simplify", *common, *spot, "-o", "kept.ply", "--json", "kept.json"
    )
    assert json.loads((tmp_path / "kept.json").read_text())["settings"]["simplify.keep_region"] == [
        [2.5, 0, 0, 2]
    ]
    run("simplify", *common, *spot, "--tile-rows", 1000, "--workers", 1, "-o", "tiles.ply")
    run("distill", *common, *spot, "--steps", 5, "--size", 48, "-o", "run", "--no-page")
    plain = share(read_splats(tmp_path / "plain.ply"), BALL)
    for name in ("kept.ply", "tiles.ply", "run/scene.ply"):
        assert share(read_splats(tmp_path / name), BALL) > 1.3 * plain, name
    ask = (
        "simplify",
        *common,
        "--keep-region",
        "0,0,90,1",
        "--tile-rows",
        1000,
        "--workers",
        1,
        "-o",
        "no.ply",
    )
    status, _, error = command_line(*ask, cwd=tmp_path)
    assert (status, "contains none of the 3,000 Gaussians of a sample" in error) == (1, True), error
    assert not (tmp_path / "no.ply").exists()
