"""Names of outputs, words of the summary, and refusals before any work, as a new user meets them."""

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import g2ard
from g2ard.cli.app import COMMANDS
from g2ard.cli.resume import tell_start
from g2ard.errors import OutputError
from g2ard.scene.transform import change_of_axes
from helpers.commands import CommandLine, refused, succeeds
from helpers.photos import photos_of
from helpers.scenes import around, checkered_ball

BALL = checkered_ball(300)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    g2ard.save(tmp_path / "ball.ply", BALL)
    g2ard.save_views(tmp_path / "views.json", around(8, (48, 36)))
    return tmp_path


@pytest.mark.parametrize("command", COMMANDS)
def test_a_missing_output_names_the_commands_own_options(
    command: str, command_line: CommandLine, folder: Path
) -> None:
    status, _, error = command_line(command, "ball.ply", "ball.ply", cwd=folder)
    if status == 2 and ": missing " in error:
        named = set(re.findall(r"--?[a-z][a-z-]*", error.split(": missing ")[1].split(" (see")[0]))
        _, text, _ = command_line(command, "--help-all", cwd=folder)
        assert named <= set(re.findall(r"--?[a-z][a-z-]*", text)), error
        assert ("budget" in error) == ("--min-psnr" in text)


@pytest.mark.parametrize("name", ["run.ply", "run.sog", "a.spz", "page.html"])
@pytest.mark.parametrize(
    "command", ["distill absent.ply -n 5", "lod absent.ply", "ingest absent.ply"]
)
def test_a_files_name_for_a_folder_is_refused(
    command: str, name: str, command_line: CommandLine, folder: Path
) -> None:
    error = refused(command_line, folder, *command.split(), "-o", name)
    assert name in error
    assert not (folder / name).exists()


def test_save_refuses_an_existing_file_before_the_work(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from g2ard.io import sog_write

    (folder / "a.sog").write_bytes(b"mine")
    monkeypatch.setattr(sog_write, "sog_bytes", lambda *_: pytest.fail("packed"))
    with pytest.raises(OutputError, match="exists"):
        g2ard.save(folder / "a.sog", BALL)
    assert (folder / "a.sog").read_bytes() == b"mine"


@pytest.mark.parametrize(("name", "letters"), [("y-up", "RUB"), ("z-up", "RFU")])
def test_axes_by_the_direction_of_up(
    name: str, letters: str, command_line: CommandLine, folder: Path
) -> None:
    np.testing.assert_array_equal(change_of_axes("RDF", name), change_of_axes("RDF", letters))
    for axes in (name, letters):
        succeeds(command_line, folder, "convert", "ball.ply", f"{axes}.ply", "--to-axes", axes)
        back = ("convert", f"{axes}.ply", f"{axes}_back.ply", "--from-axes", axes)
        succeeds(command_line, folder, *back)
    assert (folder / f"{name}.ply").read_bytes() == (folder / f"{letters}.ply").read_bytes()
    np.testing.assert_allclose(g2ard.load(folder / f"{name}_back.ply").means, BALL.means, atol=1e-6)


def test_a_file_that_fits_needs_nothing(folder: Path, command_line: CommandLine) -> None:
    ask = ("simplify", "ball.ply", "--fit", "5MB", "--no-views", "-o")
    told = succeeds(command_line, folder, *ask, "same.ply").err
    assert "nothing to do: ball.ply has 0.03 MB, which already fits 5MB" in told
    assert len(g2ard.load(folder / "same.ply")) == len(BALL)
    g2ard.save(folder / "ball.compressed.ply", BALL)
    size = (folder / "ball.compressed.ply").stat().st_size
    ask = (
        "simplify",
        "ball.compressed.ply",
        "--fit",
        f"{size / 1000 + 1}kB",
        "--no-views",
        "-o",
        "small.ply",
    )
    told = succeeds(command_line, folder, *ask).err
    assert "kB; only its size as .ply counts" in told
    assert "nothing to do" not in told
    assert len(g2ard.load(folder / "small.ply")) < len(BALL)


def test_photos_alone_are_counted_as_photos(tmp_path: Path, command_line: CommandLine) -> None:
    photos_of(tmp_path / "shots", count=9)
    ask = (
        "distill",
        "--views",
        "shots",
        "-n",
        60,
        "--steps",
        2,
        "--no-page",
        "-o",
        "run",
        "--format",
        "sog",
    )
    told = succeeds(command_line, tmp_path, *ask).err
    assert re.findall(r"(?m)^(\d+ \w+) → 60 Gaussians", told) == ["7 photos"] * 2
    assert re.search(r"(?m)^7 photos → 60 Gaussians, [\d.]+ MB as .sog; ", told)
    assert "7 photos → 60 Gaussians" in (tmp_path / "run" / "report.html").read_text()


def test_progress_and_summary_use_the_same_words(tmp_path: Path) -> None:
    stages: set[str] = set()

    def stopped(stage: str, done: int, total: int, info: Any = None) -> None:
        stages.add(stage)
        if stage == "recover" and done > 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        g2ard.distill(
            BALL,
            count=40,
            views=around(8, (48, 36)),
            steps=20,
            work=tmp_path / "work",
            progress=stopped,
            settings={"focus": "far"},
        )
    assert {"targets", "simplify", "recover"} <= stages  # as in the seconds of the summary
    assert not {"teacher", "rates"} & stages
    told: list[str] = []
    tell_start(SimpleNamespace(say=told.append), tmp_path / "work", Path("run"))  # type: ignore[arg-type]
    assert re.fullmatch(
        r"run: continues (after [\w, -]+|from step \d+|after .* from step \d+)", told[0]
    )
