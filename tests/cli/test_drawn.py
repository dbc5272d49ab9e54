"""Pictures of scored views, which a report shows without rendering them again."""

import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from g2ard.cli.run_folder import RunFolder
from g2ard.rendering.renderer import Renderer
from g2ard.rendering.targets import TeacherRenders
from g2ard.report.distilled import Drawn, create_renderers, draw_pictures
from g2ard.report.labels import RESULT
from g2ard.stages.evaluate import evaluate
from helpers.commands import CommandLine, succeeds
from helpers.scenes import around, checkered_ball

CALLS = {
    "generated views": "distill ball.ply -r 8 --size 24 --steps 3",
    "photos": "distill --views photos.json -n 40 --steps 3",
    "smaller views": "distill ball.ply -r 8 --views photos.json --renders --size 24 --steps 3",
    "a cloud": "distill scan.las -r 8 --size 24 --steps 3",
    "tiles": "distill ball.ply -r 8 --tile-rows 150 --workers 1 --size 24 --steps 3",
}


@pytest.mark.parametrize("words", CALLS.values(), ids=CALLS)
def test_pages_render_no_scored_view_again(
    words: str, work: Path, command_line: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn = [set[Any](), set[Any]()]
    image, write_pages, paging = Renderer.image, RunFolder.write_pages, []

    def drawing(renderer: Renderer, camera: Any) -> Any:
        arrays = tuple(array.tobytes() for array in renderer._arrays)
        if len(renderer._arrays[0]) < 400:  # of a result, not of the dense scene
            drawn[len(paging)].add((*arrays, camera.name, camera.width))
        return image(renderer, camera)

    def writing(*given: Any) -> Any:
        paging.append(True)
        return write_pages(*given)

    monkeypatch.setattr(Renderer, "image", drawing)
    monkeypatch.setattr(RunFolder, "write_pages", writing)
    succeeds(command_line, work, *shlex.split(words), "--no-page", "-o", "out")
    page = (work / "out" / "report.html").read_text(encoding="utf-8")
    assert "Worst views" in page
    lost = re.findall("ended below their start: (\\w+)", page)  # shown even if others are worse
    assert {name for *_, name, _ in drawn[0] & drawn[1]} <= {*lost}


def test_kept_pictures_are_those_that_would_be_rendered(monkeypatch: pytest.MonkeyPatch) -> None:
    ball, cameras = checkered_ball(200), around(6, (32, 24))
    mask = np.arange(32 * 24).reshape(24, 32) % 3 > 0
    targets, best = TeacherRenders(ball, cameras), TeacherRenders(ball, cameras.take([4]))
    monkeypatch.setattr(TeacherRenders, "mask", lambda *_: mask, raising=False)
    scenes = {RESULT: ball.take(range(100)), "simplified": ball.take(range(50))}
    drawn = Drawn(best, [targets])
    tables = [
        evaluate(scene, targets, watch=lambda *one, name=name: drawn.keep(name, targets, *one))
        for name, scene in scenes.items()
    ]
    worst = sorted(range(6), key=lambda view: tables[0].views[view].psnr)
    kept = [view for view in range(6) if drawn.of(targets, view)]
    assert kept == sorted({4, *worst[:3]})
    renderers = create_renderers(list(scenes.items()))
    for view in kept:
        ours, anew = (
            draw_pictures(targets, view, renderers, drawn=drawn),
            draw_pictures(targets, view, renderers),
        )
        assert ours.psnrs == anew.psnrs == [table.views[view].psnr for table in tables]
        np.testing.assert_array_equal(ours.images, anew.images)
