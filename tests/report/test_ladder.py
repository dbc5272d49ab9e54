"""The page of `g2ard evaluate -o`: several sizes of one scene, and which one suffices."""

import json
import re
from pathlib import Path
from typing import Any

import pytest

import g2ard
from g2ard.report.ladder import Rung, recommendation
from g2ard.stages.evaluate import Evaluation, ViewScore
from helpers.commands import CommandLine, refused, succeeds
from helpers.photos import photographed
from helpers.scenes import around, checkered_ball
from helpers.studies import check_page

BALL = checkered_ball(300)


def rungs(*psnr: tuple[float, float], against: str = "teacher") -> list[Rung]:
    """Return results with the PSNR of two views each, smallest first: 40×, 20×, 10×, …"""
    found = []
    for i, (first, second) in enumerate(psnr):
        views = tuple(ViewScore(name, v, against=against) for name, v in (("a", first), ("b", second)))
        scores = Evaluation(10 * 2**i, 1, views, "2 views")
        found.append(Rung(f"{i}.ply", f"{40 / 2**i:g}×", 100 * 2**i, BALL, scores))
    return found


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (
            rungs((40, 30), (42, 33), (44, 36)),
            "20× is the smallest without a visible loss: worst view 33.0 dB",
        ),
        (rungs((40, 34), (42, 36)), "40× is .* worst view 34.0 dB; fewer Gaussians may do"),
        (rungs((33, 28), (35, 31.2)), "every size loses visibly: 20× has 31.2 dB .*; keep more Gaussians"),
        (
            rungs((24, 20), (27.5, 24.5), (28, 25), against="photo"),
            "20× is the smallest within 1 dB of the best: 26.0 dB against the photos",
        ),
    ],
)
def test_the_smallest_size_that_suffices_is_recommended(given: list[Rung], told: str) -> None:
    assert re.fullmatch(told, recommendation(given))


@pytest.fixture
def sizes(tmp_path: Path) -> Path:
    """Write ball.ply, views of it with and without photos, and results of 10 and 150 Gaussians."""
    g2ard.save(tmp_path / "ball.ply", BALL)
    views = around(8, (48, 36))
    g2ard.save_views(tmp_path / "views.json", views)
    (tmp_path / "photos").mkdir()
    g2ard.save_views(tmp_path / "photos.json", photographed(tmp_path / "photos", BALL, views))
    for count in (10, 150):
        g2ard.save(tmp_path / f"s_{count}.ply", g2ard.simplify(BALL, count=count, blind=True).splats)
    return tmp_path


@pytest.mark.parametrize("against", ["renders", "photos", "generated views"])
def test_evaluate_writes_a_page_on_several_sizes(
    against: str, sizes: Path, command_line: CommandLine
) -> None:
    given: dict[str, tuple[Any, ...]] = {
        "renders": ("--teacher", "ball.ply", "--views", "views.json"),
        "photos": ("--views", "photos.json"),
        "generated views": ("--teacher", "ball.ply", "--size", 64),
    }
    ask = ("evaluate", "s_150.ply", "s_10.ply", *given[against], "-o", "ladder.html", "--json", "-")
    printed = succeeds(command_line, sizes, *ask)
    result = json.loads(printed.out)
    assert f"ladder.html: {result['advice']}\n" in printed.err
    html = (sizes / "ladder.html").read_text(encoding="utf-8")
    check_page(html)
    assert result["advice"][1:] in html
    assert html.count("<circle") == 4  # mean and worst view of both sizes
    labels = ("150", "10") if against == "photos" else ("2×", "30×")
    worst = [min(row["views"], key=lambda view: view["psnr"]) for row in result["scenes"]]
    for row, label, view in zip(result["scenes"], labels, worst, strict=True):
        for cell in (label, f"{row['psnr']:.2f}", f"{view['name']} {view['psnr']:.2f}"):
            assert f">{cell}</td>" in html
        assert re.search(rf"<h4>{re.escape(view['name'])}, worst of [^<]*{label}", html)
    assert ("ball.ply</td>" in html) == (against != "photos")
    pictures = 1 + len({view["name"] for view in worst})
    assert html.count('class="slider"') == pictures
    assert html.count("<option") == 2 * pictures


def test_a_page_compares_at_least_two(sizes: Path, command_line: CommandLine) -> None:
    ask = ("evaluate", "s_10.ply", "--teacher", "ball.ply", "--views", "views.json", "-o", "ladder.html")
    assert "several scenes" in refused(command_line, sizes, *ask)
    assert not (sizes / "ladder.html").exists()
