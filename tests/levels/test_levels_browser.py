"""Streamed levels loaded by the viewer that they are for; see `browser.py`."""

import json
import re
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from g2ard.jobs.inputs import GivenViews
from g2ard.jobs.levels import lod, save_tileset, write_level_page
from g2ard.levels import Cut, Georeference, save_levels
from g2ard.rendering.metrics import psnr
from g2ard.rendering.renderer import Renderer
from g2ard.scene.cameras import Camera, Cameras
from g2ard.scene.splats import Splats
from g2ard.scene.transform import join
from helpers.browser import Browser
from helpers.pages import FRONT, GREY, HEIGHT, WIDTH, assert_shows, opened, rendered, served, show
from helpers.peers import package
from helpers.scenes import checkered_ball

RATIOS = (1.0, 4.0, 16.0)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, str]]:
    """A folder and its address."""
    folder = tmp_path_factory.mktemp("served")
    with served(folder) as address:
        yield folder, address


@pytest.fixture(scope="module")
def levels() -> tuple[Splats, ...]:
    return lod(checkered_ball(20_000), ratios=RATIOS, recover=False, size=160).splats


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with Browser(WIDTH, HEIGHT) as page:
        yield page


def streaming(
    folder: Path, name: str, levels: tuple[Splats, ...], camera: Camera, sky: Splats | None = None
) -> None:
    """A folder of levels with the page that `lod` writes, opening at a camera."""
    save_levels(folder / name, levels, cut=Cut(4096, 1.0, 512), environment=sky, overwrite=True)
    write_level_page(
        folder / name,
        levels,
        "sog",
        given=GivenViews(Cameras.of([camera]), None, (0, 0, 1)),
        background=GREY,
    )


@pytest.mark.parametrize("finest", [0, 2])
def test_each_level(
    browser: Browser, site: tuple[Path, str], levels: tuple[Splats, ...], finest: int
) -> None:
    folder, address = site
    name = f"from{finest}"
    streaming(folder, name, levels[finest:], FRONT)
    meta = json.loads((folder / name / "lod-meta.json").read_text())
    assert meta["lodLevels"] == len(RATIOS) - finest
    browser.requests.clear()
    show(browser, f"{address}/{name}/")
    camera = opened(folder / name / "index.html", FRONT)
    assert_shows(browser, rendered(levels[finest], camera), 35)
    fetched = {
        url.removeprefix(f"{address}/{name}/") for url in browser.requests if f"/{name}/" in url
    }
    assert "lod-meta.json" in fetched
    assert any(re.match(r"0_\d+/", file) for file in fetched)


def test_the_environment(
    browser: Browser, site: tuple[Path, str], levels: tuple[Splats, ...]
) -> None:
    """Show a sky outside of the tree's box, by which the viewer sets the far plane."""
    folder, address = site
    rng = np.random.default_rng(0)
    rays = rng.normal(size=(400, 3))
    rays *= 12 / np.linalg.norm(rays, axis=1, keepdims=True)
    sky = Splats.create(
        rays,
        scales=np.full((400, 3), 0.5),
        logit_opacities=np.ones(400),
        sh0=rng.normal(size=(400, 1, 3)),
    )
    streaming(folder, "sky", levels, FRONT, sky)
    show(browser, f"{address}/sky/")
    camera = opened(folder / "sky" / "index.html", FRONT)
    assert_shows(browser, rendered(join([levels[0], sky]), camera), 34)


GLOBE = """<!doctype html><style>body { margin: 0; overflow: hidden }
#show, canvas { width: 100vw; height: 100vh }
.cesium-widget-credits { display: none !important }</style><div id="show"></div>
<script>CESIUM_BASE_URL = "cesium/"</script><script src="cesium/Cesium.js"></script><script>
async function start(url, pixels, camera) {
  const off = { globe: false, skyBox: false, skyAtmosphere: false, baseLayer: false, msaaSamples: 1 };
  const widget = new Cesium.CesiumWidget("show", off), scene = widget.scene;
  scene.sun = scene.moon = undefined;
  scene.backgroundColor = Cesium.Color.BLACK;
  const vector = name => new Cesium.Cartesian3(...camera[name]);
  Object.assign(scene.camera.frustum, { fov: camera.fov, near: 0.01, far: 1e5 });
  const orientation = { direction: vector("direction"), up: vector("up") };
  scene.camera.setView({ destination: vector("position"), orientation });
  const tiles = await Cesium.Cesium3DTileset.fromUrl(url, { maximumScreenSpaceError: pixels });
  scene.primitives.add(tiles);
  window.shown = () => tiles.tilesLoaded && tiles.gaussianSplatPrimitive ? tiles._selectedTiles.map(
    tile => tile.content.url.split("/").pop()).sort().join() : "";
}</script>"""


@pytest.mark.parametrize("level", [0, 2])
def test_cesium_shows_each_level_on_the_globe(
    browser: Browser, site: tuple[Path, str], levels: tuple[Splats, ...], level: int
) -> None:
    """CesiumJS widens Gaussians by 0.3 / 16 square pixels, not by 0.3, so a larger render is taken, and of
    4 × 4 pixels the middle four."""
    folder, address = site
    place = Georeference(24.75, 59.43, 30, 40)
    if not (folder / "cesium").exists():
        (folder / "cesium").symlink_to(package("cesium", "Build", "Cesium"))
        (folder / "globe.html").write_text(GLOBE)
        save_tileset(folder / "globe", levels, up=(0, 0, 1), place=place, cut=Cut(4096, 1.0, 512))
    turn, origin = place.matrix()[:3, :3], place.matrix()[:3, 3]
    # far, so that a level's tiles have about the same error on the screen
    eye = np.array([18, -16, 9.0])
    large = Camera.facing(eye, [0, 0, 0], width=4 * WIDTH, height=4 * HEIGHT, fov=6)
    picture = np.clip(Renderer(levels[level]).image(large), 0, 1).reshape(HEIGHT, 4, WIDTH, 4, 3)
    expected = picture[:, 1:3, :, 1:3].mean(axis=(1, 3))
    camera = {
        "position": (turn @ eye + origin).tolist(),
        "direction": (turn @ -eye / np.linalg.norm(eye)).tolist(),
        "up": (turn @ [0, 0, 1]).tolist(),
        "fov": float(np.radians(6)),
    }
    tiles = [json.loads((folder / "globe" / "tileset.json").read_text())["root"]]
    errors: dict[str, list[float]] = {"2": []}
    for tile in tiles:
        tiles += tile.get("children", [])
        errors.setdefault(tile["content"]["uri"][0], []).append(tile["geometricError"])
    error = 1.5 * max(errors["2"]) if level else 0.0
    pixels = max(0.01, float(error * large.K[0, 0] / 4 / np.linalg.norm(eye)))
    browser.open(f"{address}/globe.html")
    browser.run(
        "new Promise(done => { const look = () => window.start ? done() : setTimeout(look, 50); look(); })"
    )
    browser.run(f"start('globe/tileset.json', {pixels}, {json.dumps(camera)})")
    until, found = time.monotonic() + 180, 0.0
    while found < 35 and time.monotonic() < until:
        browser.run("new Promise(done => setTimeout(done, 500))")
        found = psnr(browser.picture() / np.float32(255), expected)
    assert found > 35, browser.run("shown()")
    assert {name[0] for name in browser.run("shown()").split(",")} == {str(level)}


NEEDS = "document.getElementById('needs').innerText"


def told(browser: Browser, url: str) -> str:
    """Open a page for CesiumJS and return the message that it shows instead of tiles, or ""."""
    browser.open(url)
    browser.run(
        "new Promise(done => { const look = () => window.g2ard ? done() : setTimeout(look, 20); look(); })"
    )
    return str(browser.run(f"g2ard.ready.then(() => '', () => {NEEDS})"))


def test_a_globe_page_without_cesium_says_what_it_needs(
    browser: Browser, site: tuple[Path, str], levels: tuple[Splats, ...]
) -> None:
    folder, address = site
    views = Cameras.of([FRONT])
    write_level_page(folder, levels, "3dtiles", GivenViews(views, None, (0, 0, 1)))
    assert "?cesium=https://" in told(browser, f"{address}/index.html")
    assert "No CesiumJS at" in told(browser, f"{address}/index.html?cesium=nowhere/")
    assert "http.server" in told(browser, (folder / "index.html").as_uri())
    page = folder / "typed.html"
    page.write_text((folder / "index.html").read_text().replace("CESIUM = ''", "CESIUM = 'typed'"))
    assert "typed/Cesium.js" in told(browser, f"{address}/typed.html")


@pytest.mark.parametrize("place", [None, Georeference(24.75, 59.43, 30, 40)])
def test_a_globe_page_opens_at_the_view(
    browser: Browser, site: tuple[Path, str], levels: tuple[Splats, ...], place: Georeference | None
) -> None:
    folder, address = site
    peer = package("cesium", "Build", "Cesium")
    name = f"page-{place is None}"
    save_tileset(folder / name, levels[-1:], up=(0, 0, 1), place=place)
    (folder / name / "cesium").symlink_to(peer)
    write_level_page(
        folder / name, levels[-1:], "3dtiles", GivenViews(Cameras.of([FRONT]), None, (0, 0, 1))
    )
    assert told(browser, f"{address}/{name}/?cesium=cesium") == ""
    camera = opened(folder / name / "index.html", FRONT)
    expected, until, found = rendered(levels[-1], camera), time.monotonic() + 60, 0.0
    # nothing behind the ball but the globe and the sky
    inside = np.abs(expected - GREY).max(-1) > 0.1
    while found < 25 and time.monotonic() < until:
        browser.run("new Promise(done => setTimeout(done, 500))")
        found = psnr(browser.picture()[inside][None] / np.float32(255), expected[inside][None])
    assert found > 25
