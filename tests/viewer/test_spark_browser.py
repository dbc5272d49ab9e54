"""Files shown by Spark, a viewer of other people's, which tells the axes that it takes each format in."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from g2ard.io import write_splats
from g2ard.rendering.metrics import psnr
from g2ard.rendering.renderer import Renderer
from g2ard.scene.cameras import Camera
from g2ard.scene.transform import moving, transform
from helpers.browser import Browser
from helpers.pages import served
from helpers.peers import package
from helpers.scenes import checkered_ball

WIDTH, HEIGHT = 160, 120
VIEW = Camera.facing([1.8, -1.6, 0.9], [0.3, 0, 0.2], width=WIDTH, height=HEIGHT, fov=55)
PAGE = """<!doctype html><style>body { margin: 0; overflow: hidden }</style>
<script type="importmap">{ "imports": { "three": "./three/build/three.module.js",
  "three/addons/": "./three/examples/jsm/", "@sparkjsdev/spark": "./spark/spark.module.js" } }</script>
<script type="module">
import * as THREE from "three";
import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
window.show = async (url, turned, matrix, fov) => {
  const renderer = new THREE.WebGLRenderer({ antialias: false, preserveDrawingBuffer: true });
  renderer.setSize(innerWidth, innerHeight);
  document.body.replaceChildren(renderer.domElement);
  const scene = new THREE.Scene();
  const camera = new THREE.PerspectiveCamera(fov, innerWidth / innerHeight, 0.01, 100);
  new THREE.Matrix4().fromArray(matrix).decompose(camera.position, camera.quaternion, camera.scale);
  const mesh = new SplatMesh({ url });
  if (turned) mesh.quaternion.set(1, 0, 0, 0);
  scene.add(new SparkRenderer({ renderer }), mesh);
  await mesh.initialized;
  // Spark sorts in a worker: render until something shows and stays the same.
  const gl = renderer.getContext(), pixels = new Uint8Array(4 * innerWidth * innerHeight);
  for (let last = 0, same = 0; same < 8; await new Promise(done => setTimeout(done, 50))) {
    renderer.render(scene, camera);
    gl.readPixels(0, 0, innerWidth, innerHeight, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
    const sum = pixels.reduce((total, value, i) => total + (i % 4 < 3 ? value * (i % 8191) : 0), 0);
    same = sum && sum === last ? same + 1 : 0;
    last = sum;
  }
};
</script>"""


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, Browser]]:
    """A folder, and a browser with Spark's page in it."""
    folder = tmp_path_factory.mktemp("spark")
    (folder / "three").symlink_to(package("three"))
    (folder / "spark").symlink_to(package("@sparkjsdev", "spark", "dist"))
    (folder / "index.html").write_text(PAGE)
    with served(folder) as address, Browser(WIDTH, HEIGHT) as browser:
        browser.open(f"{address}/")
        browser.run(
            "new Promise(done => { const look = () => window.show ? done() : setTimeout(look, 50); look(); })"
        )
        yield folder, browser


@pytest.mark.parametrize(
    ("name", "turned", "options"),
    [
        ("a.ply", True, {}),
        ("a.sog", True, {}),
        ("a.spz", False, {}),
        ("as_ply.spz", True, {"axes": "RDF"}),
    ],
)
def test_spark_shows_a_file(
    shown: tuple[Path, Browser], name: str, turned: bool, options: dict[str, str]
) -> None:
    """Only an .spz by its definition stands upright as it is, see `docs/how-to/engines.md`."""
    folder, browser = shown
    scene = checkered_ball(2000)
    write_splats(folder / name, scene, **options)
    flip = np.diag([1.0, -1, -1, 1])
    matrix = flip @ np.linalg.inv(VIEW.viewmat) @ flip
    fov = float(np.degrees(2 * np.arctan(HEIGHT / 2 / VIEW.K[1, 1])))
    expected = np.clip(Renderer(scene).image(VIEW), 0, 1)
    # wrong ones look unlike
    for turn in (turned, not turned) if name in ("a.ply", "a.spz") else (turned,):
        browser.run(
            f"show('{name}', {json.dumps(turn)}, {json.dumps(matrix.T.ravel().tolist())}, {fov})"
        )
        likeness = psnr(browser.picture() / np.float32(255), expected)
        assert (likeness > 30) == (turn == turned), likeness


@pytest.mark.parametrize(
    ("name", "turned"),
    [
        ("map.ply", True),
        ("map.compressed.ply", True),
        ("map.sog", True),
        ("map.spz", False),
        ("map.splat", True),
    ],
)
def test_spark_shows_a_map_upright(shown: tuple[Path, Browser], name: str, turned: bool) -> None:
    """A scan with z up, at coordinates of a map that half floats do not hold."""
    folder, browser = shown
    ball = checkered_ball(2000)
    scan = transform(ball, moving(1.0, (-90, 0, 0), (0, 0, 0)))  # −y of the ball is z of the scan
    write_splats(folder / name, replace(scan, axes="RFU", offset=np.array([5e5, 6e6, 0.0])))
    flip = np.diag([1.0, -1, -1, 1])
    matrix = flip @ np.linalg.inv(VIEW.viewmat) @ flip
    fov = float(np.degrees(2 * np.arctan(HEIGHT / 2 / VIEW.K[1, 1])))
    browser.run(
        f"show('{name}', {json.dumps(turned)}, {json.dumps(matrix.T.ravel().tolist())}, {fov})"
    )
    expected = np.clip(Renderer(ball).image(VIEW), 0, 1)
    assert psnr(browser.picture() / np.float32(255), expected) > 30
