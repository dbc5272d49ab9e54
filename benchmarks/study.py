"""Studies: scenes, methods and settings, read from TOML and changed by options."""

from __future__ import annotations

import math
import os
import re
import tomllib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, field, fields, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

from g2ard.errors import InputError, require_torch

if TYPE_CHECKING:
    from benchmarks.rows import Row

__all__ = [
    "DEFINITIONS",
    "Cell",
    "SceneSpec",
    "Study",
    "checked",
    "key",
    "read_study",
    "scene_label",
]

DEFINITIONS = Path(__file__).parent / "definitions"
KINDS = (
    "matched",
    "simplify",
    "recover",
    "select",
    "ship",
    "register",
    "raster",
    "boxes",
    "devices",
)
"""Modules of `benchmarks.kinds`; each holds the subclass of `Study` of the same name, capitalised."""

_VARIABLE = re.compile(r"\$\{?(\w+)")
_TYPES: dict[str, tuple[Any, str]] = {
    "int": (int, "a whole number"),
    "float": ((int, float), "a number"),
    "str": (str, "text"),
    "bool": (bool, "true or false"),
}


def key(
    default: Any = MISSING,
    *,
    least: float = -math.inf,
    choices: Sequence[Any] = (),
    axis: bool = False,
) -> Any:
    """Declare a key of a TOML table.

    Args:
        default: default value.
        least: smallest number allowed.
        choices: allowed values.
        axis: whether it only lists cells, so that a cell does not depend on its other values.
    """
    metadata = {"least": least, "choices": tuple(choices), "axis": axis}
    if isinstance(default, dict):
        return field(default_factory=dict, metadata=metadata)
    return field(default=default, metadata=metadata)


@dataclass(frozen=True)
class SceneSpec:
    """A scene and its views.

    Args:
        name: its name in the rows.
        prior: a trained scene or a coloured cloud, relative to the definition or to the generated city.
        train: views to train on: their train split, or all if there is a `score` and they state no split.
            None means the training part of a generated pool.
        score: name → views to score on, except those stated as train. Empty means the test part of `train`
            or of the pool.
        adapt: views of new appearance, for studies that adapt. Every third is scored if they state no split,
            unless the study adapts on all.
        adapt_last: number of training views, the last by name, that serve as `adapt` instead.
        targets: "teacher" (the prior's renders), "photos", or "either": the photo where a view has one,
            otherwise the prior's render.
        background: RGB behind the scene.
        indoor: whether Mini-Splatting uses its importance for rooms.
        train_prior: steps that turn a lift into a "trained" prior of the same count.
        regularizers: kind of a prior given as a scene, which decides its row of the paper's `tab:s_recovery`;
            auto measures it.
        starts: poses that photos are registered from, by name (start "given"): views, or ACE's text.
        points: points of a cloud to keep, evenly spaced in its file; 0 keeps all.
        optional: names in `score` that are dropped if their file does not exist.
        expects: the paper's counts: Gaussians of the `prior`, views to `train` and `adapt` on, and those of
            each name in `score` (`test` without one). A run says which differ.
        synth: options of `python -m benchmarks synth city`, which then generates the scene.
    """

    name: str = key()
    prior: str = key("cloud.ply")
    train: str | None = key(None)
    score: Mapping[str, str] = key({})
    adapt: str | None = key(None)
    adapt_last: int = key(0, least=0)
    targets: str = key("teacher", choices=("teacher", "photos", "either"))
    background: tuple[float, float, float] = key((0.0, 0.0, 0.0))
    indoor: bool = key(False)
    train_prior: int = key(0, least=0)
    regularizers: str = key("auto", choices=("auto", "trained", "lift", "noisy"))
    starts: str | None = key(None)
    points: int = key(0, least=0)
    optional: tuple[str, ...] = key(())
    expects: Mapping[str, int] = key({})
    synth: Mapping[str, Any] | None = key(None)

    def __post_init__(self) -> None:
        if self.adapt_last and (self.adapt is not None or self.train is None):
            raise InputError("adapt_last needs a scene with `train` and without `adapt`")


@dataclass(frozen=True)
class Cell:
    """A measurement.

    Args:
        names: columns that identify it among the cells of a study and scene.
        measure: function that returns its rows, without those columns.
        views: kinds of views with a row each; empty allows any rows.
        more: other values that the result depends on.
    """

    names: Mapping[str, Any]
    measure: Callable[[], Iterable[Row]]
    views: tuple[str, ...] = ()
    more: Any = None


@dataclass(frozen=True)
class Study(ABC):
    """Base class of studies, with the keys that all kinds have.

    Args:
        name: name of the file.
        title: title in reports.
        scenes: scenes to measure.
        methods: methods to compare, ours first.
        ratios: budget = round(N / ratio). `keep = [0.1]` in a file is `ratios = [10]`.
        seeds: random seeds.
        size: longer side of the views, pixels; None keeps them.
        pool_seed: seed of generated views.
        differs: differences from the paper's study, one per line, for the report.
        folder: base of relative paths.
    """

    METHODS: ClassVar[Mapping[str, Any]] = {}
    """Methods by name."""
    DEFAULT: ClassVar[Any] = None
    """Method that a table `[method.NAME]` without a `base` changes; None if a kind takes names only."""
    PROCESSES: ClassVar[bool] = False
    """Whether cells run in separate processes."""

    name: str
    title: str = key("", axis=True)
    scenes: tuple[SceneSpec, ...] = key((), axis=True)
    methods: tuple[Any, ...] = key((), axis=True)
    ratios: tuple[float, ...] = key((10.0,), least=1, axis=True)
    seeds: tuple[int, ...] = key((0,), least=0, axis=True)
    size: int | None = key(None, least=16)
    pool_seed: int = key(0, least=0)
    differs: tuple[str, ...] = key((), axis=True)
    folder: Path = field(default=Path(), metadata={"axis": True})

    @abstractmethod
    def cells(self, scene: SceneSpec, work: Path) -> Iterator[Cell]:
        """Yield the cells of a scene, without loading it."""

    def notes(self, scene: SceneSpec, work: Path) -> list[str]:
        """Return what a reader of a scene's rows should know, such as missing optional files."""
        return []

    def derived(self, rows: list[Row]) -> list[Row]:
        """Return the rows with columns that depend on several rows."""
        return rows

    def summary(self, rows: list[Row]) -> tuple[str, list[str], list[list[str]]] | None:
        """Return a summary table (title, columns, cells), or None."""
        return None

    @classmethod
    def default_methods(cls) -> list[str]:
        """Return the methods of a study that lists none."""
        return list(cls.METHODS)

    @property
    def settings(self) -> dict[str, Any]:
        """The keys, other than those in its name, that a cell depends on."""
        return {f.name: getattr(self, f.name) for f in fields(self) if not f.metadata.get("axis")}

    def check(self) -> None:
        """Check that environment variables in paths are set, and that the engine, if any, can run."""
        for scene in self.scenes:
            paths = (scene.prior, scene.train, scene.adapt, scene.starts, *scene.score.values())
            missing = next(filter(None, (_VARIABLE.search(path) for path in paths if path)), None)
            if missing is not None:
                raise InputError(f"{self.name}: scene {scene.name}: ${missing[1]} is not set")
        if getattr(self, "engine", "fused") == "torch":
            require_torch("engine 'torch'")

    def narrowed(self, options: Mapping[str, Any]) -> Self:
        """Return the study with changed keys; `scene.KEY` sets a key of all scenes."""
        own = {
            name: _spread(type(self), name, value)
            for name, value in options.items()
            if "." not in name
        }
        scene = {
            n[6:]: _spread(SceneSpec, n[6:], v)
            for n, v in options.items()
            if n.startswith("scene.")
        }
        unknown = next(
            (name for name in options if "." in name and not name.startswith("scene.")), None
        )
        if unknown is not None:
            raise InputError(f"no key {unknown!r}")
        methods = own.pop("methods", None)
        values = checked(type(self), own, {"name", "scenes", "folder"})
        if methods is not None:
            there = {str(getattr(m, "name", m)): m for m in self.methods}
            values["methods"] = _chosen({**self.METHODS, **there}, methods)
        if options and self.differs:
            given = ", ".join(f"{name} {_told(value)}" for name, value in options.items())
            line = f"run with {given} instead of what the study and the lines below say"
            values["differs"] = (line, *self.differs)
        scenes = tuple(replace(s, **checked(SceneSpec, scene, set())) for s in self.scenes)
        return replace(self, **{"scenes": scenes, **values})


def read_study(path: Path) -> Study:
    """Read a study from a TOML file.

    `kind` is one of `KINDS` (default "matched"), tables `[[scene]]` are `SceneSpec`s, and `methods` lists
    methods of the kind or tables `[method.NAME]`, whose keys override those of the method `base`, an earlier
    one. Other keys are fields of the kind's class.
    """
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError(f"{path}: {error}") from None
    try:
        kind = content.pop("kind", "matched")
        if kind not in KINDS:
            raise InputError(f"kind: expected one of {', '.join(KINDS)}, got {kind!r}")
        cls: type[Study] = getattr(import_module(f"benchmarks.kinds.{kind}"), kind.capitalize())
        tables = content.pop("method", {})
        known = dict(cls.METHODS)
        for name, values in tables.items():
            known[name] = _method(cls, name, values, known)
        methods = _chosen(known, content.pop("methods", list(tables) or cls.default_methods()))
        scenes = tuple(_scene(values) for values in content.pop("scene", []))
        twice = next(
            (s.name for i, s in enumerate(scenes) if s.name in {o.name for o in scenes[:i]}), None
        )
        if twice is not None:
            raise InputError(f"scene {twice}: the name is used twice")
        if "keep" in content:
            content["ratios"] = _ratios_of(content.pop("keep"), "ratios" in content)
        values = checked(
            cls, {"title": path.stem, **content}, {"name", "scenes", "methods", "folder"}
        )
        folder = path.parent.absolute()
        made = cls(name=path.stem, scenes=scenes, methods=methods, folder=folder, **values)
        lacks = next(
            (name for name in ("methods", "ratios", "seeds") if not getattr(made, name)), None
        )
        if lacks is not None:
            raise InputError(f"no {lacks}: there is nothing to measure")
        return made
    except (InputError, TypeError) as error:
        raise InputError(f"{path}: {error}") from None


def scene_label(path: Path) -> str:
    """Return a short name: a folder with its parent, or a file without its extension.

    >>> scene_label(Path("data/guitar.compressed.ply"))
    'guitar'
    """
    return (
        f"{path.absolute().parent.name}/{path.name}" if path.is_dir() else path.name.split(".")[0]
    )


def checked(kind: type, values: Mapping[str, Any], withheld: set[str]) -> dict[str, Any]:
    """Check types and limits of values for a dataclass, and expand environment variables."""
    known = {f.name: f for f in fields(kind) if f.name not in withheld}
    unknown = next((name for name in values if name not in known), None)
    if unknown is not None:
        raise InputError(f"no key {unknown!r} (there are {', '.join(known)})")
    return {name: _value(known[name], value) for name, value in values.items()}


def _value(key_: Field[Any], given: Any) -> Any:
    kind = str(key_.type).removesuffix(" | None")
    if kind.startswith("Mapping["):
        if not isinstance(given, dict):
            raise InputError(f"{key_.name}: expected a table, got {given!r}")
        return {
            name: os.path.expandvars(v) if isinstance(v, str) else v for name, v in given.items()
        }
    if not kind.startswith("tuple["):
        return _item(key_, kind, given)
    if not isinstance(given, list | tuple):
        raise InputError(f"{key_.name}: expected a list, got {given!r}")
    if "..." not in kind and len(given) != kind.count(",") + 1:
        raise InputError(f"{key_.name}: expected {kind.count(',') + 1} values, got {given!r}")
    return tuple(_item(key_, kind[6:].split(",")[0], item) for item in given)


def _item(key_: Field[Any], kind: str, given: Any) -> Any:
    types, words = _TYPES[kind]
    least, choices = (key_.metadata.get(name) for name in ("least", "choices"))
    if choices:
        words = f"one of {', '.join(str(choice) for choice in choices if choice)}"
    elif least is not None and least > -math.inf:
        words += f", at least {least:g}"
    fits = isinstance(given, types) and (kind == "bool" or not isinstance(given, bool))
    if fits and kind in ("int", "float"):
        fits = (least is None or least <= given) and given < math.inf
    if not fits or (choices and given not in choices):
        raise InputError(f"{key_.name}: expected {words}, got {given!r}")
    return (
        os.path.expandvars(given) if kind == "str" else float(given) if kind == "float" else given
    )


def _method(cls: type[Study], name: str, values: dict[str, Any], known: Mapping[str, Any]) -> Any:
    if cls.DEFAULT is None:
        raise InputError(f"method {name}: this kind of study takes names only")
    base = values.pop("base", None)
    if base is not None and base not in known:
        raise InputError(f"method {name}: base: no {base!r}")
    start = cls.DEFAULT if base is None else known[base]
    try:
        return replace(start, name=name, **checked(type(start), values, {"name"}))
    except InputError as error:
        raise InputError(f"method {name}: {error}") from None


def _scene(values: dict[str, Any]) -> SceneSpec:
    if "name" not in values:
        raise InputError("scene: lacks 'name'")
    try:
        return SceneSpec(**checked(SceneSpec, values, set()))
    except InputError as error:
        raise InputError(f"scene {values['name']}: {error}") from None


def _chosen(known: Mapping[str, Any], names: Any) -> tuple[Any, ...]:
    if not isinstance(names, list | tuple):
        raise InputError(f"methods: expected a list, got {names!r}")
    missing = next((name for name in names if name not in known and ":" not in str(name)), None)
    if missing is not None:
        raise InputError(f"methods: no {missing!r} (there are {', '.join(known)})")
    return tuple(known.get(name, name) for name in names)


def _ratios_of(keep: Any, both: bool) -> list[float]:
    """Return the ratios of kept shares: the paper's 99,044 Gaussians are 0.033 of N."""
    if both:
        raise InputError("keep and ratios exclude each other")
    numbers = isinstance(keep, list) and all(type(share) in (int, float) for share in keep)
    if not numbers or not all(0 < share <= 1 for share in keep):
        raise InputError(f"keep: expected a list of shares in (0, 1], got {keep!r}")
    return [1 / share for share in keep]


def _spread(kind: type, name: str, value: Any) -> Any:
    """Parse an option's text: a TOML value, plain text, or for a list, several after commas."""
    if not isinstance(value, str):
        return value
    listed = any(f.name == name and str(f.type).startswith("tuple[") for f in fields(kind))
    if listed and not value.startswith("["):
        return [_parsed(part.strip()) for part in value.split(",")]
    return _parsed(value)


def _parsed(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _told(value: Any) -> str:
    return " and ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)
