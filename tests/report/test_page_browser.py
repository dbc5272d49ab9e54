"""Report pages in a real browser; see `browser.py`."""

from pathlib import Path

import numpy as np
import pytest

from g2ard.report.page import Page, Shown
from g2ard.report.run import COLUMNS
from helpers.browser import Browser

ROW = ["anywhere", "128", "29.34 → 32.27", "pose_0113_anywhere 27.01", "0.7896 → 0.8607"]


@pytest.mark.parametrize("width", [360, 1000])
def test_tables_fit_the_window_and_name_their_columns(width: int, tmp_path: Path) -> None:
    page = Page("scene.ply: 500,000 → 50,000", "A verdict of a sentence.")
    page.table(COLUMNS, [ROW, ROW])
    page.write(tmp_path / "report.html")
    with Browser(width, 640) as browser:
        browser.open((tmp_path / "report.html").as_uri())
        browser.run("new Promise(done => { onload = done; document.readyState === 'complete' && done() })")
        extent = "Math.max(...[...document.querySelectorAll('*')].map(e => e.scrollWidth))"
        assert browser.run(extent) <= width
        edges = "[...document.querySelectorAll('td')].map(cell => cell.getBoundingClientRect().right)"
        assert max(browser.run(edges)) <= width
        heads = "getComputedStyle(document.querySelector('td'), '::before').content"
        assert (browser.run(heads) == f'"{COLUMNS[0]}"') == (width < 600)


@pytest.mark.parametrize("shape", [(120, 67), (67, 120)])
def test_pictures_are_no_taller_than_the_screen(shape: tuple[int, int], tmp_path: Path) -> None:
    image = np.zeros((*shape, 3), np.uint8)
    page = Page("a page")
    page.comparison("view", image, [Shown("recovered", image + np.uint8(9))])
    page.write(tmp_path / "report.html")
    with Browser(1000, 640) as browser:
        browser.open((tmp_path / "report.html").as_uri())
        browser.run("new Promise(done => { onload = done; document.readyState === 'complete' && done() })")
        heights = browser.run(
            "[...document.querySelectorAll('img')].map(e => e.getBoundingClientRect().height)"
        )
        assert 0 < max(heights) <= 640
