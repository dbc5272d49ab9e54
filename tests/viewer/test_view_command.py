"""`g2ard view` without -o: pages served to this machine until Ctrl-C."""

import json
import re
import signal
from pathlib import Path
from urllib.request import urlopen

import pytest

import g2ard
from helpers.commands import CommandLine, program, refused, succeeds
from helpers.photos import cloud_of
from helpers.scenes import around, checkered_ball

BALL = checkered_ball(200)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("BROWSER", "true")
    g2ard.save(tmp_path / "ball.ply", BALL)
    run = tmp_path / "run"
    run.mkdir()
    g2ard.save(run / "scene.ply", BALL.take(range(90)))
    g2ard.save_views(run / "views.json", around(4, (48, 36)))
    report = {
        "against": "the dense scene",
        "config": {"scene": "ball.ply", "size": None},
        "settings": {},
    }
    (run / "report.json").write_text(json.dumps(report))
    levels = tmp_path / "levels"
    levels.mkdir()
    (levels / "index.html").write_text("levels here")
    (levels / "lod-meta.json").write_text("{}")
    return tmp_path


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("levels", ["levels here"]),
        ("run", ["dense scene: ball.ply, 200 Gaussians | result: run, 90 Gaussians"]),
    ],
)
def test_a_page_is_served_until_ctrl_c(folder: Path, path: str, words: list[str]) -> None:
    running = program("view", path, folder=folder, stderr=-1)
    assert running.stderr is not None
    address = None
    for line in running.stderr:
        if found := re.search(rb"http://127\.0\.0\.1:\d+/\S+", line):
            address = found[0].decode()
            break
    assert address is not None
    with urlopen(address, timeout=30) as answer:
        text = answer.read().decode()
    assert all(word in text for word in words)
    running.send_signal(signal.SIGINT)
    assert running.wait(60) == 0
    assert {item.name for item in folder.iterdir()} == {"ball.ply", "run", "levels"}


@pytest.mark.parametrize("words", ["levels ball.ply", "levels --views made"])
def test_levels_are_shown_alone(words: str, folder: Path, command_line: CommandLine) -> None:
    refused(command_line, folder, "view", *words.split())


@pytest.mark.parametrize("shown", ["run", "run/scene.ply"])
def test_a_result_of_a_cloud_has_a_sky(shown: str, folder: Path, command_line: CommandLine) -> None:
    """Show a sky in the gaps between points, as the run's view.html does."""
    words = ("view", shown, "-o", "page.html", "-w")
    succeeds(command_line, folder, *words)
    assert '"background": [' in (folder / "page.html").read_text()
    cloud_of(folder / "cloud.ply", BALL)
    file = folder / "run" / "report.json"
    file.write_text(file.read_text().replace("ball.ply", "cloud.ply"))
    succeeds(command_line, folder, *words)
    assert '"background": null' in (folder / "page.html").read_text()
