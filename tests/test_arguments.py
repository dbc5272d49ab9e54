"""Arguments of public functions and configs: wrong ones are named; images are taken as people have them."""

import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, get_origin

import numpy as np
import pytest
import torch
from PIL import Image

import g2ard
from g2ard.config import checks
from helpers.scenes import around, checkered_ball

BALL, VIEWS = checkered_ball(300), around(8, (48, 36))
SMALL = g2ard.simplify(BALL, count=30, blind=True).splats
TARGETS = g2ard.TeacherRenders(BALL, VIEWS)
IMAGES = np.stack([TARGETS[view] for view in range(len(VIEWS))])


class Own:
    """Targets of a class that is not g2ard's."""

    def __init__(self, images: Any) -> None:
        self.cameras, self.images = VIEWS, images

    def __getitem__(self, view: int) -> Any:
        return self.images[view]


COLOUR = "expected 3 numbers from 0 to 1"
WRONG: list[tuple[str, dict[str, Any], str, str]] = [
    ("distill", {"format": "foo"}, "format", "expected one of ply, sog"),
    ("distill", {"preset": "nope"}, "preset", "nope"),
    (
        "recover",
        {"targets": None, "views": VIEWS, "teacher": BALL, "preset": "nope"},
        "preset",
        "nope",
    ),
    ("distill", {"background": (300, 0, 0)}, "background", COLOUR),
    (
        "distill",
        {"settings": {"simplify.neighbors": 2.5}},
        "simplify.neighbors",
        "a whole number of at least 1, got 2.5",
    ),
    ("distill", {"steps": 3, "recovery_time": 1}, "steps", "exclude each other"),
    ("distill", {"sh_degree": 4}, "sh_degree", "in [0, 3] or none, got 4"),
    ("simplify", {"settings": {"neighbors": 2.5}}, "neighbors", "of at least 1, got 2.5"),
    ("recover", {"steps": 3, "recovery_time": 1}, "steps", "exclude each other"),
    ("recover", {"targets": IMAGES}, "targets", "expected cameras with an image each"),
    ("recover", {"validation": IMAGES}, "validation", "expected cameras with an image each"),
    ("recover", {"targets": Own(255 * IMAGES)}, "targets", "divide by 255, or pass uint8"),
    ("recover", {"targets": Own(IMAGES * np.nan)}, "targets", "from 0 to 1, got nan to nan"),
    ("recover", {"targets": Own(IMAGES[:3])}, "targets", "view 3 (view_003) has no image"),
    (
        "recover",
        {"targets": Own(IMAGES.transpose(0, 3, 1, 2))},
        "targets",
        "move the channels to the end",
    ),
    (
        "recover",
        {"targets": Own(IMAGES.astype(int))},
        "targets",
        "expected uint8, or floats from 0 to 1",
    ),
    ("adapt", {"targets": Own(255 * IMAGES)}, "targets", "divide by 255, or pass uint8"),
    ("evaluate", {"targets": VIEWS}, "targets", "pass g2ard.Photos(cameras, images)"),
    ("render", {"camera": VIEWS}, "camera", "expected Camera, got Cameras(8 views)"),
    ("AdaptConfig", {"background": (0, 0, 255)}, "background", COLOUR),
    ("Photos", {"images": IMAGES[:3]}, "images", "expected one image per view, got 3 for 8 views"),
    ("Photos", {"images": 255 * IMAGES}, "images", "divide by 255, or pass uint8"),
    ("Photos", {"images": IMAGES[:, :30]}, "images", "expected shape (36, 48, 3), got (30, 48, 3)"),
]
CONFIGS = [name for name in g2ard.__all__ if name.endswith(("Config", "Options", "Settings"))]
VALID: dict[str, dict[str, Any]] = {
    "adapt": {"compact": SMALL, "targets": TARGETS},
    "clean": {"scene": BALL, "only": ()},
    "convert": {"scenes": BALL},
    "distill": {"scene": BALL, "ratio": 4, "views": VIEWS, "steps": 1},
    "distill_against": {"prior": BALL, "budget": 9, "targets": TARGETS},
    "evaluate": {"splats": SMALL, "targets": TARGETS},
    "ingest": {"source": "ball.ply", "folder": "tiles"},
    "lift": {"points": BALL.means, "colors": np.full((300, 3), 0.5)},
    "load": {"path": "ball.ply"},
    "load_points": {"path": "ball.ply"},
    "load_views": {"path": "views.json"},
    "lod": {"scene": BALL, "ratios": (4,)},
    "look_at": {"position": (0, -3, 0), "target": (0, 0, 0)},
    "make_pool": {"splats": BALL, "count": 2},
    "preset": {},
    "orbit": {"scene": BALL, "count": 2},
    "recover": {"student": SMALL, "targets": TARGETS},
    "register": {"scene": BALL, "photos": VIEWS},
    "render": {"splats": BALL, "camera": VIEWS[0]},
    "save": {"path": "out.ply", "splats": BALL},
    "save_levels": {"path": "levels", "levels": [BALL, SMALL]},
    "save_tileset": {"path": "tileset", "levels": [BALL, SMALL]},
    "save_views": {"path": "out.json", "cameras": VIEWS},
    "select": {"splats": BALL, "cameras": VIEWS, "k": 2},
    "show_progress": {"stage": "read", "done": 1, "total": 2},
    "simplify": {"scene": BALL, "ratio": 4},
    "up_of": {"scene": BALL},
    "view": {"scene": BALL},
    "Camera": {"viewmat": np.eye(4), "K": np.eye(3), "width": 8, "height": 6},
    "Georeference": {"longitude": 25, "latitude": 59, "height": 30},
    "Photos": {"cameras": VIEWS, "images": IMAGES},
    "Regularizers": {"anchor": 1.0, "shape": 1.0, "effective_rank": True},
    "Renderer": {"splats": BALL},
    "TeacherRenders": {"teacher": BALL, "cameras": VIEWS},
    **{name: {} for name in CONFIGS},
}
BUDGETS = ("count", "fit", "min_psnr", "min_ssim")
SIGNED = {("Georeference", name) for name in ("longitude", "latitude", "height", "heading")} | {
    ("Camera", name) for name in ("width", "height")
}
"""Numbers that may be negative; `Cameras` checks sizes."""
VECTORS = ("up", "position", "target", "background")
NAN = float("nan")


def _bare(kind: str) -> str:
    """Return the name of a type without its limits."""
    kind = re.sub(r"Annotated\[(\w+).*", r"\1", kind)
    limited = getattr(checks, kind, None)
    return limited.__origin__.__name__ if get_origin(limited) is Annotated else kind


def _wrong(name: str, parameter: str, annotation: str) -> Iterator[Any]:
    """Yield values that an argument of this type must not have."""
    kinds = [_bare(kind.strip()) for kind in annotation.split("|")]
    yield object()
    if {"int", "float"} & {*kinds}:
        yield from (NAN, True)
        yield from [] if "str" in kinds else ["3"]
        yield from [] if "float" in kinds else [2.5]
        yield from [] if (name, parameter) in SIGNED else [-1]
    elif annotation.startswith(("Splats", "Cameras", "Targets", "Camera")):
        yield from ([BALL, BALL], [1, 2], 3.5)
    elif annotation.startswith((*checks._ARRAY_NAMES, "Sequence[float]", "Colour")):
        yield from ("x", -1)
        yield from [(NAN, 0, 0), (1, 2)] if parameter in VECTORS else []
    elif not annotation.startswith("str"):
        yield -1.5


def _cases() -> Iterator[tuple[str, str]]:
    for name in VALID:
        for parameter in inspect.signature(getattr(g2ard, name)).parameters.values():
            called = parameter.name in ("progress", "say", "watch", "time_left", "runs")
            if not called and parameter.kind != parameter.VAR_KEYWORD:
                yield name, parameter.name


@pytest.mark.parametrize(("name", "wrong", "parameter", "words"), WRONG)
def test_invalid_arguments_are_named(
    name: str, wrong: dict[str, Any], parameter: str, words: str
) -> None:
    with pytest.raises(g2ard.G2ardError) as caught:
        getattr(g2ard, name)(**{**VALID.get(name, {}), **wrong})
    assert str(caught.value.parameter).rpartition(".")[2] == parameter.rpartition(".")[2]
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("white", [[1, 1, 1], np.ones(3), np.ones(3, np.float32)])
def test_a_colour_is_any_three_numbers(white: Any) -> None:
    targets = [
        g2ard.TeacherRenders(BALL, VIEWS, background=colour) for colour in (white, (1, 1, 1))
    ]
    np.testing.assert_array_equal(targets[0][0], targets[1][0])
    ours, theirs = (
        g2ard.recover(
            SMALL, targets[1], steps=2, background=colour, seed=np.int64(1)
        ).splats.fingerprint()
        for colour in (white, (1.0, 1.0, 1.0))
    )
    assert ours == theirs


def test_recover_takes_settings_by_name() -> None:
    config = g2ard.RecoverConfig(steps=3, background=(1, 1, 1))
    whole = g2ard.recover(SMALL, TARGETS, config)
    assert g2ard.recover(SMALL, TARGETS, steps=3, background=(1, 1, 1)).splats.fingerprint() == (
        whole.splats.fingerprint()
    )
    rates = g2ard.RecoverConfig(schedule=g2ard.preset("paper").recover.schedule)
    # keeps the schedule
    assert g2ard.recover(SMALL, TARGETS, rates, steps=3).report.multiplier == 1
    decided: dict[str, Any] = {"views": VIEWS, "teacher": BALL}
    by_name = g2ard.recover(SMALL, **decided, steps=3, schedule="fast")
    by_path = g2ard.recover(SMALL, **decided, settings={"recover.steps": 3, "schedule": "fast"})
    assert by_name.splats.fingerprint() == by_path.splats.fingerprint()


def test_every_public_function_answers_an_unknown_keyword_by_the_nearest() -> None:
    asked = 0
    for name in g2ard.__all__:
        function = getattr(g2ard, name)
        if not inspect.isfunction(function):
            continue
        for keyword, parameter in inspect.signature(function).parameters.items():
            if parameter.kind is parameter.VAR_KEYWORD or len(keyword) < 4:
                continue
            first = {"scene": SMALL, "ratio": 2.0} if name == "distill" else {}
            if name == "recover":
                first = {"student": SMALL, "targets": TARGETS}
            if name in ("save", "save_views", "convert", "save_levels", "save_tileset"):
                continue  # options of formats are answered by their formats
            wrong = f"{keyword[:-1]}x{keyword[-1]}"
            with pytest.raises(
                (TypeError, g2ard.InputError), match=rf"'{wrong}'; did you mean {keyword}\?"
            ):
                function(**first, **{wrong: 1})
            asked += 1
    assert asked > 100


def test_editors_complete_what_people_set() -> None:
    for function in (g2ard.distill, g2ard.recover):
        assert {"steps", "background", "schedule", "seed"} <= {
            *inspect.signature(function).parameters
        }


BYTES = np.rint(IMAGES * 255).astype(np.uint8)


@pytest.mark.parametrize(
    "images",
    [
        IMAGES,
        IMAGES.astype(np.float64),
        list(IMAGES),
        torch.tensor(IMAGES),
        list(torch.tensor(IMAGES.astype(np.float64))),
        np.minimum(IMAGES + 1e-4, 1.0005),
        BYTES,
        list(BYTES),
        torch.tensor(BYTES),
        np.concatenate([BYTES, np.full((*BYTES.shape[:3], 1), 255, np.uint8)], axis=3),
    ],
)
def test_images_as_people_have_them(images: Any) -> None:
    given = [g2ard.Photos(VIEWS, images)]
    if images[0].shape[2] == 3:
        given.append(Own(images))  # type: ignore[arg-type]
    for targets in given:
        done = g2ard.recover(SMALL, targets, steps=2)
        assert done.report.psnr.before == pytest.approx(
            g2ard.recover(SMALL, TARGETS, steps=2).report.psnr.before, abs=0.02
        )
        assert g2ard.evaluate(SMALL, targets).psnr == pytest.approx(
            g2ard.evaluate(SMALL, TARGETS).psnr, abs=0.02
        )


def test_files_and_alpha_as_images(tmp_path: Path) -> None:
    paths = [tmp_path / f"{i}.png" for i in range(len(VIEWS))]
    for path, image in zip(paths, BYTES, strict=True):
        Image.fromarray(image).save(path)
    for given in (paths, [str(path) for path in paths]):
        photos = g2ard.Photos(VIEWS, given)
        assert np.abs(photos[3] - IMAGES[3]).max() < 0.003
        assert (
            photos.source == g2ard.Photos(VIEWS, paths).source != g2ard.Photos(VIEWS, BYTES).source
        )
    clear = np.concatenate([BYTES, np.zeros((*BYTES.shape[:3], 1), np.uint8)], axis=3)
    assert g2ard.Photos(VIEWS, clear, background=(1, 0.5, 0))[0][0, 0].tolist() == [1, 0.5, 0]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("files")
    g2ard.save(folder / "ball.ply", BALL)
    g2ard.save_views(folder / "views.json", VIEWS)
    return folder


@pytest.mark.parametrize(("name", "parameter"), list(_cases()))
def test_wrong_values_are_refused(
    name: str, parameter: str, files: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(files)
    function = getattr(g2ard, name)
    annotation = str(inspect.signature(function).parameters[parameter].annotation)
    others = {
        **VALID[name],
        **({"ratio": None} if parameter in BUDGETS and "ratio" in VALID[name] else {}),
    }
    for value in _wrong(name, parameter, annotation):
        with pytest.raises(g2ard.G2ardError) as caught:
            function(**{**others, parameter: value})
        assert str(caught.value.parameter).rpartition(".")[2] == parameter, (value, caught.value)
        assert "\n" not in str(caught.value)


def test_every_public_function_has_a_row() -> None:
    functions = {name for name in g2ard.__all__ if inspect.isfunction(getattr(g2ard, name))}
    assert functions - {"rasterize"} <= {*VALID}  # rasterize takes tensors, inside a loop
