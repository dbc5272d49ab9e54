"""Tests of notebooks: pages inline, and a line with a picture of scenes, views, targets and results."""

import ast
import base64
import inspect
import re
import sys
from collections.abc import Callable
from dataclasses import fields, replace
from html import unescape
from importlib import import_module
from io import BytesIO
from pathlib import Path
from types import FunctionType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

import g2ard
from g2ard.errors import InputError
from g2ard.io.photos import load_photo
from g2ard.io.reports import Report
from g2ard.rendering.targets import fingerprint_of
from g2ard.scene.lenses import PhotoLens
from g2ard.stages.clean import Cleaning
from helpers.project import ROOT
from helpers.scenes import around, checkered_ball
from helpers.view_files import photo as photo_file

BALL = checkered_ball(600)
VIEWS = around(3)


@pytest.fixture(scope="module")
def results() -> dict[str, Any]:
    done = g2ard.distill(BALL, count=60, views=VIEWS, steps=2, size=64)
    return {
        "Splats": BALL,
        "Simplified": g2ard.simplify(BALL, ratio=4, blind=True),
        "Distilled": done,
        "TeacherRenders": g2ard.TeacherRenders(BALL, VIEWS),
        "Camera": VIEWS[0],
        "Recovered": g2ard.recover(BALL, done.held_out, steps=2),
        "Adapted": g2ard.adapt(BALL, done.held_out),
        "Cleaned": g2ard.clean(BALL),
        "Levels": g2ard.lod(BALL, ratios=(1, 2), recover=False, views=VIEWS),
        "DistillReport": done.report,
        "SimplifyReport": done.report.rounds[0].simplify,
        "RecoverReport": done.report.rounds[0].recover[0],
        "Evaluation": done.scores,
    }


def embedded(html: str) -> np.ndarray:
    (data,) = re.findall(r'src="data:image/png;base64,([^"]+)"', html)
    return np.asarray(Image.open(BytesIO(base64.b64decode(data))))


def test_a_result_shows_its_held_out_score_at_the_views_own_size(results: dict[str, Any]) -> None:
    done = results["Distilled"]
    views = VIEWS.take([VIEWS.names.index(name) for name in done.held_out.cameras.names])
    known = g2ard.evaluate(done, g2ard.TeacherRenders(BALL, views)).psnr
    width, height = VIEWS[0].width, VIEWS[0].height
    held_out = (
        f"PSNR {known:.2f} dB in 1 held-out view against the dense scene, {width}×{height} px"
    )
    assert repr(done) == f"Distilled(60 Gaussians, {held_out})"


def test_results_show_a_line_and_a_picture(results: dict[str, Any]) -> None:
    for name, shown in results.items():
        line, html = repr(shown), shown._repr_html_()
        assert line.startswith(f"{name}("), line
        assert "\n" not in line
        assert len(line) < 120
        assert line in unescape(html)
        if isinstance(shown, Report):
            assert re.findall(r"<tr><td>(\w+)</td><td>[^<]{1,120}</td></tr>", html) == [
                field for field, value in vars(shown).items() if value is not None
            ]
        elif name != "Camera":
            assert embedded(html).std() > 5, name  # the ball, not an empty picture


def test_all_results_with_a_scene_are_among_those_shown(results: dict[str, Any]) -> None:
    holding = set()
    for name in g2ard.__all__:
        public = getattr(g2ard, name)
        if isinstance(public, FunctionType):
            (returned,) = re.findall(r"^\w+", str(inspect.signature(public).return_annotation))
            cls = getattr(sys.modules[public.__module__], returned, None)
            if hasattr(cls, "splats") or "splats" in getattr(cls, "__dataclass_fields__", ()):
                holding.add(returned)
    assert len(holding) > 4
    assert holding <= set(results)


def test_every_report_is_a_line() -> None:
    for path in (ROOT / "g2ard").rglob("*.py"):
        if "(Report):" in path.read_text(encoding="utf-8"):
            import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))
    reports = [cls for cls in descendants(Report) if cls.__module__.startswith("g2ard.")]
    own = {cls.__name__ for cls in reports if cls.__repr__ is not Report.__repr__}
    assert own == {"Evaluation", "RecoverReport"}
    for cls in reports:
        full = cls.__new__(cls)
        for field in fields(cls):
            object.__setattr__(full, field.name, ["word"] * 500)
        if cls.__name__ not in own:
            assert re.fullmatch(
                cls.__name__ + r"\(\w+=500 items(, \w+=500 items)*(, …)?\)", repr(full)
            )
            assert len(repr(full)) < 120


def descendants(cls: type) -> list[type]:
    return [found for child in cls.__subclasses__() for found in (child, *descendants(child))]


def test_a_camera_shows_its_photo_or_its_frame(tmp_path: Path) -> None:
    view = VIEWS[0]
    assert f'viewBox="0 0 {view.width} {view.height}"' in view._repr_html_()
    photo = np.zeros((view.height, view.width, 3), np.uint8)
    photo[:, : view.width // 2] = (255, 0, 0)
    Image.fromarray(photo).save(tmp_path / "half.png")
    shown = embedded(replace(view, image_path=tmp_path / "half.png")._repr_html_())
    assert shown[0, 0].tolist() == [255, 0, 0]
    assert shown[0, -1].tolist() == [0, 0, 0]
    gone = replace(view, image_path=tmp_path / "gone.png")
    assert "gone.png" in gone._repr_html_()
    assert "<img" not in gone._repr_html_()


def test_a_scene_without_anything_to_see_is_a_line() -> None:
    clear = replace(BALL, logit_opacities=np.full(len(BALL), -20, np.float32))
    empty = g2ard.Cleaned(BALL, Cleaning(np.zeros(len(BALL), np.int8)), None, VIEWS)
    for shown in (clear, empty):
        assert "<img" not in shown._repr_html_()
        assert repr(shown) in shown._repr_html_()


def test_rendered_images_show_as_they_are_written(tmp_path: Path) -> None:
    g2ard.save(tmp_path / "ball.ply", BALL)
    rendered = g2ard.render(BALL, VIEWS[0], background=(1, 1, 1))
    bright = replace(rendered, image=rendered.image * 2)
    assert bright.image_8bit().dtype == np.uint8
    assert bright.image_8bit()[0, 0].tolist() == [255] * 3
    shown = np.asarray(Image.open(BytesIO(rendered._repr_png_())))
    np.testing.assert_array_equal(shown, rendered.image_8bit())


def test_paths_and_results_are_taken_for_scenes(tmp_path: Path, results: dict[str, Any]) -> None:
    small = results["Simplified"]
    g2ard.save(tmp_path / "small.ply", small)
    assert len(g2ard.load(tmp_path / "small.ply")) == len(small.splats)
    expected = g2ard.render(small.splats, VIEWS[0]).image
    np.testing.assert_array_equal(g2ard.render(small, VIEWS[0]).image, expected)
    from_file = g2ard.render(tmp_path / "small.ply", VIEWS[0]).image
    np.testing.assert_allclose(from_file, expected, atol=1e-4)
    for wrong in (3, VIEWS, None):
        with pytest.raises(
            g2ard.InputError, match="splats: expected Splats or a result with splats"
        ):
            g2ard.save(tmp_path / "wrong.ply", wrong)  # type: ignore[arg-type]


def test_view_returns_its_page(tmp_path: Path, results: dict[str, Any]) -> None:
    page = g2ard.view(BALL)
    assert page.name == "view.html"
    assert "scene: 600 Gaussians" in page.read_text(encoding="utf-8")
    two = g2ard.view(BALL, results["Distilled"], output=tmp_path / "two.html")
    assert two == tmp_path / "two.html"
    text = two.read_text(encoding="utf-8")
    assert "scene: 600 Gaussians" in text
    assert "result: 60 Gaussians" in text
    with pytest.raises(g2ard.OutputError, match="exists"):
        g2ard.view(BALL, output=two)


class Shell(SimpleNamespace):
    """IPython's shell and displays, as far as g2ard uses them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        super().__init__(kernel=object(), execution_count=1, cells=[])
        frames = SimpleNamespace(
            IFrame=lambda src, width, height, extras: SimpleNamespace(extras=extras),
            HTML=lambda data: SimpleNamespace(data=data),
            display=self.display,
        )
        monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: self))
        monkeypatch.setitem(sys.modules, "IPython.display", frames)

    def display(self, content: dict[str, str], *, raw: bool, display_id: bool) -> Any:
        assert raw
        assert display_id
        self.cells.append([content["text/plain"]])
        return SimpleNamespace(
            update=lambda content, raw: self.cells[-1].append(content["text/plain"])
        )


def test_view_shows_the_whole_page_in_a_notebook(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """IPython's `IFrame(src, width, height, extras)` writes the extras as attributes of its frame."""
    shell = Shell(monkeypatch)
    (attribute,) = g2ard.view(BALL).extras
    name, _, content = attribute.partition("=")
    assert name == "srcdoc"
    assert content[0] == content[-1] == '"'
    assert '"' not in content[1:-1]
    assert unescape(content[1:-1]).startswith("<!doctype html>")
    said = capsys.readouterr().out
    assert re.fullmatch(r"view.html: \d+\.\d MB are embedded in this notebook\n", said)
    monkeypatch.setattr("g2ard.jobs.notebook._LARGEST", 1000)
    html = g2ard.view(BALL).data
    assert "MB are too many to embed" in html
    assert embedded(html).std() > 5
    shell.kernel = None  # IPython in a terminal
    assert isinstance(g2ard.view(BALL), Path)


def test_progress_is_one_line_per_cell(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shell = Shell(monkeypatch)
    monkeypatch.setattr(
        "g2ard.progress.time", SimpleNamespace(monotonic=iter(range(1000, 2000, 2)).__next__)
    )
    for cell in (1, 2):
        shell.execution_count = cell
        for stage in ("read", "recover"):
            for done in range(5):
                g2ard.show_progress(stage, done, 4)
    assert capsys.readouterr() == ("", "")
    first, second = shell.cells
    assert len(first) == len(second) == 10
    assert first[7].startswith("recover: 2/4 ██████████░░░░░░░░░░ ")
    assert first[7].endswith("4 s left")
    assert "█" * 20 in first[-1]


def test_progress_ends_with_the_last_stage(monkeypatch: pytest.MonkeyPatch) -> None:
    shell = Shell(monkeypatch)
    g2ard.simplify(BALL, count=100, progress=g2ard.show_progress)
    assert "█" * 20 in shell.cells[-1][-1]


def test_errors_of_users_are_one_line_in_a_notebook() -> None:
    calls: list[Any] = [
        lambda: g2ard.load("missing.ply"),
        lambda: g2ard.simplify(BALL, ratoi=4),
        lambda: g2ard.simplify(),
        lambda: g2ard.distill(BALL, budget=50),
        lambda: g2ard.save("a.xyz", BALL),
    ]
    for call in calls:
        with pytest.raises(g2ard.G2ardError) as caught:
            call()
        (line,) = caught.value._render_traceback_()
        assert "\n" not in line
        assert line == f"{type(caught.value).__name__}: {caught.value}"


def test_words_that_people_try(results: dict[str, Any]) -> None:
    with pytest.raises(g2ard.InputError, match="unknown keyword 'budget'"):
        g2ard.distill(BALL, budget=50)
    assert len(g2ard.simplify(BALL, count="0.1k", blind=True).splats) == 100
    for wrong in ("50 percent", "1.5", "k"):
        with pytest.raises(
            g2ard.InputError, match="count: expected a whole number, or text such as 50k"
        ):
            g2ard.simplify(BALL, count=wrong, blind=True)
    done = results["Distilled"]
    assert (
        g2ard.evaluate(done, done.held_out).psnr == g2ard.evaluate(done.splats, done.held_out).psnr
    )


def test_cameras_show_a_few_frames() -> None:
    assert 1 < VIEWS._repr_html_().count("<svg") <= 4


def test_names_are_visible_without_running() -> None:
    """Editors read the imports for type checkers; jedi does unless their condition is literally false."""
    tree = ast.parse((ROOT / "g2ard" / "__init__.py").read_text(encoding="utf-8"))
    assert not [
        n for n in tree.body if isinstance(n, ast.Assign) and ast.unparse(n.value) == "False"
    ]
    block = next(node for node in tree.body if isinstance(node, ast.If))
    imports = [
        alias.asname or alias.name for node in block.body for alias in getattr(node, "names", [])
    ]
    assert set(imports) >= set(g2ard.__all__)


def test_jedi_completes_public_names() -> None:
    jedi = pytest.importorskip("jedi")
    project = jedi.Project(ROOT, sys_path=[str(ROOT)])
    script = jedi.Script("import g2ard\ng2ard.\n", project=project)
    names = {completion.name for completion in script.complete(2, 6)}
    assert names >= set(g2ard.__all__)


LENSES = {
    "pinhole": {},
    "distorted": {"distortions": np.full((3, 5), 0.01)},
    "fisheye": {"lenses": (PhotoLens("SIMPLE_FISHEYE", (64, 48), (30.0, 32.0, 24.0)),) * 3},
    "panorama": {"lenses": (PhotoLens("EQUIRECTANGULAR", (64, 48), ()),) * 3},
}


@pytest.mark.parametrize("moved", ["photo", "mask"])
@pytest.mark.parametrize("lens", LENSES)
def test_a_photo_or_mask_that_moved_is_named(lens: str, moved: str, tmp_path: Path) -> None:
    """Every reader reports it, through every lens."""
    photo, mask = (
        photo_file(tmp_path / "photo.png", (64, 48)),
        photo_file(tmp_path / "mask.png", (64, 48)),
    )
    views = replace(VIEWS, image_paths=(photo,) * 3, mask_paths=(mask,) * 3, **LENSES[lens])
    shown = g2ard.Photos(views)
    (tmp_path / f"{moved}.png").unlink()
    reading: dict[str, Callable[[], Any]] = {
        "image": lambda: shown[0],
        "mask": lambda: shown.mask(1),
        "alpha": lambda: shown.alpha(2),
        "load": lambda: load_photo(views, 0),
        "key": lambda: fingerprint_of(shown),
    }
    for name, read in reading.items():
        said = ""
        try:
            read()
        except InputError as error:
            said = str(error)
        if said or name not in ("mask", "alpha"):  # which need not both
            assert f"{moved}.png" in said
    assert f"{moved}.png" in shown._repr_html_()
    assert f"{moved}.png" in views[0]._repr_html_()
