"""Small studies and checks of their report page."""

import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np

from benchmarks.rows import Row
from benchmarks.runner import run
from benchmarks.study import DEFINITIONS, SceneSpec, read_study
from g2ard import io
from g2ard.io.images import write_png
from helpers.scenes import around, checkered_ball

STUDY = """
title = "Balls"
ratios = [4]
steps = [9]
seconds = [1]
methods = ["g2ard", "pup", "rounds", "nanogs"]

[method.rounds]
base = "g2ard-paper"
protection = 0.0

[[scene]]
name = "ball"
prior = "ball.ply"
train = "views.json"
"""


def study(folder: Path, text: str = STUDY) -> Path:
    io.write_splats(folder / "ball.ply", checkered_ball(1200))
    io.write_views(folder / "views.json", around(16, size=(48, 36)))
    path = folder / "balls.toml"
    path.write_text(text)
    return path


def ball_of(folder: Path, count: int, views: bool = True) -> SceneSpec:
    """Write a ball, and 16 views of it if requested, for a study."""
    folder.mkdir(parents=True, exist_ok=True)
    io.write_splats(folder / "ball.ply", checkered_ball(count))
    if not views:
        return SceneSpec("ball", str(folder / "ball.ply"))
    io.write_views(folder / "views.json", around(16))
    return SceneSpec("ball", str(folder / "ball.ply"), str(folder / "views.json"))


def measured(name: str, scene: SceneSpec, out: Path, **options: str) -> list[Row]:
    """Run a study of `benchmarks/definitions` on a scene; return its rows."""
    made = read_study(DEFINITIONS / f"{name}.toml").narrowed(options)
    return run([replace(made, scenes=(scene,))], out)


def check_page(html: str) -> None:
    """Check that a page parses and loads nothing from a network."""

    class Parser(HTMLParser):
        def __init__(self) -> None:
            super().__init__()
            self.open: list[str] = []

        def handle_starttag(self, tag: str, attributes: list) -> None:
            assert tag not in ("link", "iframe")
            assert not [v for k, v in attributes if k == "src" or (k == "href" and ":" in v)]
            if tag not in ("meta", "img", "input", "br", "line", "circle", "polyline", "polygon"):
                self.open.append(tag)

        def handle_endtag(self, tag: str) -> None:
            if tag in ("line", "circle", "polyline", "polygon"):
                return
            assert self.open.pop() == tag

    parser = Parser()
    parser.feed(html)
    assert parser.open == []
    assert not re.search(r"https?://|@import|url\(", html)


def pictured(folder: Path, which: tuple[int, ...] = (0, 2)):
    """Four views; some have a photo of one colour, which tells it apart from a render."""
    views = around(4)
    paths = [folder / f"{name}.png" if i in which else None for i, name in enumerate(views.names)]
    for path in paths:
        if path is not None:
            write_png(path, np.full((48, 64, 3), 0.25, np.float32))
    return replace(views, image_paths=tuple(paths))
