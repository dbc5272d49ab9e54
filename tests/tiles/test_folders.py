"""Folders of tiles and of work: one process at a time, damage found or repaired, no user's file lost."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from g2ard.errors import InputError, OutputError
from g2ard.io.lock import LOCK, locked
from g2ard.io.tile_store import TileStore
from g2ard.levels import Cut, save_levels
from g2ard.tiles import ingest as ingest_module
from g2ard.tiles.ingest import ingest
from helpers.commands import CommandLine, refused, succeeds
from helpers.interruptions import interrupt_at
from helpers.level_files import files_of
from helpers.tiled_scenes import reduced, town_in

BLIND = ("--no-views", "--workers", "1", "--tile-rows", "700")


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = town_in(tmp_path_factory.mktemp("folders"), 1600)
    ingest(folder / "town.ply", folder / "tiles", tile_rows=700)
    return folder


def flipped(path: Path) -> None:
    """Flip one bit of a file."""
    content = bytearray(path.read_bytes())
    content[100] ^= 1
    path.write_bytes(content)


def test_a_folder_has_one_live_owner(tmp_path: Path) -> None:
    holds = (
        "import sys, time; from pathlib import Path; from g2ard.io.lock import locked\n"
        "with locked(Path(sys.argv[1])): print('held', flush=True); time.sleep(60)"
    )
    with subprocess.Popen(
        [sys.executable, "-c", holds, tmp_path], stdout=subprocess.PIPE
    ) as holder:
        try:
            assert holder.stdout.readline().strip() == b"held"
            with (
                pytest.raises(OutputError, match=f"in use by process {holder.pid};"),
                locked(tmp_path),
            ):
                pass
            assert (tmp_path / LOCK).exists()  # the holder's, not taken by who was refused
        finally:
            holder.kill()
    with locked(tmp_path):
        assert (tmp_path / LOCK).exists()
    assert not list(tmp_path.iterdir())


def test_two_ingests_do_not_meet(place: Path, tmp_path: Path) -> None:
    folder = tmp_path / "tiles"
    folder.mkdir()
    with locked(folder), pytest.raises(OutputError, match="tiles: in use by process"):
        ingest(place / "town.ply", folder, tile_rows=700)
    assert ingest(place / "town.ply", folder, tile_rows=700).count == 1600
    assert not (folder / LOCK).exists()


def test_a_work_folder_serves_one_command_at_a_time(
    command_line: CommandLine, place: Path, tmp_path: Path
) -> None:
    simplify = ("simplify", place / "town.ply", "-n", 300, *BLIND, "-o", "a.ply", "--work", "work")
    (tmp_path / "work").mkdir()
    with locked(tmp_path / "work"):
        status, _, said = command_line(*simplify, cwd=tmp_path)
    assert (status, "work: in use by process" in said, said.count("\n")) == (1, True, 1), said
    succeeds(command_line, tmp_path, *simplify)


@pytest.mark.parametrize("length", [100, 10_000_000])
def test_tiles_of_another_length_are_poured_again(place: Path, tmp_path: Path, length: int) -> None:
    folder, said = tmp_path / "tiles", list[str]()
    whole = ingest(place / "town.ply", folder, tile_rows=700)
    before = files_of(folder)
    with (folder / "tile-00000.f32").open("r+b") as file:
        file.truncate(length)
    again = ingest(place / "town.ply", folder, tile_rows=700, say=said.append)
    assert (again.tiles, files_of(folder)) == (whole.tiles, before)
    assert "damaged" in said[0]
    with (folder / "tile-00000.f32").open("r+b") as file:
        file.truncate(length)
    # of other settings it is not replaced unasked
    with pytest.raises(InputError, match="the manifest says"):
        ingest(place / "town.ply", folder, tile_rows=800)


@pytest.mark.parametrize("name", ["tile-00001.f32", "halo-00000.f32"])
def test_damaged_tiles_are_written_again_on_request(
    name: str, place: Path, tmp_path: Path, command_line: CommandLine
) -> None:
    words = ("ingest", place / "town.ply", "-o", "tiles", "--tile-rows", 700)
    succeeds(command_line, tmp_path, *words)
    before = files_of(tmp_path / "tiles")
    flipped(tmp_path / "tiles" / name)
    times = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "tiles").glob("*.f32")}
    assert "skipped" in succeeds(command_line, tmp_path, *words).err
    assert "1 tile damaged" in succeeds(command_line, tmp_path, *words, "-w").err
    assert files_of(tmp_path / "tiles") == before
    written = {
        path
        for path, then in times.items()
        if (tmp_path / "tiles" / path).stat().st_mtime_ns != then
    }
    assert written == {
        name.replace("tile-", kind).replace("halo-", kind) for kind in ("tile-", "halo-")
    }


def test_damaged_tiles_of_a_work_folder_are_written_again_on_request(
    command_line: CommandLine, place: Path, tmp_path: Path
) -> None:
    words = ("simplify", place / "town.ply", *BLIND, "--work", "work", "-n")
    succeeds(command_line, tmp_path, *words, 300, "-o", "a.ply")
    flipped(tmp_path / "work" / "tiles" / "tile-00001.f32")
    status, _, said = command_line(*words, 299, "-o", "b.ply", cwd=tmp_path)
    assert (status, "tile-00001.f32: its contents changed" in said) == (1, True), said
    succeeds(command_line, tmp_path, *words, 300, "-o", "b.ply", "-w")
    assert (tmp_path / "b.ply").read_bytes() == (tmp_path / "a.ply").read_bytes()


def test_a_dry_run_of_ingest(place: Path, tmp_path: Path, command_line: CommandLine) -> None:
    words = ("ingest", place / "town.ply", "--tile-rows", 700, "--dry-run", "--json", "-")
    told = json.loads(succeeds(command_line, tmp_path, *words).out)
    assert (told["rows"], told["tiles"]) == (1600, 3)
    written = sum(path.stat().st_size for path in (place / "tiles").glob("*.f32"))
    assert written < told["disk"] < 4 * written
    assert not list(tmp_path.iterdir())


def test_a_step_that_was_cut_is_done_again(place: Path, tmp_path: Path) -> None:
    store = TileStore.open(place / "tiles")
    whole = reduced(store, tmp_path, budget=300)
    steps = {path: path.read_bytes() for path in tmp_path.iterdir()}
    for path in (p for p in steps if p.name.startswith(("costs", "merge-00001"))):
        path.write_bytes(path.read_bytes()[:100])
    again = reduced(store, tmp_path, budget=300)
    assert again.fingerprint() == whole.fingerprint()
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == steps
    for path in steps:
        if path.name.startswith("costs"):
            flipped(path)
        elif path.name.startswith(("plans", "merge")):
            path.unlink()
    with pytest.raises(
        InputError, match=r"costs-00000-\w+\.npz: its contents changed after writing; remove it"
    ):
        reduced(store, tmp_path, budget=300)


def test_steps_that_are_done_do_not_hide_damaged_tiles(place: Path, tmp_path: Path) -> None:
    store = ingest(place / "town.ply", tmp_path / "tiles", tile_rows=700)
    reduced(store, tmp_path / "steps", budget=300)
    flipped(store.folder / "tile-00001.f32")
    with pytest.raises(InputError, match=r"tile-00001\.f32: its contents changed"):
        reduced(store, tmp_path / "steps", budget=299)
    with pytest.raises(InputError, match=r"tile-00001\.f32: its contents changed"):
        reduced(store, tmp_path / "steps", budget=1600)


def test_levels_are_not_written_from_damaged_tiles(place: Path, tmp_path: Path) -> None:
    store, work = ingest(place / "town.ply", tmp_path / "tiles", tile_rows=700), tmp_path / "work"
    work.mkdir()

    stop = interrupt_at("write", 2)

    with pytest.raises(KeyboardInterrupt):
        save_levels(tmp_path / "out", [store], cut=Cut(most=200), work=work, progress=stop)
    flipped(store.folder / "tile-00001.f32")
    with pytest.raises(InputError, match=r"tile-00001\.f32: its contents changed"):
        save_levels(tmp_path / "out", [store], cut=Cut(most=200), work=work)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--views", "nothere"), "nothere: no such file"),
        (("--no-views", "--scheduler", "tcp://127.0.0.1:9"), "no answer"),
    ],
)
def test_invalid_options_are_rejected_before_any_work(
    command_line: CommandLine,
    place: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    options: tuple[str, ...],
    told: str,
) -> None:
    if "--scheduler" in options:
        distributed = pytest.importorskip("distributed")
        client = distributed.Client

        def hasty(address: str, **more: object) -> object:
            return client(address, **{**more, "timeout": "1s"})

        monkeypatch.setattr(distributed, "Client", hasty)
    monkeypatch.setattr(ingest_module, "Pouring", lambda *_: pytest.fail("poured"))
    tiled = ("simplify", place / "town.ply", "-n", 300, "--tile-rows", "700", "-o", "deep/a.ply")
    assert told in refused(command_line, tmp_path, *tiled, *options, status=1)
    assert not list(tmp_path.iterdir())


def test_errors_leave_no_copy_of_the_scene(
    command_line: CommandLine, place: Path, tmp_path: Path
) -> None:
    tiled = ("simplify", place / "town.ply", *BLIND, "-o", "a.ply")
    for count in (9999, 2):
        status, _, said = command_line(*tiled, "-n", count, cwd=tmp_path)
        assert status == 1, said
        assert not list(tmp_path.iterdir())
    status, _, said = command_line(*tiled, "--fit", "page:1kB", cwd=tmp_path)  # after steps
    assert (status, "too few" in said, "kept in .a.ply.tiles" in said) == (1, True, True)
    assert (tmp_path / ".a.ply.tiles" / "steps").is_dir()
    succeeds(command_line, tmp_path, *tiled, "-n", 300)
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]


def test_work_rejects_a_folder_with_other_files(
    command_line: CommandLine, place: Path, tmp_path: Path
) -> None:
    tiled = ("simplify", place / "town.ply", "-n", 300, *BLIND)
    own, tiles = tmp_path / "own", tmp_path / "tiles"
    own.mkdir()
    (own / "letter.txt").write_text("dear")
    ingest(place / "town.ply", tiles, tile_rows=800)
    for folder, held in ((own, "letter.txt"), (tiles, "halo-00000.f32")):
        before = files_of(folder)
        assert f"{folder.name}: holds {held}" in refused(
            command_line, tmp_path, *tiled, "-o", "a.ply", "--work", folder, status=1
        )
        assert files_of(folder) == before
    status, _, said = command_line(*tiled, "-o", "b", "--work", "b", cwd=tmp_path)
    said = " ".join(said.split())
    assert (status, "b is written by --work too" in said) == (2, True), said
    for _ in range(2):  # one that was made so is taken again
        succeeds(command_line, tmp_path, *tiled, "-o", "a.ply", "-w", "--work", "work")


def test_an_unfinished_ingest_is_named(
    command_line: CommandLine, place: Path, tmp_path: Path
) -> None:
    (tmp_path / "begun").mkdir()
    (tmp_path / "begun" / "tile-00000.f32").write_bytes(b"")
    for call in (("info", "begun"), ("simplify", "begun", "-n", 300, "-o", "a.ply")):
        assert "begun: has unfinished tiles; run the same `g2ard ingest` again" in refused(
            command_line, tmp_path, *call, status=1
        )
    (tmp_path / "empty").mkdir()
    assert "tiles.json" in command_line("info", "empty", cwd=tmp_path)[2]


def test_tiles_are_not_too_many(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ingest_module, "MOST_TILES", 10)
    with pytest.raises(
        InputError, match="1,600 rows are too many for tiles of 159; use at least 160"
    ):
        ingest(place / "town.ply", tmp_path / "tiles", tile_rows=159)
    assert not (tmp_path / "tiles").exists()
    assert ingest(place / "town.ply", tmp_path / "tiles", tile_rows=160).count == 1600


def test_rows_of_tiles_that_lie_in_a_folder_are_theirs(
    command_line: CommandLine, place: Path
) -> None:
    ask = ("simplify", "tiles", "-r", "10", "-o", "x.ply", "--tile-rows")
    told = refused(command_line, place, *ask, "1k")
    assert (
        "--tile-rows: tiles already has tiles of 700; to change them, run `g2ard ingest tiles"
        in told
    )
    ask = (*ask, "700", "--dry-run")
    succeeds(command_line, place, *ask)  # the same rows are no other


@pytest.mark.parametrize("extent", ["inf", "nan", "0", "-1"])
def test_extents_are_finite(extent: str) -> None:
    with pytest.raises(InputError, match="extent: expected a finite number"):
        Cut(extent=float(extent))
