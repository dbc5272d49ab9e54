"""Report pages: their charts, and that they work in a browser."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from g2ard.report.charts import Point, chart, pareto
from g2ard.report.page import Comparison, Page, Shown
from helpers.commands import CommandLine, succeeds
from helpers.studies import check_page, study


def test_the_page_works_in_a_browser(tmp_path: Path) -> None:
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no chromium on PATH")
    page = Page("A page")
    target = np.zeros((30, 40, 3), np.uint8)
    shown = [Shown(name, np.full_like(target, shade), "9 dB") for name, shade in (("one", 90), ("two", 200))]
    page.comparison(Comparison("a view", target, shown))
    page.write(tmp_path / "page.html")
    options = ["--headless=new", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=2000", "--dump-dom"]
    dom = subprocess.run(
        [browser, *options, (tmp_path / "page.html").as_uri()], capture_output=True, text=True, timeout=120
    ).stdout
    assert '<span class="tag right">one 9 dB</span>' in dom  # the script has run
    assert dom.count('src="data:image/jpeg;base64,') == 8  # a pair and two crops of three


def test_pareto_points_are_beaten_by_none() -> None:
    rng = np.random.default_rng(0)
    points = [Point(x, y, 0) for x, y in rng.normal(size=(60, 2)).round(1)]
    expected = {
        (p.x, p.y)
        for p in points
        if not any((q.x <= p.x and q.y >= p.y and (q.x, q.y) != (p.x, p.y)) for q in points)
    }
    assert {(p.x, p.y) for p in pareto(points)} == expected
    assert chart([], x_label="x", y_label="y") == ""
    assert "NaN" not in chart([Point(1, 2, 0)], x_label="x", y_label="y", log=True, joined=True, front=True)


def test_distill_writes_a_report(command_line: CommandLine, tmp_path: Path) -> None:
    study(tmp_path)
    options = ["-r", "4", "--views", "views.json", "--steps", "5", "-o", "run"]
    succeeds(command_line, tmp_path, "distill", "ball.ply", *options)
    html = (tmp_path / "run" / "report.html").read_text()
    check_page(html)
    assert "Worst views first" in html
    assert "ball.ply" in html
