"""Options that tiles do not support or that are out of range: one line that names the option as typed."""

from pathlib import Path

import pytest

from g2ard.errors import InputError
from g2ard.jobs.distill_options import DistillOptions
from g2ard.jobs.tiling import needs_whole
from g2ard.levels import Cut
from g2ard.tiles.ingest import ingest
from helpers.commands import CommandLine, refused
from helpers.tiled_scenes import town_in


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = town_in(tmp_path_factory.mktemp("town"), 3000, views=4)
    ingest(folder / "town.ply", folder / "tiles", tile_rows=1500)
    return folder


_SIMPLIFY = ("simplify", "-r", "10", "-o", "x.ply")
_DISTILL = ("distill", "-r", "10", "-o", "x", "--views", "views.json")


@pytest.mark.parametrize(
    ("command", "given", "named"),
    [
        (_SIMPLIFY, "--method fast", "--method fast"),
        (_SIMPLIFY, "--preset paper", "--preset paper"),
        (_SIMPLIFY, "--parents p.npy", "--parents"),
        (_DISTILL, "--method fast", "--method fast"),
        (_DISTILL, "--preset paper-lift", "--preset paper-lift"),
        (_DISTILL, "--schedule paper", "--schedule paper"),
        (_DISTILL, "--photos", "--photos"),
        (_DISTILL, "--set views_count=10", "--set select.views_count"),
        (_DISTILL, "--clean", "--clean"),
        (_SIMPLIFY, "--set morton_premerge_steps=3", "--set simplify.morton_premerge_steps"),
        (_DISTILL, "--set morton_premerge_steps=3", "--set simplify.morton_premerge_steps"),
        (_DISTILL, "--recovery-time 5m", "--recovery-time"),
        (("simplify", "-o", "x.ply"), "--min-ssim 0.9", "--min-ssim 0.9"),
        (("distill", "-o", "x", "--format", "sog"), "--fit 50kB", "--fit 50kB"),
    ],
)
def test_options_that_need_one_piece_are_named_as_typed(
    command_line: CommandLine, folder: Path, command: tuple[str, ...], given: str, named: str
) -> None:
    words = (*command, "town.ply", *given.split(), "--tile-rows", "1500")
    told = refused(command_line, folder, *words, status=1)
    end = "but it is processed in tiles; use --tile-rows 3,000 for one piece"
    assert told == f"g2ard: town.ply: {named} needs the whole scene in memory, {end}\n"
    assert not (folder / "x").exists()


@pytest.mark.parametrize("rows", [(), ("--tile-rows", "1500")])
def test_a_trained_scene_is_not_lifted(
    command_line: CommandLine, folder: Path, rows: tuple[str, ...]
) -> None:
    told = refused(command_line, folder, *_DISTILL, "town.ply", "--set", "lift.spread=2", *rows, status=1)
    assert "lift.spread: has no effect on a trained scene" in told
    assert {path.name for path in folder.iterdir()} == {"town.ply", "views.json", "tiles"}


def test_several_whole_options_are_named_together(command_line: CommandLine, folder: Path) -> None:
    told = refused(command_line, folder, *_DISTILL, "tiles", "--clean", "--photos", status=1)
    assert "tiles: --clean and --photos need the whole scene in memory" in told
    assert "use `g2ard ingest tiles -o DIR --tile-rows 3,000` for one piece" in told
    assert needs_whole(DistillOptions().config) == []
    assert needs_whole(DistillOptions(settings={"engine": "gsplat"}).config) == ["--engine"]


def test_rows_of_tiles_that_lie_in_a_folder_are_theirs(command_line: CommandLine, folder: Path) -> None:
    told = refused(command_line, folder, *_SIMPLIFY, "tiles", "--tile-rows", "1k")
    assert "--tile-rows: tiles already has tiles of 1,500; to change them, run `g2ard ingest tiles" in told
    told = refused(
        command_line, folder, *_SIMPLIFY, "tiles", "--tile-rows", "1500", "--method", "fast", status=1
    )
    assert "--method fast" in told  # the same rows are no other


@pytest.mark.parametrize("rows", ["0", "25%", "200%", "x"])
def test_tile_rows_is_a_count_not_a_share(command_line: CommandLine, folder: Path, rows: str) -> None:
    for words in (_SIMPLIFY, ("ingest", "-o", "other")):
        told = refused(command_line, folder, *words, "town.ply", "--tile-rows", rows)
        assert f"'--tile-rows': expected a positive count such as 250000, 250k or 1.5M, got '{rows}'" in told


@pytest.mark.parametrize("extent", ["inf", "nan", "0", "-1"])
@pytest.mark.parametrize("tiled", [(), ("--tile-rows", "1500")])
def test_extents_are_finite(
    command_line: CommandLine, folder: Path, extent: str, tiled: tuple[str, ...]
) -> None:
    told = refused(command_line, folder, "lod", "town.ply", "-o", "x", "--chunk-extent", extent, *tiled)
    assert "--chunk-extent: expected a finite number above 0, got" in told
    with pytest.raises(InputError, match="extent: expected a finite number"):
        Cut(extent=float(extent))


def test_ratios_that_do_not_rise_are_usage(command_line: CommandLine, folder: Path) -> None:
    told = refused(command_line, folder, "lod", "town.ply", "-o", "x", "-r", "2,1")
    assert "--ratios: expected rising numbers of at least 1, got 2, 1" in told
