"""Report pages in a real browser; see `browser.py`."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from g2ard.report.page import Page, Shown
from g2ard.report.run import COLUMNS
from helpers.browser import Browser


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with Browser(1000, 640) as page:
        yield page


def opened(browser: Browser, page: Page, path: Path, width: int = 1000) -> None:
    page.write(path)
    browser.resize(width, 640)
    browser.open(path.as_uri())
    browser.run(
        "new Promise(done => { onload = done; document.readyState === 'complete' && done() })"
    )


ROW = ["anywhere", "128", "29.34 → 32.27", "27.01", "0.79 → 0.86", "0.7896 → 0.8607"]


@pytest.mark.parametrize("width", [360, 1000])
def test_tables_fit_the_window_and_name_their_columns(
    browser: Browser, width: int, tmp_path: Path
) -> None:
    page = Page("scene.ply: 500,000 → 50,000", "A verdict of a sentence.")
    page.table(COLUMNS, [ROW, ROW])
    opened(browser, page, tmp_path / "report.html", width)
    extent = "Math.max(...[...document.querySelectorAll('*')].map(e => e.scrollWidth))"
    assert browser.run(extent) <= width
    edges = "[...document.querySelectorAll('td')].map(cell => cell.getBoundingClientRect().right)"
    assert max(browser.run(edges)) <= width
    heads = "getComputedStyle(document.querySelector('td'), '::before').content"
    assert (browser.run(heads) == f'"{COLUMNS[0]}"') == (width < 600)


@pytest.mark.parametrize("shape", [(120, 67), (67, 120)])
def test_pictures_are_no_taller_than_the_screen(
    browser: Browser, shape: tuple[int, int], tmp_path: Path
) -> None:
    image = np.zeros((*shape, 3), np.uint8)
    page = Page("a page")
    shown = [Shown("one", image + np.uint8(9), "9 dB"), Shown("two", image + np.uint8(200), "9 dB")]
    page.comparison("view", image, shown)
    opened(browser, page, tmp_path / "report.html")
    heights = "[...document.querySelectorAll('img')].map(e => e.getBoundingClientRect().height)"
    assert 0 < max(browser.run(heights)) <= 640
    # by the script
    assert browser.run("document.querySelector('.tag.right').textContent") == "one 9 dB"
    pictures = browser.run(
        "document.querySelectorAll('img[src^=\"data:image/jpeg;base64,\"]').length"
    )
    assert pictures == 8  # a pair and two crops of three


@pytest.mark.parametrize("shape", [(120, 67), (100, 100), (75, 100), (67, 120)])
@pytest.mark.parametrize("count", [1, 2])
def test_pictures_fill_their_card(
    browser: Browser, shape: tuple[int, int], count: int, tmp_path: Path
) -> None:
    image = np.zeros((*shape, 3), np.uint8)
    page = Page("a page")
    shown = [Shown(name, image + np.uint8(9), "9 dB") for name in ("result", "simplified")[:count]]
    page.comparison("view", image, shown)
    opened(browser, page, tmp_path / "report.html", 1300)
    browser.resize(1300, 900)
    areas = browser.run(
        "['.view', '.slider', '.crop img'].map(name => [...document.querySelectorAll(name)].map(e => {"
        "const box = e.getBoundingClientRect(); return box.width * box.height}).reduce((a, b) => a + b))"
    )
    card, *pictures = areas
    assert sum(pictures) > 0.5 * card
