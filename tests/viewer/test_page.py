"""Pages for the browser: what is in the file, how scenes stand in it, the command.

`test_view_browser.py` opens them.
"""

import base64
import gzip
import hashlib
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from g2ard.cli.run_folder import RunFolder
from g2ard.errors import InputError, OutputError
from g2ard.io import Source, read_splats, write_splats, write_views
from g2ard.io.types import ViewSet
from g2ard.jobs import budget
from g2ard.jobs.inputs import GivenViews
from g2ard.jobs.viewer_frame import choose_frame, place_frame
from g2ard.pipeline.distill import RunViews
from g2ard.scene.cameras import Camera, Cameras
from g2ard.scene.splats import Splats
from g2ard.viewer import page as viewer
from g2ard.viewer.page import Start, check_page_output, write_page
from helpers.commands import CommandLine, refused
from helpers.scenes import around, checkered_ball

BUNDLE = Path(viewer.__file__).parent / "supersplat"


class Parts(HTMLParser):
    """Scripts by id (or type), labels, and every address that an element names."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.scripts: dict[str, str] = {}
        self.labels: list[str] = []
        self.addresses: list[str] = []
        self._into = ""
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.addresses += [
            value or "" for key, value in attrs if key in ("src", "href", "srcset", "data")
        ]
        self._into = (given.get("id") or given.get("type") or "") if tag == "script" else ""
        if given.get("class") == "label":
            self._into = "label"

    def handle_data(self, data: str) -> None:
        if self._into == "label":
            self.labels.append(data)
        elif self._into:
            self.scripts[self._into] = self.scripts.get(self._into, "") + data

    def handle_endtag(self, tag: str) -> None:
        self._into = ""

    def scene(self, index: int, folder: Path) -> Splats:
        """A scene of the page, read back."""
        file = folder / f"back{index}.sog"
        file.write_bytes(base64.b64decode(self.scripts[f"scene{index}"], validate=True))
        return read_splats(file)


def test_the_bundle_is_the_one_its_readme_names() -> None:
    readme = (BUNDLE / "README.md").read_text(encoding="utf-8")
    sums = dict(re.findall(r"`public/(\S+)` \| `([0-9a-f]{64})`", readme))
    script = gzip.decompress((BUNDLE / "index.js.gz").read_bytes())
    found = {"index.js": script, "index.css": (BUNDLE / "index.css").read_bytes()}
    assert {name: hashlib.sha256(data).hexdigest() for name, data in found.items()} == sums
    release = re.search(r"SuperSplat Viewer (\S+)", readme)
    assert release
    assert f"SuperSplat Viewer {release[1]} " in viewer._NOTICE
    assert f'version = "{release[1]}"'.encode() in script


def test_a_page_holds_viewer_and_scene_and_names_no_address(tmp_path: Path) -> None:
    ball = checkered_ball(200)
    start = Start((1.0, 2.0, 3.0), (0.0, 0.0, 0.5), ((0.5, 42.0), (2.0, 30.0)))
    written, sizes = write_page(
        tmp_path / "a.html",
        [("a </script> & b", ball)],
        start=start,
        stops=[("worst", start)],
        background=(1.0, 0.5, 0.25),
    )
    parts = Parts(tmp_path / "a.html")
    assert written == (tmp_path / "a.html").stat().st_size
    assert parts.addresses == ["data:,"]
    assert parts.labels == ["a </script> & b"]
    view = json.loads(parts.scripts["view"])
    assert view == {
        "start": {"position": [1, 2, 3], "target": [0, 0, 0.5], "fov": [[0.5, 42], [2, 30]]},
        "stops": [
            {
                "title": "worst",
                "position": [1, 2, 3],
                "target": [0, 0, 0.5],
                "fov": [[0.5, 42], [2, 30]],
            }
        ],
        "background": [1, 0.5, 0.25],
        "files": ["scene0.sog"],
        "antialiased": [False],
        "placed": None,
    }
    assert base64.b64decode(parts.scripts["viewer"]) == (BUNDLE / "index.js.gz").read_bytes()
    back = parts.scene(0, tmp_path)
    assert len(back) == 200
    assert back.sh_degree == ball.sh_degree
    assert sizes == ((tmp_path / "back0.sog").stat().st_size,)
    assert "createViewer" in parts.scripts["module"]
    text = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert "Permission is hereby granted" in text
    assert not re.search(r"url\((?!data:)|@import", text)


def test_equal_scenes_give_equal_bytes_and_two_scenes_two_scripts(tmp_path: Path) -> None:
    scenes = [("left", checkered_ball(150)), ("right", checkered_ball(80, seed=1))]
    for name in ("a.html", "b.html"):
        write_page(tmp_path / name, scenes)
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()
    parts = Parts(tmp_path / "a.html")
    assert [len(parts.scene(index, tmp_path)) for index in (0, 1)] == [150, 80]
    assert parts.labels == ["left", "right"]
    assert json.loads(parts.scripts["view"])["start"] is None


def test_failures_leave_no_half_written_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ball = checkered_ball(20)
    with pytest.raises(OutputError, match=r"a\.txt: expected a file name that ends in \.html"):
        check_page_output(tmp_path / "a.txt")
    write_page(tmp_path / "made" / "too" / "a.HTML", [("a", ball)])
    with pytest.raises(OutputError, match="exists"):
        write_page(tmp_path / "made" / "too" / "a.HTML", [("a", ball)])
    with pytest.raises(InputError, match=r"b\.html"):
        write_page(tmp_path / "b.html", [("a", ball.take(slice(0)))])
    monkeypatch.setattr(viewer, "_LARGEST_SOG_BYTES", 100)
    with pytest.raises(InputError, match="browsers accept at most"):
        write_page(tmp_path / "b.html", [("a", ball)])
    assert [path.name for path in tmp_path.iterdir()] == ["made"]


def in_viewer(points: np.ndarray, start: Start, width: int, height: int) -> np.ndarray:
    """Twin: (N, 2) pixels of points of a scene's file as the viewer shows them: turned by 180° about z, for
    a camera with y up and no roll, in a window of the view's shape."""
    world = points * [-1, -1, 1]
    eye, target = np.array(start.position), np.array(start.target)
    back = (eye - target) / np.linalg.norm(eye - target)
    right = np.cross([0, 1, 0], back)
    right /= np.linalg.norm(right)
    x, y, z = np.stack([right, np.cross(back, right), back]) @ (world - eye).T
    (vertical,) = (degrees for aspect, degrees in start.fov if np.isclose(aspect, width / height))
    focal = height / 2 / np.tan(np.radians(vertical) / 2)
    return np.stack([width / 2 - focal * x / z, height / 2 + focal * y / z], 1)


@pytest.mark.parametrize("seed", range(8))
def test_the_start_shows_what_the_view_shows(seed: int) -> None:
    rng = np.random.default_rng(seed)
    ball = checkered_ball(300)
    offset = rng.normal(size=3) * 10.0 ** rng.integers(0, 6)
    # the very opposite of the viewer's
    up = rng.normal(size=3) if seed else np.array([0.0, 1.0, 0.0])
    size = (int(rng.integers(100, 400)), int(rng.integers(100, 400)))
    scene = Splats.create(
        ball.means, quats=ball.quats, scales=ball.scales, sh0=ball.sh0, shN=ball.shN, offset=offset
    )
    eye = offset + 3 * rng.normal(size=3)
    camera = Camera.facing(eye, offset, width=size[0], height=size[1], fov=50, up=up)
    stand = place_frame(scene, Cameras.of([camera]), up=tuple(up), start=camera.name)
    here = stand.of(scene)
    assert not here.offset.any()
    assert np.allclose(stand.up, up / np.linalg.norm(up))
    world = scene.means.astype(np.float64) + offset
    x, y, z = camera.viewmat[:3, :3] @ (world - camera.position).T
    expected = np.stack([camera.K[0, 0] * x / z, camera.K[1, 1] * y / z], 1) + np.array(size) / 2
    assert stand.start
    front = z > 0.5
    found = in_viewer(here.means.astype(np.float64), stand.start, *size)
    assert np.abs(found - expected)[front].max() < 0.05


def test_level_views_tell_up_and_a_single_one_does_not() -> None:
    ball = checkered_ball(400)
    views = around(12)  # all level with z
    stand = place_frame(ball, views)
    assert np.allclose(stand.up, [0, 0, 1], atol=1e-6)
    alone = place_frame(ball, views.take([5]))
    assert np.linalg.norm(alone.up) == pytest.approx(1)
    assert alone.name == "view_005"


def test_drones_that_look_straight_down_are_above() -> None:
    views = []
    for k, turn in enumerate(np.linspace(0, 2 * np.pi, 9)[:-1]):
        top = np.array([np.cos(turn), np.sin(turn), 0])
        views.append(Camera.facing([k, 1, 5], [k, 1, 0] - 0.1 * top, up=top, name=str(k)))
    assert np.allclose(place_frame(checkered_ball(400), Cameras.of(views)).up, [0, 0, 1], atol=1e-6)


def test_photos_that_all_face_one_way_tell_up() -> None:
    up, tilts = np.array([0.6, 0, 0.8]), np.random.default_rng(0).normal(size=(6, 3)) * 0.02
    views = Cameras.of(
        Camera.facing([k / 9, -4, 0], [k / 9, 0, 0], up=up + tilt, name=f"{k}.jpg")
        for k, tilt in enumerate(tilts)
    )
    photos = replace(views, image_paths=tuple(map(Path, views.names)))
    assert np.allclose(place_frame(checkered_ball(400), photos).up, [0.6, 0, 0.8], atol=0.05)


def test_a_page_starts_at_a_typical_view_with_detail_or_the_one_named() -> None:
    ball = checkered_ball(3000)
    plain = np.where(ball.means[:, 1, None, None] > 0, np.float32(0), ball.sh0)  # behind
    scene = replace(ball, sh0=plain, shN=0 * ball.shN)
    away = Camera.facing([0, -4, 0], [0, -9, 0], name="away")
    below = Camera.facing([0.1, -0.5, -3], [0, 0, 0], name="below")
    close = replace(Camera.facing([0, -3, 1], [0, 0, 0], name="close"), kind="near")
    ring = [
        Camera.facing([3 * np.sin(turn), 3 * np.cos(turn), 1], [0, 0, 0], name=f"pose_{turn:.1f}")
        for turn in np.linspace(0, 6, 12)
    ]
    views = Cameras.of([away, below, close, *ring])
    opened = views[views.names.index(str(place_frame(scene, views).name))]
    assert opened.name.startswith("pose_")
    assert opened.position[1] < -2
    assert place_frame(ball, views, start="below").name == "below"
    assert (
        place_frame(ball, views, start="away").start is not None
    )  # sees nothing, and may still be asked for
    with pytest.raises(InputError, match="no view 'far'"):
        place_frame(ball, views, start="far")


def test_a_scene_without_views_is_looked_at_from_around_and_one_without_room_as_a_whole() -> None:
    said: list[str] = []
    stand = choose_frame(checkered_ball(500), GivenViews(say=said.append))
    assert stand.name
    assert stand.name == "view_0000"
    nothing = Splats.create([[0, 0, 0]], scales=[[1, 1, 1]], logit_opacities=[-20])
    assert choose_frame(nothing, GivenViews(say=said.append)).start is None
    assert "no pose to start at" in said[-1]
    with pytest.raises(InputError):
        choose_frame(nothing, GivenViews(), start="pose_0000")


def test_a_run_has_a_page_unless_too_large(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ball, path = checkered_ball(300), tmp_path / "run" / "view.html"
    folder = RunFolder(None, tmp_path / "run", "scene.sog", resume=False)
    size, line = folder.write_view(ball, None, around(6), (1.0, 1.0, 1.0))
    assert size == path.stat().st_size
    assert "view.html" in line
    assert Parts(path).labels == ["result: run, 300 Gaussians"]
    write_splats(tmp_path / "ball.ply", ball)
    whole = Source(tmp_path / "ball.ply"), ball
    folder.write_view(ball.take(range(30)), whole, around(6), (1.0, 1.0, 1.0))
    assert Parts(path).labels == [
        "dense scene: ball.ply, 300 Gaussians",
        "result: run, 30 Gaussians",
    ]
    for dense, largest in ((ball, 299), (ball.take(range(30)), 300)):  # too large, or the same
        monkeypatch.setattr("g2ard.cli.run_folder.LARGEST_DENSE", largest)
        folder.write_view(ball.take(range(30)), (whole[0], dense), around(6), (1.0, 1.0, 1.0))
        assert Parts(path).labels == ["result: run, 30 Gaussians"]
    config = {"keep": False, "views_format": "g2ard"}
    run = SimpleNamespace(
        write=lambda scene, splats, **_: write_splats(scene, splats), config=config
    )
    views = RunViews(ViewSet(around(4)), around(2))
    RunFolder(run, tmp_path / "run", "scene.sog", resume=False).write(
        SimpleNamespace(splats=ball), views, SimpleNamespace(apart=None)
    )
    assert not path.exists()  # a page of an earlier run
    monkeypatch.setitem(budget.DEVICES, "web", 299)
    size, line = folder.write_view(ball, None, around(6), (1.0, 1.0, 1.0))
    assert size is None
    assert "over 299 Gaussians" in line
    assert not path.exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["none.ply", "-o", "a.html"], "none.ply"),
        (["dense.ply", "none.ply", "-o", "a.html"], "none.ply"),
        (["dense.ply", "-o", "a.png"], "a.png: expected a file name that ends in .html"),
        (["dense.ply", "-o", "a.html", "--views", "none.json"], "none.json"),
        (["dense.ply", "-o", "a.html", "--views", "v.json", "--start", "nope"], "nope"),
        (["empty", "-o", "a.html"], "empty"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(
    arguments: list[str], words: str, command_line: CommandLine, tmp_path: Path
) -> None:
    write_splats(tmp_path / "dense.ply", checkered_ball(50))
    write_views(tmp_path / "v.json", around(2))
    (tmp_path / "empty").mkdir()
    assert words in refused(command_line, tmp_path, "view", *arguments, status=1)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["dense.ply", "empty", "v.json"]


@pytest.mark.parametrize("height", [0.5, 1.4])
def test_a_page_opens_with_the_whole_subject_in_sight(height: float) -> None:
    rng = np.random.default_rng(0)
    tall = Splats.create(
        rng.uniform(-1, 1, (3000, 3)) * [0.4, height, 0.4],
        scales=np.full((3000, 3), 0.05),
        logit_opacities=np.full(3000, 4.0),
    )
    stand = place_frame(tall, None, up=(0, -1, 0))
    assert stand.start is not None
    eye, target = (stand.world(point) for point in (stand.start.position, stand.start.target))
    _, vertical = stand.start.fov[-1]
    across = 2 * np.degrees(np.arctan(np.tan(np.radians(vertical) / 2) * 120 / 90))
    opened = Camera.facing(eye, target, width=120, height=90, fov=across, up=(0, -1, 0))
    assert opened.holds(tall.means).mean() >= 0.99
