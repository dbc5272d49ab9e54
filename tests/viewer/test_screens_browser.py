"""Pages of every kind on a laptop, a desktop and a phone: subjects fill the screen, Tab leads to controls."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from g2ard.jobs.inputs import GivenViews
from g2ard.jobs.levels import save_tileset, write_level_page
from g2ard.jobs.viewer_frame import choose_frame
from g2ard.levels import save_levels
from g2ard.report.page import Page, Shown
from g2ard.scene.splats import Splats
from g2ard.viewer.page import write_page
from helpers.browser import Browser
from helpers.pages import GREY, served, show
from helpers.peers import package
from helpers.photos import cloud_of

SCREENS = {"laptop": (1280, 800), "desktop": (1920, 1080), "phone": (390, 844)}
UP = (0.0, 0.0, 1.0)
_TAB = 9
_FILLED = 0.7
"""Share of the window's width or height that a subject fills at least."""
_LEAST, _LEAST_TOUCHED = 24, 44
"""Least sides of controls in pixels, for a mouse and for a finger (WCAG 2.5.8 and 2.5.5)."""


def column(count: int = 3000) -> Splats:
    """Return a red column with green rings, six times as high as it is wide, without dark or grey parts."""
    rng = np.random.default_rng(0)
    turn, height = rng.uniform(0, 2 * np.pi, count), rng.uniform(-1, 1, count)
    rings = np.floor(height * 6) % 2
    color = np.where(rings[:, None] > 0, [0.9, 0.15, 0.15], [0.15, 0.8, 0.15])
    return Splats.create(
        np.stack([np.cos(turn) / 6, np.sin(turn) / 6, height], axis=1),
        scales=rng.uniform(0.01, 0.03, (count, 3)),
        logit_opacities=np.full(count, 3.0),
        sh0=((color - 0.5) / 0.28209479)[:, None],
    )


def view_page(folder: Path, count: int = 1) -> str:
    scene = column()
    stand = choose_frame(scene, GivenViews(up=UP))
    shown = [(f"scene {index}", stand.of(scene)) for index in range(count)]
    write_page(folder / "view.html", shown, start=stand.start, background=GREY, overwrite=True)
    return "view.html"


def comparison_page(folder: Path) -> str:
    return view_page(folder, 2)


def levels_page(folder: Path) -> str:
    """Write the page of levels that were made of a point cloud."""
    levels = (column(), column(400))
    cloud_of(folder / "cloud.ply", levels[0])
    save_levels(folder / "levels", levels)
    write_level_page(folder / "levels", levels, "sog", GivenViews(None, folder / "cloud.ply", UP))
    return "levels/"


def globe_page(folder: Path) -> str:
    levels = (column(), column(400))
    cesium = package("cesium", "Build", "Cesium")
    cloud_of(folder / "cloud.ply", levels[0])
    save_tileset(folder / "globe", levels, up=UP)
    (folder / "globe" / "cesium").symlink_to(cesium)
    write_level_page(
        folder / "globe", levels, "3dtiles", GivenViews(None, folder / "cloud.ply", UP)
    )
    return "globe/?cesium=cesium"


def report_page(folder: Path) -> str:
    red = np.zeros((240, 320, 3), np.uint8) + np.uint8([230, 30, 30])
    page = Page("scene.ply: 500,000 → 50,000", "A verdict.")
    page.comparison(
        "view_0000", red, [Shown("result", red, "30 dB"), Shown("simplified", red, "28 dB")]
    )
    page.details("settings", [["recover.steps", "500"]])
    page.write(folder / "report.html")
    return "report.html"


KINDS: dict[str, Callable[[Path], str]] = {
    "view": view_page,
    "comparison": comparison_page,
    "levels": levels_page,
    "globe": globe_page,
    "report": report_page,
}


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with Browser(*SCREENS["laptop"]) as page:
        yield page


@pytest.fixture(scope="module")
def page(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[str, str]]:
    """Kind of a page, and its address."""
    folder = tmp_path_factory.mktemp(request.param)
    name = KINDS[request.param](folder)
    with served(folder) as address:
        yield request.param, f"{address}/{name}"


PAGES = [
    (kind, screen)
    for kind in KINDS
    for screen in SCREENS
    if screen != "desktop" or kind in ("comparison", "report")
]
"""Kinds and screens. Styles of pages differ below 600 pixels alone, and software draws large ones slowly."""


@pytest.mark.parametrize(("page", "screen"), PAGES, indirect=["page"])
def test_a_page_suits_the_screen(browser: Browser, page: tuple[str, str], screen: str) -> None:
    (kind, address), (width, height) = page, SCREENS[screen]
    browser.resize(width, height)
    if kind == "report":
        browser.open(address)
        browser.run(
            "new Promise(done => { onload = done; document.readyState === 'complete' && done() })"
        )
        browser.run("document.querySelector('.slider').scrollIntoView({ block: 'center' })")
        colourful = _boxed
    else:
        show(browser, address)
        over = "document.querySelectorAll('.sse-ui, .cesium-widget-credits')"
        browser.run(f"{over}.forEach(shown => shown.style.setProperty('opacity', 0))")
        colourful = _coloured
    _assert_fills(browser, colourful)
    if kind != "globe":  # CesiumJS takes no keys, and its page has no controls
        _assert_reached(browser, _LEAST_TOUCHED if screen == "phone" else _LEAST)


def _boxed(browser: Browser, picture: np.ndarray) -> list[float]:
    """Return left, top, right and bottom of the picture of a report."""
    sides = "(({ left, top, right, bottom }) => [left, top, right, bottom])"
    found: list[float] = browser.run(
        f"{sides}(document.querySelector('.slider').getBoundingClientRect())"
    )
    return found


def _coloured(browser: Browser, picture: np.ndarray) -> list[float]:
    """Return left, top, right and bottom of what is colourful, all 0 without any."""
    rows, columns = np.nonzero(np.ptp(picture, axis=2) > 90)
    if not len(rows):
        return [0.0] * 4
    return [float(side) for side in (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)]


def _assert_fills(browser: Browser, find: Callable[[Browser, np.ndarray], list[float]]) -> None:
    """Check that a subject is whole and fills most of the window, and that nothing is black."""
    until = time.monotonic() + 60
    while True:
        picture = browser.picture().astype(int)
        height, width = picture.shape[:2]
        left, top, right, bottom = find(browser, picture)
        filled = max((right - left) / width, (bottom - top) / height)
        if filled > _FILLED or time.monotonic() > until:
            break
        time.sleep(0.2)
    assert filled > _FILLED
    assert 0 < left < right < width
    assert 0 < top < bottom < height
    assert (picture.max(axis=2) < 16).mean() < 0.01


_CONTROLS = """[...document.querySelectorAll('button, select, input, summary, [tabindex="0"]')].filter(
  control => control.checkVisibility())"""


def _assert_reached(browser: Browser, least: int) -> None:
    """Check that Tab leads to all controls, also to hidden ones, and that they are large enough."""
    browser.run(
        "globalThis.g2ard?.ready.then(([viewer]) => { viewer.state.controlsHidden = true; })"
    )
    browser.press("Tab", _TAB)
    count = browser.run(f"{_CONTROLS}.length")
    for _ in range(count):
        browser.run("document.activeElement.dataset.reached = ''")
        browser.press("Tab", _TAB)
    missed = f"{_CONTROLS}.filter(control => !('reached' in control.dataset))"
    assert browser.run(f"{missed}.map(control => control.className)") == []
    sizes = f"{_CONTROLS}.map(control => control.getBoundingClientRect()).map(box => [box.width, box.height])"
    assert count >= 3
    assert np.min(browser.run(sizes)) >= least
