"""An output is there whole or not at all."""

import os
from pathlib import Path

import pytest

from g2ard.errors import OutputError
from g2ard.io import atomic_folder, atomic_output, check_output
from helpers.systems import needs_modes


def test_whole_file_appears(tmp_path: Path) -> None:
    with atomic_output(tmp_path / "a.ply") as temporary:
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".ply"
        temporary.write_text("new")
        assert not (tmp_path / "a.ply").exists()
    assert [p.name for p in tmp_path.iterdir()] == ["a.ply"]


def test_permissions_follow_the_umask(tmp_path: Path) -> None:
    with atomic_output(tmp_path / "a") as temporary:
        temporary.write_text("new")
    (tmp_path / "b").write_text("plain")
    assert (tmp_path / "a").stat().st_mode == (tmp_path / "b").stat().st_mode


def half_write(path: Path, error: BaseException, folder: bool = False) -> None:
    with (atomic_folder if folder else atomic_output)(path, True) as temporary:
        (temporary / "a" if folder else temporary).write_text("half")
        raise error


@pytest.mark.parametrize("folder", [False, True])
@pytest.mark.parametrize("error", [ValueError(), KeyboardInterrupt(), OSError(28, "No space left on device")])
def test_failure_leaves_nothing_and_the_old_file(tmp_path: Path, error: BaseException, folder: bool) -> None:
    (tmp_path / "a").write_text("old")
    with pytest.raises((ValueError, KeyboardInterrupt, OutputError)) as caught:
        half_write(tmp_path / ("b" if folder else "a"), error, folder)
    if isinstance(error, OSError):
        assert "cannot write: No space left" in str(caught.value)
    assert [p.name for p in tmp_path.iterdir()] == ["a"]
    assert (tmp_path / "a").read_text() == "old"


def test_a_failing_input_keeps_its_own_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), atomic_output(tmp_path / "a"):
        (tmp_path / "input").read_text()


def test_existing_needs_overwrite(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("old")
    with pytest.raises(OutputError, match="exists; overwrite=True"):
        check_output(tmp_path / "a")
    with atomic_output(tmp_path / "a", overwrite=True) as temporary:
        temporary.write_text("new")
    assert (tmp_path / "a").read_text() == "new"


def test_absent_folders_are_made_with_the_output_and_not_before(tmp_path: Path) -> None:
    path = tmp_path / "no" / "where" / "a.ply"
    assert check_output(path) == path
    assert not (tmp_path / "no").exists()
    with pytest.raises(ValueError):
        half_write(path, ValueError())
    assert not (tmp_path / "no").exists()
    with atomic_output(path) as temporary:
        temporary.write_text("new")
    assert path.read_text() == "new"
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="file is a file"):
        check_output(tmp_path / "file" / "a.ply")


@needs_modes
def test_unwritable_folder(tmp_path: Path) -> None:
    where = Path("/proc/1") if os.geteuid() == 0 else tmp_path / "locked"
    if where.parent == tmp_path:
        where.mkdir(mode=0o500)
    with pytest.raises(OutputError, match="cannot write there"):
        check_output(where / "a.ply")


def test_another_kind_in_the_way(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="is a folder"):
        check_output(tmp_path, overwrite=True)
    (tmp_path / "out").write_text("a file")
    with pytest.raises(OutputError, match="is a file"), atomic_folder(tmp_path / "out", overwrite=True):
        pass


def test_folder_appears_whole(tmp_path: Path) -> None:
    with atomic_folder(tmp_path / "out") as temporary:
        (temporary / "deep").mkdir()
        (temporary / "deep" / "a").write_text("new")
        assert not (tmp_path / "out").exists()
    assert (tmp_path / "out" / "deep" / "a").read_text() == "new"
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_folder_overwrites_only_its_own_names(tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "a").write_text("old")
    (out / "mine").write_text("mine")
    with pytest.raises(OutputError, match="exists"), atomic_folder(out):
        pass
    with atomic_folder(out, overwrite=True) as temporary:
        (temporary / "a").write_text("new")
    assert (out / "a").read_text() == "new"
    assert (out / "mine").read_text() == "mine"
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("links", [True, False])
@pytest.mark.parametrize("folder", [False, True])
def test_what_another_process_made_meanwhile_is_kept(
    tmp_path: Path, folder: bool, links: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unsupported(*paths: object) -> None:
        raise PermissionError(1, "Operation not permitted")  # as on exFAT

    if not links:
        monkeypatch.setattr(os, "link", unsupported)
    path = tmp_path / "a"
    theirs, output = (path / "b", atomic_folder) if folder else (path, atomic_output)

    def written_second() -> None:
        with output(path) as own:
            (own / "b" if folder else own).write_text("second")
            theirs.parent.mkdir(exist_ok=True)
            theirs.write_text("first")

    with pytest.raises(OutputError, match="a: exists"):
        written_second()
    assert theirs.read_text() == "first"
    assert [file.name for file in tmp_path.iterdir()] == ["a"]
    with output(path.with_name("c")) as own:
        (own / "b" if folder else own).write_text("new")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a", "c"]
