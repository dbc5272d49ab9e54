"""Keys of steps, checkpoints and tasks change with everything that a result depends on."""

import copy
import importlib
import inspect
import math
import os
import pkgutil
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

import g2ard
from g2ard.pipeline import distill, steps
from g2ard.pipeline.config import DistillConfig
from g2ard.pipeline.dense import InMemory
from g2ard.progress import silent
from g2ard.rendering import targets
from g2ard.rendering.renderer import RasterSettings
from g2ard.rendering.targets import Photos, PhotosOrRenders, Subset, TeacherRenders, fingerprint_of
from g2ard.scene.cameras import Cameras
from g2ard.scene.lenses import PhotoLens
from g2ard.scene.prepared import PreparedScene
from g2ard.scene.splats import Splats
from g2ard.stages.recover.anchors import Anchors
from g2ard.stages.recover.config import RecoverConfig
from g2ard.stages.recover.loop import Loop
from g2ard.system.cached import cached_property
from g2ard.system.keys import UNKEYED, key_of
from g2ard.tiles.dense import TileRenders
from g2ard.tiles.tasks import Task
from helpers.scenes import around, checkered_ball
from helpers.view_files import photo

BALL = checkered_ball(40)
LENS = PhotoLens("SIMPLE_FISHEYE", (32, 24), (30.0, 16.0, 12.0))
VIEWS = replace(around(2, (32, 24)), lenses=(LENS, None))
IMAGES = list(np.random.default_rng(0).random((2, 24, 32, 3), np.float32))
CONFIG = RecoverConfig(steps=3)
EXPOSURES = {VIEWS.names[0]: np.eye(3, 4)}


@dataclass(frozen=True)
class Tiles:
    """Stands for a scene in tiles, which is drawn nowhere here."""

    name: str

    def identity(self) -> list[str]:
        return [self.name]


KEYED: dict[type, tuple[Any, str]] = {
    Splats: (BALL, "up axes"),
    Cameras: (VIEWS, "image_paths mask_paths source"),
    Task: (
        Task("a:b", "label", Path("work"), {"tile": 1, "levels": ["near"], "own": Path("a.npz")}),
        "label folder places cost",
    ),
    Loop: (
        Loop(
            BALL,
            TeacherRenders(BALL, VIEWS),
            CONFIG,
            np.ones(2),
            Anchors.of(BALL),
            None,  # type: ignore[arg-type]
            None,  # type: ignore[arg-type]
            "validation",
            np.zeros(40, bool),
        ),
        "probe guard time_left limit multiplier reach trials done seconds resumed losses geometry "
        "skipped_before tally exposures _epoch",
    ),
    Photos: (
        Photos(VIEWS, IMAGES, exposures=EXPOSURES),
        "cameras _limit _kept _bytes _spill",
    ),
    TeacherRenders: (
        TeacherRenders(BALL, VIEWS, settings=RasterSettings(), lazy=True),
        "cameras _limit _kept _bytes _spill _renderer",
    ),
    TileRenders: (
        TileRenders(Tiles("a"), VIEWS),  # type: ignore[arg-type]
        "cameras _limit _kept _bytes _spill _files",
    ),
    Subset: (Subset(Photos(VIEWS, IMAGES), [1, 0]), "cameras _places"),
}
"""An object of each class that has a key, and its attributes that do not count: what only messages and
progress show, what other keys hold, and what a computation changes on its way."""

PARTS = {
    targets._Chosen,
    targets._Converted,
    targets.Exposed,
    PhotosOrRenders,
    PreparedScene,
}
"""Classes between those, or whose images are hashed."""


def key(value: Any) -> str:
    if hasattr(value, "fingerprint"):
        return str(value.fingerprint())
    return str(value.source if hasattr(value, "source") else value.key)


def others(value: Any) -> Iterator[Any]:
    """Yield values like this one, each with another difference."""
    if isinstance(value, np.ndarray):
        if value.size:
            changed = value.copy()
            changed.flat[-1] = ~changed.flat[-1] if value.dtype == bool else changed.flat[-1] + 1
            yield changed
            yield np.concatenate([value, value])
        else:
            yield np.zeros((*value.shape[:1], 3, *value.shape[2:]), value.dtype)
    elif is_dataclass(value):
        for f in fields(value):
            for other in others(getattr(value, f.name)) if f.metadata != UNKEYED else ():
                yield with_attribute(value, f.name, other)
    elif isinstance(value, TeacherRenders):
        yield TeacherRenders(BALL, VIEWS, background=(0.0, 0.0, 0.5))
        yield TeacherRenders(BALL, VIEWS.take([1, 0]))
    elif isinstance(value, dict):
        yield value | {"another": 1}
        for name, item in value.items():
            yield from (value | {name: other} for other in others(item))
    elif isinstance(value, list | tuple):
        yield type(value)([*value, 1])
        for i, item in enumerate(value):
            yield from (type(value)([*value[:i], other, *value[i + 1 :]]) for other in others(item))
    elif isinstance(value, Path):
        yield value.with_name("other.npz")
    elif isinstance(value, Photos):
        yield Photos(VIEWS, IMAGES[::-1])
    elif isinstance(value, bool):
        yield not value
    elif isinstance(value, int | float):
        yield value + 1 if math.isfinite(value) else 1.0
    elif isinstance(value, str):
        yield value + "x"
    else:
        assert value is None, type(value)
        yield 1


def with_attribute(value: Any, name: str, other: Any) -> Any:
    changed = copy.copy(value)
    for cached in ("_digest", "key", "source"):
        if cached not in getattr(type(value), "__dataclass_fields__", ()):
            vars(changed).pop(cached, None)
    object.__setattr__(changed, name, other)  # without checks
    return changed


@pytest.mark.parametrize("kind", KEYED, ids=lambda kind: kind.__name__)
def test_every_attribute_changes_the_key(kind: type) -> None:
    value, exceptions = KEYED[kind]
    before, seen = key(value), set()
    assert key(copy.copy(value)) == before
    names = [f.name for f in fields(value)] if is_dataclass(value) else {*vars(value)} - {"source"}
    for name in names:
        for other in others(getattr(value, name)) if name not in exceptions.split() else ():
            found = key(with_attribute(value, name, other))
            assert found not in (before, *seen), (name, other)
            seen.add(found)
    assert set(exceptions.split()) <= set(names)
    given = () if is_dataclass(value) else ("cameras", "_places")  # what other keys hold
    for name in exceptions.split():
        if name not in given:
            assert key(with_attribute(value, name, "other")) == before, name


def test_no_class_with_a_key_is_forgotten() -> None:
    found = set()
    for module in pkgutil.walk_packages(g2ard.__path__, "g2ard."):
        if not module.name.endswith("__main__"):
            for _, kind in inspect.getmembers(
                importlib.import_module(module.name), inspect.isclass
            ):
                own = kind.__module__.startswith("g2ard.") and not inspect.isabstract(kind)
                if own and any(computed(kind, name) for name in ("fingerprint", "key", "source")):
                    found.add(kind)
    assert {kind for kind in found if "report" not in kind.__module__} == KEYED.keys() | PARTS


def computed(kind: type, name: str) -> bool:
    found = inspect.getattr_static(kind, name, None)
    return isinstance(found, property | cached_property) or inspect.isfunction(found)


def test_settings_are_keyed_in_whole() -> None:
    configs = [CONFIG, DistillConfig(), LENS, RasterSettings()]
    keys = [key_of(value) for config in configs for value in (config, *others(config))]
    assert len(set(keys)) == len(keys) > 50


def test_a_photo_moved_to_another_view_changes_the_key(tmp_path: Path) -> None:
    views, path = around(3, (32, 24)), photo(tmp_path / "a.png", (32, 24))
    made = [
        PhotosOrRenders(replace(views, image_paths=paths, mask_paths=masks), BALL)
        for paths in ((path, None, None), (None, path, None), (None, None, path))
        for masks in ((None, None, None), paths)
    ]
    assert len({fingerprint_of(each) for each in made}) == 6


@pytest.mark.parametrize("size", [1_000, 300_000])
def test_a_file_edited_in_its_middle_changes_the_key(size: int, tmp_path: Path) -> None:
    path = tmp_path / "photo.bmp"
    path.write_bytes(bytes(size))
    views = replace(around(1, (32, 24)), image_paths=(path,))
    before, state = fingerprint_of(Photos(views)), path.stat()
    path.write_bytes(bytes(size // 2) + b"1" + bytes(size - size // 2 - 1))
    os.utime(path, ns=(state.st_atime_ns, state.st_mtime_ns))
    assert fingerprint_of(Photos(views)) != before


def recorded(call: Any) -> str:
    """Return the key with which a call runs its first step."""
    found: list[str] = []

    def run(self: Any, name: str, scene: Splats, settings: Any, *_: Any) -> Any:
        found.append(key_of([name, scene, settings()]))
        raise KeyboardInterrupt

    with patch.object(steps.Steps, "run", run), pytest.raises(KeyboardInterrupt):
        call(steps.Steps(None))
    return found[0]


def test_every_input_of_a_step_changes_its_key() -> None:
    given = {
        "name": "final",
        "student": BALL,
        "targets": Photos(VIEWS, IMAGES),
        "config": CONFIG,
        "built": BALL,
        "weights": np.ones(2),
        "validation": TeacherRenders(BALL, VIEWS),
    }
    named = inspect.signature(steps.Steps.recover).parameters
    assert set(named) == {"self", *given, "filled", "options"}
    keys = [recorded(lambda own: own.recover(**given))]
    for name, value in given.items():
        for other in (
            *others(value),
            *([None] if name in ("built", "weights", "validation") else []),
        ):
            changed = given | {name: other}
            keys.append(recorded(lambda own, changed=changed: own.recover(**changed)))
    assert len(set(keys)) == len(keys)


def test_every_input_of_a_simplification_changes_its_key() -> None:
    given = {
        "number": 1,
        "dense": InMemory(BALL),
        "count": 20,
        "budget": 10,
        "cameras": VIEWS,
        "protected": np.zeros(40, bool),
    }
    kept = {"config": DistillConfig(), "progress": silent, "drawn": ()}
    assert set(inspect.signature(distill._simplify_round).parameters) == {"steps", *given, *kept}
    keys = [recorded(lambda own: distill._simplify_round(own, **given, **kept))]
    for name, value in given.items():
        for other in others(value):
            changed = given | {name: other}
            keys.append(
                recorded(
                    lambda own, changed=changed: distill._simplify_round(own, **changed, **kept)
                )
            )
    assert len(set(keys)) == len(keys)
