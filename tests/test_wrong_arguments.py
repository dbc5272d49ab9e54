"""Public functions and configs refuse wrong types, fractions, NaN and negative numbers by argument."""

import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, get_origin

import numpy as np
import pytest

import g2ard
from g2ard.config import checks
from helpers.scenes import around, checkered_ball

BALL, VIEWS = checkered_ball(60), around(4, (24, 18))
TARGETS = g2ard.TeacherRenders(BALL, VIEWS)
LEVELS = [BALL, BALL.take(range(9))]
CONFIGS = [name for name in g2ard.__all__ if name.endswith(("Config", "Options", "Settings"))]
VALID: dict[str, dict[str, Any]] = {
    "adapt": {"compact": BALL, "targets": TARGETS},
    "clean": {"scene": BALL, "only": ()},
    "convert": {"scenes": BALL},
    "distill": {"scene": BALL, "ratio": 4, "views": VIEWS, "steps": 1},
    "distill_against": {"prior": BALL, "budget": 9, "targets": TARGETS},
    "evaluate": {"splats": BALL, "targets": TARGETS},
    "ingest": {"source": "ball.ply", "folder": "tiles"},
    "lift": {"points": BALL.means, "colors": np.full((60, 3), 0.5)},
    "load": {"path": "ball.ply"},
    "load_points": {"path": "ball.ply"},
    "load_views": {"path": "views.json"},
    "lod": {"scene": BALL, "ratios": (4,)},
    "look_at": {"position": (0, -3, 0), "target": (0, 0, 0)},
    "make_pool": {"splats": BALL, "count": 2},
    "preset": {},
    "orbit": {"scene": BALL, "count": 2},
    "recover": {"student": BALL, "targets": TARGETS},
    "register": {"scene": BALL, "photos": VIEWS},
    "render": {"splats": BALL, "camera": VIEWS[0]},
    "save": {"path": "out.ply", "splats": BALL},
    "save_levels": {"path": "levels", "levels": LEVELS},
    "save_tileset": {"path": "tileset", "levels": LEVELS},
    "save_views": {"path": "out.json", "cameras": VIEWS},
    "select": {"splats": BALL, "cameras": VIEWS, "k": 2},
    "show_progress": {"stage": "read", "done": 1, "total": 2},
    "simplify": {"scene": BALL, "ratio": 4},
    "up_of": {"scene": BALL},
    "Camera": {"viewmat": np.eye(4), "K": np.eye(3), "width": 8, "height": 6},
    "Georeference": {"longitude": 25, "latitude": 59, "height": 30},
    "Photos": {"cameras": VIEWS, "images": np.zeros((4, 18, 24, 3), np.float32)},
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
    elif annotation.startswith(("ArrayLike", "NDArray", "Sequence[float]", "Colour")):
        yield from ("x", -1)
        yield from [(NAN, 0, 0), (1, 2)] if parameter in VECTORS else []
    elif not annotation.startswith("str"):
        yield -1.5


def _cases() -> Iterator[tuple[str, str]]:
    for name in VALID:
        for parameter in inspect.signature(getattr(g2ard, name)).parameters.values():
            if parameter.name not in ("progress", "say", "watch") and parameter.kind != parameter.VAR_KEYWORD:
                yield name, parameter.name


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
    others = {**VALID[name], **({"ratio": None} if parameter in BUDGETS and "ratio" in VALID[name] else {})}
    for value in _wrong(name, parameter, annotation):
        with pytest.raises(g2ard.G2ardError) as caught:
            function(**{**others, parameter: value})
        assert str(caught.value.parameter).rpartition(".")[2] == parameter, (value, caught.value)
        assert "\n" not in str(caught.value)


def test_every_public_function_has_a_row() -> None:
    functions = {name for name in g2ard.__all__ if inspect.isfunction(getattr(g2ard, name))}
    assert functions - {"rasterize"} <= {*VALID}  # rasterize takes tensors, inside a loop
