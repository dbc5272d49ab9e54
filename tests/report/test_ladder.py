"""The page of `g2ard evaluate -o`: several sizes of one scene, and which one suffices."""

import json
import re
from pathlib import Path
from typing import Any

import pytest

import g2ard
from g2ard.report.ladder import Rung, recommend_size
from g2ard.stages.evaluate import Evaluation, ViewScore
from helpers.commands import CommandLine, refused, succeeds
from helpers.photos import photographed
from helpers.realdata import real
from helpers.scenes import around, checkered_ball
from helpers.studies import check_page

BALL = checkered_ball(300)


def rungs(*scores: tuple[float, float], against: str = "teacher") -> list[Rung]:
    """Return results with the scores of two views each, smallest first: 40×, 20×, 10×, …

    The scores are PSNR against photos, the visibility of lost detail otherwise.
    """
    found = []
    for i, pair in enumerate(scores):
        views = tuple(
            ViewScore(v, name=name, against=against)
            if against == "photo"
            else ViewScore(40 - v, name=name, lost=v)
            for name, v in zip("ab", pair, strict=True)
        )
        result = Evaluation.mean(views, count=10 * 2**i, bytes=1, views=views, scored_in="2 views")
        found.append(Rung(f"{i}.ply", f"{40 / 2**i:g}×", 100 * 2**i, BALL, result))
    return found


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (
            rungs((0.2, 1.2), (0.1, 0.9), (0, 0.1)),
            "20× is the smallest without a visible loss of detail",
        ),
        (rungs((0.3, 0.9), (0.1, 0.2)), "40× is the smallest .*; fewer Gaussians may do"),
        (rungs((2, 3), (1.1, 0.8)), "every size loses detail visibly, 20× most in a; keep more .*"),
        (
            rungs((24, 20), (27.5, 24.5), (28, 25), against="photo"),
            "20× is the smallest within 1 dB of the best: 26.0 dB against the photos",
        ),
    ],
)
def test_the_smallest_size_that_suffices_is_recommended(given: list[Rung], told: str) -> None:
    assert re.fullmatch(told, recommend_size(given))


@pytest.mark.parametrize(
    ("name", "shown", "ratio", "seen"),
    [
        ("format_samples/guitar.compressed.ply", (2, 4), 8, True),
        ("format_samples/guitar.compressed.ply", (2, 4), 1.1, False),
        ("format_samples/guitar.compressed.ply", (2, 4), 1, False),
        ("playbot/0_0", (6,), 30, True),
    ],
)
def test_people_see_lost_grain_but_no_copy(
    name: str, shown: tuple[int, ...], ratio: float, seen: bool, tmp_path: Path
) -> None:
    scene = g2ard.load(real(name))
    targets = g2ard.TeacherRenders(scene, g2ard.make_pool(scene, 16, size=(800, 600)).take(shown))
    g2ard.save(tmp_path / "copy.spz", scene)
    few = (
        g2ard.load(tmp_path / "copy.spz")
        if ratio == 1
        else g2ard.simplify(scene, ratio=ratio, blind=True)
    )
    worst = max(view.lost for view in g2ard.evaluate(few, targets).views)
    assert worst > 1 if seen else worst < 0.2


@pytest.fixture
def sizes(tmp_path: Path) -> Path:
    """Write ball.ply, views of it with and without photos, and results of 10 and 150 Gaussians."""
    g2ard.save(tmp_path / "ball.ply", BALL)
    views = around(8, (48, 36))
    g2ard.save_views(tmp_path / "views.json", views)
    (tmp_path / "photos").mkdir()
    g2ard.save_views(tmp_path / "photos.json", photographed(tmp_path / "photos", BALL, views))
    for count in (10, 150):
        g2ard.save(
            tmp_path / f"s_{count}.ply", g2ard.simplify(BALL, count=count, blind=True).splats
        )
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
    sign, score = (-1, "psnr") if against == "photos" else (1, "lost")
    shown = [row["own_size"] or row for row in result["scenes"]]
    worst = [max(row["views"], key=lambda view: sign * view[score]) for row in shown]
    for row, label, view in zip(shown, labels, worst, strict=True):
        for cell in (label, f"{row['psnr']:.2f}", f"{view['name']} {view['psnr']:.2f}"):
            assert f">{cell}</td>" in html
        assert re.search(rf"<h4>{re.escape(view['name'])}, worst of [^<]*{label}", html)
    assert ("ball.ply</td>" in html) == (against != "photos")
    pictures = 1 + len({view["name"] for view in worst})
    assert html.count('class="slider"') == pictures
    assert html.count("<option") == 2 * pictures


def test_a_page_compares_at_least_two(sizes: Path, command_line: CommandLine) -> None:
    ask = (
        "evaluate",
        "s_10.ply",
        "--teacher",
        "ball.ply",
        "--views",
        "views.json",
        "-o",
        "ladder.html",
    )
    assert "several scenes" in refused(command_line, sizes, *ask)
    assert not (sizes / "ladder.html").exists()
