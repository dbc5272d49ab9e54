"""Commands that show something work on scenes without an extent, and a page that fails costs nothing else."""

import shutil
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

import pytest

import g2ard
from g2ard.jobs.notebook import write_html
from helpers.commands import CommandLine, succeeds
from helpers.scenes import degenerate_scenes

SCENES = degenerate_scenes()
SHOWING = {
    "view": "view scene.ply -o page.html",
    "render": "render scene.ply -k 2 --size 24 -o pictures --sheet sheet.png",
    "orbit": "render scene.ply --orbit 3 --size 24 -o turn.webp",
    "lod": "lod scene.ply -r 1 --merge-only -o out",
    "lod as 3D Tiles": "lod scene.ply -r 1 --merge-only --format 3dtiles -o out",
    "distill": "distill scene.ply -n 1 --steps 2 --size 24 -o run",
    "clean": "clean scene.ply --preview found.png",
    "compare": "compare scene.ply scene.ply -k 2 --size 24 -o page.html",
    "evaluate": "evaluate scene.ply scene.ply --teacher scene.ply --size 24 -o page.html",
}
"""Calls on a scene, all of whose outputs show it."""


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize(
    "name", ["1", "3", "50 in one place", "one visible", "on an axis", "on a plane"]
)
@pytest.mark.parametrize("call", SHOWING)
def test_a_degenerate_scene_is_shown(
    call: str, name: str, tmp_path: Path, command_line: CommandLine
) -> None:
    g2ard.save(tmp_path / "scene.ply", SCENES[name])
    succeeds(command_line, tmp_path, *SHOWING[call].split())


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("name", SCENES)
def test_a_notebook_shows_a_degenerate_scene(name: str) -> None:
    assert "<img" in write_html(SCENES[name])


PICTURES = {
    "distill": {
        "g2ard.jobs.scoring.choose_best_targets": (
            "choosing views",
            ("report.html", "preview.png", "view.html"),
        ),
        "g2ard.report.distilled.write_distill_report": ("report.html", ("report.html",)),
        "g2ard.report.distilled.write_preview": ("preview.png", ("preview.png",)),
        "g2ard.cli.run_folder.place_frame": ("view.html", ("view.html",)),
    },
    "lod": {"g2ard.jobs.levels.choose_frame": ("the page", ("index.html",))},
    "render": {"g2ard.cli.commands.render._write_sheet": ("--sheet", ("sheet.png",))},
    "clean": {"g2ard.cli.commands.clean._paint": ("--preview", ("found.png",))},
    "compare": {"g2ard.jobs.viewer_frame.place_frame": ("--output", ("page.html",))},
    "evaluate": {"g2ard.cli.commands.evaluate._write_ladder": ("--output", ("page.html",))},
}
"""Command → functions of its pages or pictures, each with what the error names and the missing files."""


def _files(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*.*")}


@pytest.mark.parametrize("call", PICTURES)
def test_a_page_that_fails_costs_nothing_else(
    call: str,
    inputs: Path,
    tmp_path: Path,
    command_line: CommandLine,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    words = [*SHOWING[call].split(), "--json", "told.json"]

    def fail(*_: Any, **__: Any) -> None:
        raise RuntimeError("injected")

    def prepared(name: str) -> Path:
        (tmp_path / name).mkdir()
        shutil.copy(inputs / "ball.ply", tmp_path / name / "scene.ply")
        return tmp_path / name

    usual = prepared("usual")
    for place in PICTURES[call]:
        resolve_name(place)  # imported unpatched
    succeeds(command_line, usual, *words)
    for number, (place, (what, missing)) in enumerate(PICTURES[call].items()):
        folder = prepared(str(number))
        with monkeypatch.context() as patches:
            patches.setattr(place, fail)
            status, _, error = command_line(*words, "-q", cwd=folder)
        assert status == 1
        assert what in error.splitlines()[-1]
        assert "injected" in error.splitlines()[-1]
        expected = {name for name in _files(usual) if Path(name).name not in missing}
        assert _files(folder).keys() == expected, place
        scenes = [name for name in expected if name.endswith((".ply", ".webp", ".glb", ".png"))]
        assert all(_files(folder)[name] == _files(usual)[name] for name in scenes)
