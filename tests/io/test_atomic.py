"""An output is there whole or not at all."""

import os
import socket
import stat
from contextlib import suppress
from pathlib import Path

import pytest

from g2ard.errors import OutputError
from g2ard.io import atomic_folder, atomic_output, check_output, write_splats
from g2ard.io.atomic import drop_temporaries
from g2ard.io.scene_formats import FORMATS
from helpers.scenes import checkered_ball
from helpers.systems import needs_links, needs_modes


@pytest.mark.parametrize("folder", [False, True])
def test_an_output_appears_whole(tmp_path: Path, folder: bool) -> None:
    with (atomic_folder if folder else atomic_output)(tmp_path / "a.ply") as temporary:
        assert (temporary.parent, temporary.suffix) == (tmp_path, ".ply")
        part = temporary / "deep" / "a" if folder else temporary
        part.parent.mkdir(exist_ok=True)
        part.write_text("new")
        assert not (tmp_path / "a.ply").exists()
    assert [path.name for path in tmp_path.rglob("*")] == ["a.ply", "deep", "a"][
        : 3 if folder else 1
    ]
    with pytest.raises(
        OutputError, match="exists; overwrite=True" if not folder else "is a folder"
    ):
        check_output(tmp_path / "a.ply")
    if not folder:
        with atomic_output(tmp_path / "a.ply", overwrite=True) as temporary:
            temporary.write_text("newer")
        assert (tmp_path / "a.ply").read_text() == "newer"


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
@pytest.mark.parametrize(
    "error", [ValueError(), KeyboardInterrupt(), OSError(28, "No space left on device")]
)
def test_failure_leaves_nothing_and_the_old_file(
    tmp_path: Path, error: BaseException, folder: bool
) -> None:
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
    with (
        pytest.raises(OutputError, match="is a file"),
        atomic_folder(tmp_path / "out", overwrite=True),
    ):
        pass


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


@needs_links
@pytest.mark.parametrize("folder", [False, True])
@pytest.mark.parametrize("there", [False, True])
def test_a_link_stays_and_its_target_is_replaced(tmp_path: Path, folder: bool, there: bool) -> None:
    target, link = tmp_path / "elsewhere" / "a", tmp_path / "out" / "link"
    target.parent.mkdir()
    link.parent.mkdir()
    if there:
        target.write_text("old")
    link.symlink_to("../elsewhere/a")
    if there and not folder:
        with pytest.raises(OutputError, match="exists; overwrite=True"):
            check_output(link)
    with atomic_folder(link.parent, True) if folder else atomic_output(link, there) as temporary:
        (temporary / "link" if folder else temporary).write_text("new")
        assert target.exists() == there
    assert (os.readlink(link), target.read_text()) == ("../elsewhere/a", "new")
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["a", "elsewhere", "link", "out"]


@needs_links
def test_a_link_to_a_folder_stays(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    (tmp_path / "link").symlink_to("there")
    with atomic_folder(tmp_path / "link") as temporary:
        (temporary / "a").write_text("new")
    assert (tmp_path / "link").is_symlink()
    assert [path.name for path in (tmp_path / "there").iterdir()] == ["a"]


@needs_links
def test_a_link_to_itself_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a").symlink_to("a")
    for overwrite in (False, True):
        with pytest.raises(OutputError, match="a: is a link to itself"):
            check_output(tmp_path / "a", overwrite)
    assert (tmp_path / "a").is_symlink()


def null_device(path: Path) -> None:
    """Make a device that takes everything, or skip the test."""
    try:
        os.mknod(path, 0o666 | stat.S_IFCHR, os.makedev(1, 3))
        path.write_bytes(b"")
    except (AttributeError, OSError):
        pytest.skip("this system or user cannot make devices")


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("within", ["a", "link", "folder"])
def test_a_device_is_written_to_and_stays(tmp_path: Path, within: str, overwrite: bool) -> None:
    out = tmp_path / "out"
    out.mkdir()
    null_device(out / "a")
    (tmp_path / "link").symlink_to("out/a")
    if within == "folder":
        with atomic_folder(out, overwrite=True) as temporary:
            (temporary / "a").write_text("new")
    else:
        path = out / "a" if within == "a" else tmp_path / "link"
        with atomic_output(check_output(path, overwrite), overwrite) as temporary:
            temporary.write_text("new")
    assert stat.S_ISCHR((out / "a").stat().st_mode)
    assert (tmp_path / "link").is_symlink()
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["a", "link", "out"]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no pipes with names")
@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("fails", [False, True])
def test_the_reader_of_a_pipe_gets_the_whole_output_or_nothing(
    tmp_path: Path, overwrite: bool, fails: bool
) -> None:
    os.mkfifo(tmp_path / "pipe")
    descriptor = os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK)
    with suppress(ValueError), atomic_output(tmp_path / "pipe", overwrite) as temporary:
        temporary.write_text("new")
        if fails:
            raise ValueError
    assert os.read(descriptor, 100) == (b"" if fails else b"new")
    os.close(descriptor)
    assert stat.S_ISFIFO((tmp_path / "pipe").stat().st_mode)
    assert [path.name for path in tmp_path.iterdir()] == ["pipe"]


@pytest.mark.skipif(not Path("/dev/fd").exists(), reason="this system has no names for open files")
@pytest.mark.parametrize("linked", [False, True])
def test_an_open_file_is_continued(tmp_path: Path, linked: bool) -> None:
    with (tmp_path / "log").open("w") as log:
        log.write("before, ")
        log.flush()
        path = Path("/dev/fd", str(log.fileno()))
        if linked:
            (tmp_path / "link").symlink_to(path)
            path = tmp_path / "link"
        with atomic_output(path) as temporary:
            temporary.write_text("within, ")
        log.write("after")
    assert (tmp_path / "log").read_text() == "before, within, after"
    assert (tmp_path / "link").is_symlink() == linked


@pytest.mark.skipif(not hasattr(socket, "AF_UNIX"), reason="this system has no sockets with names")
def test_a_socket_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # its path may be long
    with socket.socket(socket.AF_UNIX) as own:
        own.bind("a")
        with pytest.raises(OutputError, match="a: is a block device or socket"):
            check_output("a", overwrite=True)
    assert stat.S_ISSOCK(Path("a").stat().st_mode)


@needs_links
@pytest.mark.parametrize("name", [f"a.{name}" for name in FORMATS] + ["a.csv", "a/meta.json"])
def test_every_writer_keeps_links(tmp_path: Path, name: str) -> None:
    from g2ard.io.scenes import write_table

    if name.endswith("usdc"):
        pytest.importorskip("pxr")
    (tmp_path / "out").mkdir()
    link = tmp_path / name
    link.parent.mkdir(exist_ok=True)
    link.symlink_to(tmp_path / "out" / link.name)
    write = write_table if name == "a.csv" else write_splats
    for again in (False, True):
        write(link, checkered_ball(20), overwrite=again or link.name == "meta.json")
        assert link.is_symlink()
        assert (tmp_path / "out" / link.name).stat().st_size


def test_leftovers_are_those_of_the_named_outputs(tmp_path: Path) -> None:
    """Hidden names of killed processes go; everything else stays."""
    random = "0123456789ab"
    ours = [f".a.{random}.ply", f".a.b.{random}.ply", f".out.{random}"]
    kept = [
        "a.ply",
        f".a.{random}.txt",
        f".b.{random}.ply",
        ".a.012345.ply",
        f"a.{random}.ply",
        ".a.ply.lock",
    ]
    for name in [*ours, *kept]:
        (tmp_path / name).mkdir() if name == ours[-1] else (tmp_path / name).touch()
    (tmp_path / ours[-1] / "part").touch()
    drop_temporaries(tmp_path, "a.ply", "a.b.ply", "out")
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(kept)
    drop_temporaries(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted({*kept} - {kept[1], kept[2]})
    drop_temporaries(tmp_path / "absent")
