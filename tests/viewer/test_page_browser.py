"""Pages opened in a real browser, and what they show held against our own rasteriser; see `browser.py`."""

import base64
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from g2ard.io import write_splats
from g2ard.jobs.view_checks import sample_opaque_points
from g2ard.jobs.viewer_frame import place_frame
from g2ard.rendering.metrics import psnr
from g2ard.rendering.renderer import Renderer
from g2ard.scene.cameras import Camera, Cameras
from g2ard.scene.splats import Splats
from g2ard.viewer.page import write_page
from helpers.browser import Browser
from helpers.pages import FRONT, GREY, HEIGHT, WIDTH, assert_shows, drawn, like, rendered, show


@pytest.fixture(scope="module")
def page() -> Iterator[Browser]:
    with Browser(WIDTH, HEIGHT) as browser:
        yield browser


@pytest.fixture
def browser(page: Browser) -> Browser:
    page.resize(WIDTH, HEIGHT)
    return page


def save(
    path: Path, *scenes: Splats, camera: Camera = FRONT, up: tuple[float, ...] = (0, 0, 1)
) -> Path:
    """A page of scenes that opens with a camera."""
    stand = place_frame(scenes[0], Cameras.of([camera]), up=up, start=camera.name)
    shown = [(f"scene {index}", stand.of(scene)) for index, scene in enumerate(scenes)]
    write_page(path, shown, start=stand.start, background=GREY, overwrite=True)
    return path


def scattered(count: int = 4000, seed: int = 0) -> Splats:
    """Gaussians of all shapes and opacities in a ball, some under a pixel, colours by direction."""
    rng = np.random.default_rng(seed)
    return Splats.create(
        rng.normal(size=(count, 3)) * 0.35,
        quats=rng.normal(size=(count, 4)),
        scales=np.exp(rng.normal(-4.2, 0.8, (count, 3))),
        logit_opacities=rng.normal(0, 2, count),
        sh0=rng.normal(0, 1, (count, 1, 3)),
        shN=rng.normal(0, 0.1, (count, 8, 3)),
    )


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.3, -1.0, 0.2)])
def test_a_page_shows_g2ards_render(
    browser: Browser, tmp_path: Path, up: tuple[float, ...]
) -> None:
    scene = scattered()
    camera = Camera.facing([1.8, -1.6, 0.9], [0, 0, 0], width=WIDTH, height=HEIGHT, fov=55, up=up)
    browser.requests.clear()
    show(browser, save(tmp_path / "one.html", scene, camera=camera, up=up))
    picture = assert_shows(browser, rendered(scene, camera), 38)
    # and would tell another picture apart
    assert psnr(picture[:, ::-1], rendered(scene, camera)) < 30
    assert {re.split(r"[:/]", url)[0] for url in browser.requests} <= {"file", "blob", "data"}
    assert browser.run("document.getElementById('trouble').hidden")


def test_an_antialiased_scene_is_drawn_as_such(browser: Browser, tmp_path: Path) -> None:
    fine = scattered(20_000)
    fine = replace(fine, scales=fine.scales / 10, logit_opacities=fine.logit_opacities + 2)
    scene = replace(fine, render_model="antialiased")
    show(browser, save(tmp_path / "mip.html", scene, fine))
    assert_shows(browser, rendered(scene), 38)
    assert_shows(browser, rendered(fine), 38, 1)
    assert psnr(rendered(scene), rendered(fine)) < 25


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply"])
def test_the_viewer_reads_the_files_we_write(browser: Browser, tmp_path: Path, suffix: str) -> None:
    scene = scattered()
    page = save(tmp_path / "page.html", scene)
    stand = place_frame(scene, Cameras.of([FRONT]), up=(0, 0, 1), start="front")
    write_splats(tmp_path / f"other{suffix}", stand.of(scene))
    text = page.read_text(encoding="utf-8").replace("scene0.sog", f"scene0{suffix}")
    other = base64.b64encode((tmp_path / f"other{suffix}").read_bytes()).decode()
    text, count = re.subn(r'(id="scene0">)[^<]*', lambda match: match[1] + other, text)
    assert count == 1
    page.write_text(text, encoding="utf-8")
    show(browser, page)
    assert_shows(browser, rendered(scene), 37)


def test_two_scenes_share_a_camera_and_a_divider(browser: Browser, tmp_path: Path) -> None:
    left, right = scattered(), scattered(seed=1)
    show(browser, save(tmp_path / "two.html", left, right))
    for index, scene in enumerate((left, right)):
        assert_shows(browser, rendered(scene), 38, index)
    sides = [rendered(scene) for scene in (left, right)]
    browser.run("document.querySelector('.sse-ui').style.display = 'none'")
    for share in (0.5, 0.25, 0.75):
        at = browser.run("parseFloat(document.getElementById('divider').style.left) / 100")
        browser.drag((at * WIDTH, HEIGHT / 2), (share * WIDTH, HEIGHT / 2))
        browser.run("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
        picture = browser.picture() / np.float32(255)
        edge, rows = round(share * WIDTH), slice(60, None)  # beside the divider, below the labels
        parts = (slice(0, edge - 20), slice(edge + 20, WIDTH))
        for side, part in enumerate(parts):
            assert psnr(picture[rows, part], sides[side][rows, part]) > 35, (share, side)
            assert psnr(picture[rows, part], sides[1 - side][rows, part]) < 25, (share, side)


def test_both_scenes_share_a_camera(browser: Browser, tmp_path: Path) -> None:
    scene = scattered()
    show(browser, save(tmp_path / "two.html", scene, scene))
    before = assert_shows(browser, rendered(scene), 38)
    browser.drag((100, 200), (220, 170))
    assert psnr(drawn(browser, lambda picture: psnr(picture, before) < 25), before) < 25
    left = before

    def as_the_left(picture: np.ndarray) -> bool:
        nonlocal left
        left = drawn(browser, lambda _: True)
        return psnr(picture, left) > 60

    right = drawn(browser, as_the_left, 1)
    assert psnr(right, left) > 60
    assert psnr(right, before) < 25


def test_arrows_lead_to_the_next_stop(browser: Browser, tmp_path: Path) -> None:
    scene = scattered()
    other = Camera.facing([-1.5, -1.6, 1.2], [0.1, 0, 0], width=WIDTH, height=HEIGHT, fov=40)
    stand, points = (
        place_frame(scene, Cameras.of([FRONT]), up=(0, 0, 1), start="front"),
        sample_opaque_points(scene),
    )
    stops = [
        (name, stand.start_at(view, points))
        for name, view in (("typical", FRONT), ("worst", other))
    ]
    page = tmp_path / "stops.html"
    write_page(page, [("scene", stand.of(scene))], start=stand.start, stops=stops, background=GREY)
    show(browser, page)
    assert_shows(browser, rendered(scene), 38)
    title = "document.querySelector('.sse-annotationNavTitle').textContent"
    assert browser.run(title) == "typical"
    top, bottom = browser.run(
        "(box => [box.top, box.bottom])(document.querySelector('.sse-annotationNav').getBoundingClientRect())"
    )
    assert HEIGHT / 2 < top < bottom < HEIGHT
    browser.run("document.querySelector('.sse-annotationNext').click()")
    goal = ", ".join(map(str, stops[1][1].position))
    moved = browser.run(
        "g2ard.ready.then(([viewer]) => new Promise(done => { const until = Date.now() + 60000;"
        f"const goal = viewer.app.root.findByName('camera').getPosition().clone().set({goal});"
        "const look = () => { const at = viewer.app.root.findByName('camera').getPosition().distance(goal);"
        "at < 0.02 || Date.now() > until ? done(at) : setTimeout(look, 50); }; look(); }))"
    )
    assert moved < 0.02
    assert browser.run(title) == "worst"


@pytest.mark.parametrize("size", [(300, 600), (600, 300)])
def test_a_window_of_any_shape_shows_the_whole_view(
    browser: Browser, tmp_path: Path, size: tuple[int, int]
) -> None:
    """The view's middle keeps its place, and its longer side fills the window."""
    scene, (width, height) = scattered(), size
    zoom = min(width / WIDTH, height / HEIGHT)
    K = np.diag([FRONT.K[0, 0] * zoom, FRONT.K[1, 1] * zoom, 1])
    K[:2, 2] = width / 2, height / 2
    browser.resize(width, height)
    show(browser, save(tmp_path / "page.html", scene))
    assert_shows(browser, rendered(scene, replace(FRONT, K=K, width=width, height=height)), 38)


def test_a_narrow_page_opens_readable_and_shows_each_scene_alone(tmp_path: Path) -> None:
    scene = scattered(400)
    stand = place_frame(scene, Cameras.of([FRONT]), up=(0, 0, 1))
    names = [
        "a_scene_with_a_long_name.ply: 1,234,567 Gaussians",
        "another_long_name.ply: 12,345 Gaussians",
    ]
    write_page(
        tmp_path / "two.html", [(name, stand.of(scene)) for name in names], start=stand.start
    )
    with Browser(390, 700) as page:
        show(page, tmp_path / "two.html")
        labels = "[...document.querySelectorAll('.label')]"
        boxes = labels + ".map(e => e.getBoundingClientRect()).map(box => [box.left, box.right])"
        (left, first), (second, right) = page.run(boxes)
        assert 0 <= left < first <= second < right <= 390
        assert page.run("localStorage.getItem('controlsPanelOpen')") == "false"
        clip = "document.getElementById('right').style.clipPath"
        press = "document.querySelectorAll('.label')[{}].click(); " + clip
        assert page.run(press.format(0)) == "inset(0px 0px 0px 100%)"
        assert page.run(press.format(1)) == "inset(0px 0px 0px 0%)"
        assert page.run("document.getElementById('divider').hidden")
        assert page.run(press.format(1)) == "inset(0px 0px 0px 50%)"


def test_without_a_background_scenes_are_before_a_soft_gradient(
    browser: Browser, tmp_path: Path
) -> None:
    scene = scattered()
    stand = place_frame(scene, Cameras.of([FRONT]), up=(0, 0, 1), start="front")
    shown = [(name, stand.of(scene)) for name in ("left", "right")]
    image, alpha = layers(scene)
    for count in (1, 2):
        page = tmp_path / f"soft{count}.html"
        write_page(page, shown[:count], start=stand.start, background=None)
        show(browser, page)
        drawn(browser, like(image, 30), count - 1)
        browser.run("document.querySelector('.sse-ui').style.display = 'none'")
        browser.run("document.getElementById('divider').hidden = true")
        picture = browser.picture() / np.float32(255)
        gradient = picture[60:, [0, -1]].mean(axis=1)  # seen on both sides, below the labels
        assert (np.diff(gradient, axis=0) > -0.01).all()  # dithered
        assert (gradient[-1] - gradient[0] > 0.1).all()
        behind = image[60:] + (1 - alpha[60:, :, None]) * gradient[:, None]
        assert psnr(picture[60:], np.clip(behind, 0, 1)) > 33


def layers(scene: Splats) -> tuple[np.ndarray, np.ndarray]:
    """Return the picture before black, (H, W, 3), and what it covers, (H, W)."""
    found = Renderer(scene).render(FRONT)
    return found.image, found.alpha
