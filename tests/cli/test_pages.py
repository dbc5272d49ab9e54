"""Pages of all commands: which scene is on which side, what things are called, and what is behind them."""

import json
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import g2ard
from g2ard.config.choices import BLACK
from g2ard.rendering.sky import BOTTOM, TOP
from g2ard.viewer import page as viewer_page
from helpers.calls import CALLS
from helpers.commands import CommandLine, refused, succeeds
from helpers.photos import photos_of
from helpers.scenes import checkered_ball

OTHER_WORDS = re.compile(
    r"\b(teacher|student|reference|original|recovered|distilled|prior)\b", re.I
)
"""Words that nobody reads for the dense scene, the target or the result."""


class Text(HTMLParser):
    """Text of a page with alternative texts and titles, the labels of its scenes, and its settings."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.text = ""
        self.labels: list[str] = []
        self.view: dict[str, Any] = {}
        self._inside: tuple[str, dict[str, str | None]] = ("", {})
        self.feed(page.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._inside = tag, dict(attrs)
        self.text += "".join(
            f"\n{value}" for key, value in attrs if key in ("alt", "title", "aria-label")
        )

    def handle_endtag(self, tag: str) -> None:
        self._inside = "", {}

    def handle_data(self, data: str) -> None:
        tag, given = self._inside
        if given.get("id") == "view":
            self.view = json.loads(data)
        if tag not in ("script", "style"):
            self.text += f"\n{data}"
        if given.get("class") == "label":
            self.labels.append(data)


BOTH = ["dense scene: ball.ply, 400 Gaussians", "result: run, 50 Gaussians"]
PAGES: dict[str, tuple[str | None, list[str]]] = {
    "run/view.html": (
        "distill ball.ply -r 8 --views views.json --steps 2 --size 24 --page -o run",
        BOTH,
    ),
    "run/report.html": (None, []),
    "given.html": ("view ball.ply run -o given.html", BOTH),
    "turned.html": ("view run ball.ply -o turned.html", BOTH),
    "compared.html": ("compare ball.ply run --views views.json -o compared.html", BOTH),
    "back.html": ("compare run ball.ply --views views.json -o back.html", BOTH),
    "two.html": (
        "compare ball.ply other.ply --views views.json -o two.html",
        ["ball.ply: 400 Gaussians", "other.ply: 200 Gaussians"],
    ),
    "levels/index.html": (
        "lod ball.ply -r 4,8 --merge-only --views views.json -o levels",
        ["ball.ply"],
    ),
    "page.html": (CALLS["register"], []),
}
"""Page → the command that writes it, unless an earlier one did, and its labels from left to right."""


@pytest.fixture(scope="module")
def made(inputs: Path, tmp_path_factory: pytest.TempPathFactory, command_line: CommandLine) -> Path:
    """Return a folder with all pages."""
    folder = shutil.copytree(inputs, tmp_path_factory.mktemp("pages") / "files")
    for command, _ in PAGES.values():
        if command is not None:
            succeeds(command_line, folder, *command.split())
    return folder


@pytest.mark.parametrize("page", PAGES)
def test_the_dense_scene_is_left_and_the_result_right(page: str, made: Path) -> None:
    assert Text(made / page).labels == PAGES[page][1]


@pytest.mark.parametrize("page", PAGES)
def test_pages_have_one_word_for_a_thing(page: str, made: Path) -> None:
    text = Text(made / page).text
    assert len(text) > 50
    assert OTHER_WORDS.findall(text) == []


@pytest.mark.parametrize(
    "command",
    [
        "distill ball.ply -r 8 --views views.json --steps 2 --size 24 -o said",
        "compare ball.ply run --views views.json -w -o compared.html",
        "compare other.ply run --views views.json",
        "info run",
        "evaluate run",
        "view run ball.ply -w -o turned.html",
    ],
)
def test_messages_have_the_words_of_pages(
    command: str, made: Path, command_line: CommandLine
) -> None:
    told = "".join(succeeds(command_line, made, *command.split(), "-v"))
    told = re.sub(r"--teacher|simplified but not recovered", "", told)
    assert OTHER_WORDS.findall(told) == []


def test_a_report_opens_with_the_size_and_links_and_says_what_next(made: Path) -> None:
    run = made / "run"
    page = (run / "report.html").read_text(encoding="utf-8")
    top, rest = page.split('class="slider"', 1)
    size = f"{(run / 'scene.ply').stat().st_size / 1e6:.2f} MB"
    assert f"{size} as .ply: " in top
    links = re.findall(r'href="([^"]+)"', top)
    assert links == ["scene.ply", "view.html", "."]
    assert all((run / link).exists() for link in links)
    assert f"<pre>g2ard {PAGES['run/view.html'][0]}</pre>" in rest
    assert ">recover.seed<" in rest  # the settings
    assert re.findall(r"g2ard (\w+) scene\.ply", rest) == ["distill", "lod", "adapt"]


def test_the_preview_is_large_whatever_the_views_are(
    made: Path, of_photos: tuple[Path, str]
) -> None:
    for run in (made / "run", of_photos[0]):
        with Image.open(run / "preview.png") as found:
            assert 1200 <= found.width < 3000


def test_a_registration_shows_photos_and_renders(made: Path) -> None:
    page = (made / "page.html").read_text(encoding="utf-8")
    assert set(re.findall(r"<figcaption>(\w+)</figcaption>", page)) == {"photo", "render", "start"}
    assert 'class="tag left">photo<' in page
    rows = re.findall(r"<tr>(<td.*?)</tr>", page)
    for column in set(re.findall(r'data-column="([^"]+)"', page)):
        assert any(re.search(rf'data-column="{re.escape(column)}">[^<]', row) for row in rows)


@pytest.mark.parametrize("options", ["--fit page:1.1MB", "-r 8 --no-compare"])
def test_a_page_fits_its_bytes_and_holds_the_result_alone(
    options: str, made: Path, tmp_path: Path, command_line: CommandLine
) -> None:
    g2ard.save(tmp_path / "ball.ply", checkered_ball(3000))
    ask = ("distill", "ball.ply", *options.split(), "--views", made / "views.json", "--steps", 2)
    ask = (*ask, "--focus", "far", "-o", "run")
    succeeds(command_line, tmp_path, *ask)
    page = tmp_path / "run" / "view.html"
    (label,) = Text(page).labels
    assert label.startswith("result: run")
    if "page" in options:
        assert 1_080_000 < page.stat().st_size <= 1_100_000
        refusal = refused(
            command_line, tmp_path, *ask[:2], "--fit", "page:9kB", *ask[4:-1], "other", status=1
        )
        assert "--fit: 9,000 bytes are too few; the viewer takes 1,0" in refusal


def test_one_view_is_rendered_to_a_picture(made: Path, command_line: CommandLine) -> None:
    for name, options in (
        ("one.png", ["-k", "1", "--size", "90x60"]),
        ("best.png", ["--size", "90x60"]),
    ):
        succeeds(command_line, made, "render", "ball.ply", *options, "-o", name)
        with Image.open(made / name) as found:
            assert found.size == (90, 60)
            assert np.asarray(found).std() > 5


@pytest.fixture(scope="module")
def of_photos(
    tmp_path_factory: pytest.TempPathFactory, command_line: CommandLine
) -> tuple[Path, str]:
    """Return the folder of a run from photos alone, and what it printed."""
    folder = tmp_path_factory.mktemp("photos")
    photos_of(folder / "bust", points=True, count=16)
    ask = "distill --views bust -n 200 --steps 4 --page -o run"
    return folder / "run", succeeds(command_line, folder, *ask.split()).err


def test_photos_alone_show_the_photo_beside_the_result(of_photos: tuple[Path, str]) -> None:
    run, told = of_photos
    page = (run / "report.html").read_text(encoding="utf-8")
    text = Text(run / "report.html").text
    assert set(re.findall(r"<option[^>]*>(\w+) ", page)) == {"result"}
    assert "start → result" in text
    assert "start → result" in told
    assert "simplified" not in text + told
    size = f"{(run / 'scene.ply').stat().st_size / 1e6:.2f} MB"
    for line in (text, told):
        assert f"{size} as .ply" in line
        assert f"→ {size}" not in line  # the first points are no larger scene
    assert Text(run / "view.html").labels == ["result: run, 200 Gaussians"]
    with Image.open(run / "preview.png") as found:
        assert found.width < 1400  # two photos of 64 pixels beside each other, enlarged


CLOUD_COMMANDS = [
    "simplify autumn.ply -r 8 --no-views -o reduced.ply",
    "distill autumn.ply -r 8 --views made --steps 2 --size 24 --page -o run",
    "distill autumn.ply -r 8 --views photos.json --steps 2 -o run",
    "distill autumn.ply -r 1 --views made --steps 2 --size 24 -o run",
    "distill autumn.ply -n 401 --views made -o run",
]


@pytest.mark.parametrize("command", CLOUD_COMMANDS)
def test_points_are_points(command: str, work: Path, command_line: CommandLine) -> None:
    (work / "cloud.ply").rename(work / "autumn.ply")
    _, _, told = command_line(*command.split(), cwd=work)
    for run in work.glob("run"):
        told += succeeds(command_line, work, "info", run).out
        told += "".join(Text(page).text for page in run.glob("*.html"))
        following = re.findall(r"g2ard (\w+) scene\.ply", Text(run / "report.html").text)
        assert following == ["distill", "lod", *["adapt"] * ("photos" in command)]
    as_many = "→ 400 Gaussians|400 Gaussians from 400 points|result: run, 400 Gaussians"
    told = re.sub(as_many, "", told)
    assert re.search("400 points|at most 400,", told)
    assert not re.search(r"\b400 (Gaussian|→)", told), told


LIFT_PAGES = {
    "view.html": "view lifted.ply -o view.html",
    "two.html": "compare lifted.ply other.ply --views views.json -o two.html",
    "levels/index.html": "lod lifted.ply -r 1,4 --merge-only --views views.json -o levels",
    "run/view.html": "distill cloud.ply -r 8 --views made --steps 2 --size 24 --page -o run",
    "tileset/index.html": "lod lifted.ply -r 1,4 --merge-only --format 3dtiles --views views.json -o tileset",
}


@pytest.fixture(scope="module")
def lifted(
    inputs: Path, tmp_path_factory: pytest.TempPathFactory, command_line: CommandLine
) -> Path:
    folder = shutil.copytree(inputs, tmp_path_factory.mktemp("lifted") / "files")
    succeeds(command_line, folder, "lift", "cloud.ply", "-o", "lifted.ply")
    return folder


@pytest.mark.parametrize("page", LIFT_PAGES)
@pytest.mark.parametrize("given", [None, (0.25, 0.5, 1.0)])
def test_lifts_are_before_a_soft_gradient_unless_a_background_is_given(
    page: str, given: tuple[float, ...] | None, lifted: Path, command_line: CommandLine
) -> None:
    colour = () if given is None else ("--background", ",".join(map(str, given)))
    succeeds(command_line, lifted, *LIFT_PAGES[page].split(), "-w", *colour)
    assert background_of(lifted / page) == (given and list(given))
    if page.startswith("run/"):
        report = lifted / "run" / "report.json"
        settings = json.loads(report.read_text(encoding="utf-8"))["settings"]
        assert settings["recover.background"] == list(given or BLACK)
    if given is None:
        trained = (
            LIFT_PAGES[page].replace("lifted.ply", "ball.ply").replace("cloud.ply", "ball.ply")
        )
        succeeds(command_line, lifted, *trained.split(), "-w")
        assert background_of(lifted / page) == list(BLACK)


def background_of(page: Path) -> Any:
    found = re.search(r'"background": (null|\[[^]]*\])', page.read_text(encoding="utf-8"))
    assert found is not None
    return json.loads(found[1])


def _corner(picture: Path, left: int = 12, top: int = 64) -> tuple[int, ...]:
    with Image.open(picture) as image:
        return image.convert("RGB").getpixel((left, top))


@pytest.mark.parametrize(
    ("ask", "behind"),
    [
        ("lifted.ply -k 1", TOP),
        ("lifted.ply --orbit 2", TOP),
        ("lifted.ply -k 1 --background black", BLACK),
        ("lifted.ply --views views.json", BLACK),  # data, not a picture
        ("ball.ply -k 1", BLACK),
    ],
)
def test_pictures_of_lifts_have_the_sky_of_their_pages(
    ask: str, behind: tuple[float, ...], lifted: Path, tmp_path: Path, command_line: CommandLine
) -> None:
    succeeds(command_line, lifted, "render", *ask.split(), "--size", 64, "-o", tmp_path / "drawn")
    assert _corner(next((tmp_path / "drawn").glob("*.png")), 0, 0) == behind


def test_the_picture_of_a_run_has_the_sky_behind_a_lift(
    lifted: Path, command_line: CommandLine
) -> None:
    ask = ("distill", "-n", 60, "--steps", 2, "--size", 48, "--no-page", "-w", "-o", "run")
    corners = []
    for scene in ("cloud.ply", "ball.ply"):
        succeeds(command_line, lifted, *ask, scene)
        corners.append(_corner(lifted / "run" / "preview.png"))
    sky, black = (np.array(corner, float) for corner in corners)
    low, high = np.minimum(TOP, BOTTOM), np.maximum(TOP, BOTTOM)
    assert ((sky >= low - 1) & (sky <= high + 1)).all()
    assert black.max() < 8


def test_the_sky_of_pictures_is_that_of_pages() -> None:
    style = (Path(viewer_page.__file__).parent / "page.css").read_text(encoding="utf-8")
    colors = [
        tuple(bytes.fromhex(found)) for found in re.findall(r"gradient\(#(\w+), #(\w+)\)", style)[0]
    ]
    assert colors == [TOP, BOTTOM]
