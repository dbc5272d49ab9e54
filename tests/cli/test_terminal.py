"""Every command in a pseudo-terminal: the screen that it leaves, its exit status and its stdout."""

import json
import re
import shlex
import shutil
from collections.abc import Callable, Iterator
from functools import cache
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

import g2ard
from g2ard.cli.app import COMMANDS
from helpers.cloud_files import las
from helpers.commands import CommandLine
from helpers.photos import photographed, photos_of
from helpers.scenes import around, checkered_ball
from helpers.terminal import Screen, Terminal

pytest.importorskip("pty", reason="pseudo-terminals are POSIX")
pytest.importorskip("pyte")

MORE = {
    "distill": "--views poses.json --size 48 --steps 8",
    "simplify": "--views poses.json",
    "recover": "--steps 8",
    "adapt": "--steps 8",
    "register": "--focal 64 --matcher direct --keep all",
    "lift": "",
    "ingest": "--tile-rows 500",
    "convert": "",
    "clean": "",
    "poses": "-k 8",
    "select": "-k 4",
    "render": "--size 48",
    "view": "",
    "lod": "--views poses.json -r 1,4 --size 48 --steps 4",
    "evaluate": "",
    "compare": "--views poses.json --size 48",
    "info": "",
}
"""Options added to each command's example so that it is quick on the stand-ins for its files."""
DRAWN = {
    "distill": "recover",
    "simplify": "simplify",
    "recover": "recover",
    "adapt": "adapt",
    "register": "register",
    "clean": "depths",
    "evaluate": "evaluate",
}
"""Stages whose bars commands draw."""
TO_STDOUT = ("evaluate", "compare", "info")
KINDS: list[tuple[int, dict[str, str]]] = [
    (200, {}),
    (40, {"NO_COLOR": "1"}),
    (80, {"TERM": "dumb"}),
]
ENDLESS = {
    "distill": ("recover", "--steps 100000"),
    "recover": ("recover", "--steps 100000"),
    "adapt": ("adapt", "--steps 100000"),
    "lod": ("recover", "--steps 100000"),
    "simplify": ("visibility", "--views made"),
    "register": ("working", "--pool 20000"),
    "clean": ("visibility", ""),
    "poses": ("poses", "-k 20000"),
    "select": ("read", "--views many.json"),
    "render": ("render", "-k 400 --size 400"),
    "evaluate": ("targets", "--views many.json"),
    "compare": ("targets", "--views many.json"),
}
"""Long commands: a stage in which Ctrl-C is typed, and options that let it last."""
BAR = re.compile("^[^┏┡]*[━╸╺]|ETA|: working")
"""Parts of the live line; tables have such lines too."""


@cache
def example(command: str) -> list[str]:
    """Return the words of the example in a command's help, without the program's name, and its options."""
    from g2ard.cli.command import app

    import_module(f"g2ard.cli.commands.{command}")
    found = next(one.epilog for one in app.registered_commands if one.name == command)
    return [*shlex.split(found.removeprefix("Example: g2ard ")), *shlex.split(MORE[command]), "-w"]


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Stand-ins for the files of all examples."""
    folder = tmp_path_factory.mktemp("inputs")
    ball = checkered_ball(300)
    g2ard.save(folder / "scene.ply", ball)
    for name in ("garden", "dense", "room", "city"):
        shutil.copy(folder / "scene.ply", folder / f"{name}.ply")
    g2ard.save(folder / "small.ply", g2ard.simplify(ball, count=30).splats)
    g2ard.save(folder / "tree.spz", ball)
    (folder / "run").mkdir()
    shutil.copy(folder / "small.ply", folder / "run" / "scene.ply")
    (folder / "run" / "report.json").write_text("{}")
    g2ard.save_views(folder / "poses.json", around(12, (48, 36)))
    g2ard.save_views(folder / "many.json", around(500, (400, 300)))
    las(folder / "stadium.laz", ball.means.astype(float), np.full((300, 3), 9000, np.uint16))
    photos_of(folder / "winter", scene=ball, count=6)
    (folder / "new").mkdir()
    views = photographed(folder / "new", ball, around(2))
    (folder / "coarse.txt").write_text("".join(map(_ace, views.names, views.viewmats)))
    return folder


def _ace(name: str, pose: np.ndarray) -> str:
    w = np.sqrt(max(1 + np.trace(pose[:3, :3]), 1e-12)) / 2
    x, y, z = (pose[[2, 0, 1], [1, 2, 0]] - pose[[1, 2, 0], [2, 0, 1]]) / (4 * w)
    numbers = (w, x, y, z, *pose[:3, 3])
    return f"{name}.png {' '.join(map(str, numbers))}\n"


@pytest.fixture(scope="module")
def terminal() -> Iterator[Terminal]:
    started = Terminal()
    yield started
    started.close()


@pytest.fixture
def shown(terminal: Terminal, inputs: Path, tmp_path: Path) -> Callable[..., Screen]:
    """Runs a command's example with stand-ins in a new folder."""

    def run(command: str, *more: str, columns: int = 80, **how: str | bool) -> Screen:
        folder = tmp_path / "files"
        if not folder.exists():
            shutil.copytree(inputs, folder)
        return terminal.run([*example(command), *more], folder, columns, **how)

    return run


def assert_tidy(screen: Screen) -> None:
    assert screen.cursor, screen.received
    assert "Traceback" not in screen.received, screen.received
    assert not [line for line in screen.lines if BAR.search(line)], "\n".join(screen.lines)


def test_every_command_has_a_row() -> None:
    assert set(MORE) == set(COMMANDS)


def _timeless(text: str) -> str:
    """Return a text without floats, which may be times."""
    return re.sub(r"\d+\.\d+(e-\d+)?", "#", text)


@pytest.mark.parametrize("command", COMMANDS)
def test_any_terminal_ends_with_the_messages_of_a_pipe(
    command: str, shown: Callable[..., Screen], inputs: Path, command_line: CommandLine
) -> None:
    kinds = KINDS if command in DRAWN or command in TO_STDOUT else KINDS[:1]
    for columns, variables in kinds:
        screen = shown(command, columns=columns, **variables)
        assert screen.status == 0, screen.received
        assert_tidy(screen)
        if "NO_COLOR" in variables:
            assert not re.search(r"\x1b\[[\d;]*3\dm", screen.received), (
                "colours in spite of NO_COLOR"
            )
        elif variables.get("TERM") == "dumb":
            assert "\x1b" not in screen.received
        elif command in DRAWN:
            assert re.search(f"{DRAWN[command]}.*━", screen.received), "no bar was drawn"
        if columns < 200:
            continue
        if command not in TO_STDOUT:
            assert not screen.out
            continue
        status, out, _ = command_line(*example(command), cwd=inputs)
        assert (screen.status, _timeless(screen.out)) == (status, _timeless(out))


@pytest.mark.parametrize("columns", [40, 80])
@pytest.mark.parametrize("command", TO_STDOUT)
def test_results_on_the_terminal_itself(
    command: str, columns: int, shown: Callable[..., Screen], tmp_path: Path
) -> None:
    """Figures are whole, also where a terminal has no room for their table."""
    screen = shown(
        command, *["--json", "found.json"] * (command != "info"), columns=columns, piped=False
    )
    assert screen.status == 0, screen.received
    assert_tidy(screen)
    assert screen.lines[-1]
    if command != "info":
        found = json.loads((tmp_path / "files" / "found.json").read_text())
        psnr = found["psnr"] if command == "compare" else found["scenes"][0]["psnr"]
        assert f"{psnr:.2f}" in " ".join(screen.lines)
        assert "…" not in "".join(screen.lines)


@pytest.mark.parametrize("command", ENDLESS)
def test_ctrl_c_leaves_one_line_and_a_cursor(command: str, shown: Callable[..., Screen]) -> None:
    stage, more = ENDLESS[command]
    screen = shown(command, *more.split(), columns=40, stop_at=stage)
    assert screen.status == 130, screen.received
    assert_tidy(screen)
    assert "g2ard: interrupted" in "".join(screen.lines)


def test_an_error_in_the_middle_comes_last(shown: Callable[..., Screen]) -> None:
    screen = shown("recover", "--set", "recover.steps=3", "--views", "missing.json")
    assert screen.status in (1, 2)
    assert_tidy(screen)
    assert "missing.json" in "".join(screen.lines)


LONG = (
    ("distill", "--fit", "9MB"),
    ("lod", "--environment"),
    ("render", "--orbit", "3"),
    ("distill", "--views", "winter", "--photos", "--resume"),
    ("simplify", "-n", "10"),
)


@pytest.mark.parametrize("ask", LONG, ids=" ".join)
def test_messages_break_between_words(ask: tuple[str, ...], shown: Callable[..., Screen]) -> None:
    """A narrow terminal shows the words of a wide one, apart from tables and bars."""
    words = {word.strip(":,") for word in " ".join(shown(*ask, columns=500).lines).split()}
    screen = shown(*ask, columns=40)
    assert_tidy(screen)
    strange = [
        word
        for line in screen.lines
        if not re.search("[━│┃]", line)
        for word in line.split()
        if word.strip(":,") not in words and not re.search(r"\d", word) and len(word) < 39
    ]
    assert not strange, "\n".join(screen.lines)
