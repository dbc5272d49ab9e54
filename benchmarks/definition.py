"""What a study is: scenes, methods, ratios and how compute is matched; read from TOML."""

from __future__ import annotations

import math
import os
import re
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from benchmarks.methods import METHODS, Matched, MethodSpec
from g2ard.config.choices import ADAPT_SCHEDULES, BLACK, CONVENTIONS, LPIPS_INPUTS, SCHEDULE_NAMES, Colour
from g2ard.errors import InputError

__all__ = ["METHODS", "Definition", "Matched", "MethodSpec", "SceneSpec", "read_definition"]

_VARIABLE = re.compile(r"\$\{?(\w+)")
_TARGETS = ("teacher", "photos", "either")
_UNDONE = ("preset", "released", "matched")


@dataclass(frozen=True)
class SceneSpec:
    """A scene and its views.

    Args:
        name: as the rows call it.
        prior: a trained scene or a coloured cloud; relative to the definition, or to the city made.
        train: views to recover on: their train split, or all if there is a `score` and they state no split;
            None takes the training part of a pool made for the scene.
        score: name → views to score on, but for those stated as train; empty takes the test part of `train`,
            or of the pool.
        adapt: views of new appearance, for studies that adapt; every third is scored if they state no split,
            unless the study adapts on all.
        adapt_last: for a scene without `adapt`: so many training views, the last by name, are a trajectory of
            their own, adapted on and not trained on.
        targets: "teacher", the prior's renders, "photos", or "either": of each view its photo where it has
            one, else the prior's render.
        background: behind the scene.
        indoor: whether Mini-Splatting uses its importance for rooms.
        train_prior: steps that make a "trained" prior of a lift, at its own count.
        synth: options of `python -m benchmarks synth city`; the scene is then made.
    """

    name: str
    prior: str = "cloud.ply"
    train: str | None = None
    score: Mapping[str, str] = field(default_factory=dict)
    adapt: str | None = None
    adapt_last: int = 0
    targets: str = "teacher"
    background: Colour = BLACK
    indoor: bool = False
    train_prior: int = 0
    synth: Mapping[str, Any] | None = None


@dataclass(frozen=True)
class Definition:
    """A study.

    Args:
        name: of the file.
        title: one line.
        scenes: where.
        methods: what is compared; the first is ours.
        ratios: budget = round(N / ratio).
        seeds: of everything random.
        steps: budgets in optimiser steps; each is a cell.
        seconds: budgets in wall seconds of reduction and recovery together; each is a cell.
        released: also each method's own schedule, where it has one.
        schedule: rates of the matched cells, the same for all methods that state none.
        size: longer side of the views, pixels; None keeps them.
        sh_degree: of the results; None keeps the prior's, and 3 where photos are the targets.
        adapt_steps: steps of appearance on frozen geometry before scoring; 0 does not adapt.
        adapt_schedule: "default", or "paper": all steps at its rates, nothing blended.
        adapt_on: "train", or "all" views of `adapt` that are not stated as another split.
        convention: of the renderer that scores, "gsplat" or "inria".
        eight_bit: round renders and targets to 8 bits before they are scored, as saved PNGs are.
        lpips: folder of the networks' weights.
        lpips_input: "scaled" to [−1, 1], or "unscaled" as 3DGS's evaluation has it (`g2ard.rendering.lpips`).
        differs: in what the study differs from the paper's, a line each; reports print them.
        differs_unless: lines that an option of the run undoes: "preset", "released", "matched" → lines.
    """

    name: str
    title: str
    scenes: tuple[SceneSpec, ...]
    methods: tuple[MethodSpec, ...]
    ratios: tuple[float, ...] = (10.0,)
    seeds: tuple[int, ...] = (0,)
    steps: tuple[int, ...] = ()
    seconds: tuple[float, ...] = ()
    released: bool = False
    schedule: str = "default"
    size: int | None = None
    sh_degree: int | None = None
    adapt_steps: int = 0
    adapt_schedule: str = "default"
    adapt_on: str = "train"
    convention: str = "gsplat"
    eight_bit: bool = False
    lpips: str | None = None
    lpips_input: str = "scaled"
    differs: tuple[str, ...] = ()
    differs_unless: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    folder: Path = Path()

    def __post_init__(self) -> None:
        for key, kind, least in (
            ("ratios", (int, float), 1),
            ("seeds", int, 0),
            ("steps", int, 1),
            ("seconds", (int, float), 1e-6),
        ):
            values = getattr(self, key)
            if not isinstance(values, tuple):
                raise InputError(f"{key}: expected a list, got {values!r}")
            for value in values:
                if isinstance(value, bool) or not isinstance(value, kind) or not least <= value < math.inf:
                    raise InputError(f"{key}: expected numbers, at least {least:g}, got {value!r}")
        for i, scene in enumerate(self.scenes):
            if scene.name in {other.name for other in self.scenes[:i]}:
                raise InputError(f"scene {scene.name}: there are two of that name")
        if not isinstance(self.title, str):
            raise InputError(f"title: expected text, got {self.title!r}")
        for key, least in (("size", 16), ("adapt_steps", 0), ("sh_degree", 0)):
            value = getattr(self, key)
            if value is not None and (not isinstance(value, int) or value < least):
                raise InputError(f"{key}: expected a whole number, at least {least}, got {value!r}")
        for key, known in (
            ("schedule", SCHEDULE_NAMES),
            ("adapt_schedule", ADAPT_SCHEDULES),
            ("adapt_on", ("train", "all")),
            ("convention", CONVENTIONS),
            ("lpips_input", LPIPS_INPUTS),
            ("eight_bit", (False, True)),
        ):
            value = getattr(self, key)
            if value not in known:
                options = "true or false" if key == "eight_bit" else " or ".join(map(str, known))
                raise InputError(f"{key}: expected {options}, got {value!r}")
        if not isinstance(self.differs, tuple) or not all(isinstance(line, str) for line in self.differs):
            raise InputError(f"differs: expected a list of lines, got {self.differs!r}")
        if not isinstance(self.differs_unless, Mapping):
            raise InputError(f"differs_unless: expected a table of lists, got {self.differs_unless!r}")
        for key, lines in self.differs_unless.items():
            if key not in _UNDONE:
                raise InputError(f"differs_unless: expected {', '.join(_UNDONE)}, got {key!r}")
            if not isinstance(lines, tuple) or not all(isinstance(line, str) for line in lines):
                raise InputError(f"differs_unless: {key}: expected a list of lines, got {lines!r}")

    @property
    def differences(self) -> tuple[str, ...]:
        """All lines that say in what the study, as it is run, differs from the paper's."""
        return (*self.differs, *(line for lines in self.differs_unless.values() for line in lines))

    def run_with(self, option: str, *lines: str) -> Definition:
        """The same without the lines that an option undoes, and with those that it brings, first."""
        kept = {key: value for key, value in self.differs_unless.items() if key != option}
        return replace(self, differs=(*lines, *self.differs), differs_unless=kept)

    def matched(self, method: MethodSpec) -> list[Matched]:
        """The budgets under which a method is measured."""
        if not method.recovers:
            return [Matched("none")]
        out = [Matched("steps", n) for n in self.steps] + [Matched("seconds", s) for s in self.seconds]
        if self.released and method.released_steps is not None:
            out.append(Matched("released"))
        return out

    def require_variables(self) -> None:
        """Refuse paths that name an environment variable which is not set.

        Raises:
            InputError: there is one; the message names the first.
        """
        for scene in self.scenes:
            paths = (scene.prior, scene.train, scene.adapt, *scene.score.values())
            missing = next(filter(None, (_VARIABLE.search(path) for path in paths if path)), None)
            if missing is not None:
                raise InputError(f"{self.name}: scene {scene.name}: ${missing[1]} is not set")

    def cells(self) -> Iterator[tuple[SceneSpec, float, MethodSpec, Matched, int]]:
        """Scene by scene, all that is to be measured; a teacher's row once a scene."""
        for scene in self.scenes:
            for method in self.methods:
                if not method.recovers:
                    yield scene, 1.0, method, self.matched(method)[0], self.seeds[0]
            for ratio in self.ratios:
                for method in self.methods:
                    if not method.recovers:
                        continue
                    for matched in self.matched(method):
                        for seed in self.seeds:
                            yield scene, ratio, method, matched, seed

    def narrowed(self, **options: Any) -> Definition:
        """The same with some fields given anew; None leaves a field."""
        return replace(self, **{key: value for key, value in options.items() if value is not None})


def read_definition(path: Path) -> Definition:
    """Read a study.

    Tables `[[scene]]` are `SceneSpec`s; `methods` lists names of `METHODS` or of tables `[method.NAME]`,
    which take over the fields of their `base`. `keep = [0.033]` is `ratios = [1 / 0.033]`.

    Raises:
        InputError: it cannot be read, or a key or value is not known; the message names the file.
    """
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError(f"{path}: {error}") from None
    try:
        tables = content.pop("method", {})
        own = {name: _method(name, values) for name, values in tables.items()}
        known = {**METHODS, **own}
        names = content.pop("methods", list(own))
        if not isinstance(names, list):
            raise InputError(f"methods: expected a list, got {names!r}")
        missing = next((name for name in names if name not in known), None)
        if missing is not None:
            raise InputError(f"methods: no {missing!r} (there are {', '.join(known)})")
        scenes = tuple(_scene(values) for values in content.pop("scene", []))
        if "keep" in content:
            content["ratios"] = _ratios_of(content.pop("keep"), "ratios" in content)
        values = _checked(Definition, {"title": path.stem, **content}, {"name", "folder", "scenes"})
        made = Definition(
            name=path.stem,
            scenes=scenes,
            methods=tuple(known[name] for name in names),
            folder=path.parent.absolute(),
            **values,
        )
        lacks = next(
            (key for key in ("scenes", "methods", "ratios", "seeds") if not getattr(made, key)), None
        )
        if lacks is not None or not (made.steps or made.seconds or made.released):
            raise InputError(
                f"no {lacks or 'steps, no seconds, and not released'}: there is nothing to measure"
            )
        return made
    except (InputError, TypeError) as error:
        raise InputError(f"{path}: {error}") from None


def _method(name: str, values: dict[str, Any]) -> MethodSpec:
    values = dict(values)
    base = values.pop("base", "g2ard")
    if base not in METHODS:
        raise InputError(f"method {name}: base: no {base!r}")
    return replace(METHODS[base], **{"name": name, **_checked(MethodSpec, values, {"name"})})


def _ratios_of(keep: Any, both: bool) -> list[float]:
    """Ratios of shares that are kept: the paper's 99,044 Gaussians are 0.033 of N."""
    if both:
        raise InputError("keep and ratios exclude each other")
    numbers = isinstance(keep, list) and all(type(share) in (int, float) for share in keep)
    if not numbers or not all(0 < share <= 1 for share in keep):
        raise InputError(f"keep: expected a list of shares in (0, 1], got {keep!r}")
    return [1 / share for share in keep]


def _scene(values: dict[str, Any]) -> SceneSpec:
    if "name" not in values:
        raise InputError("scene: lacks 'name'")
    made = SceneSpec(**_checked(SceneSpec, values, set()))
    if made.targets not in _TARGETS:
        raise InputError(f"scene {made.name}: targets: {', '.join(_TARGETS)}, not {made.targets!r}")
    if not isinstance(made.adapt_last, int) or made.adapt_last < 0:
        raise InputError(
            f"scene {made.name}: adapt_last: expected a number of views, got {made.adapt_last!r}"
        )
    if made.adapt_last and (made.adapt is not None or made.train is None):
        raise InputError(f"scene {made.name}: adapt_last is for a scene with `train` and without `adapt`")
    return made


def _checked(kind: type, values: dict[str, Any], withheld: set[str]) -> dict[str, Any]:
    """The values as the dataclass wants them: lists as tuples, environment variables in paths."""
    known = {f.name: f for f in fields(kind) if f.name not in withheld}
    unknown = next((key for key in values if key not in known), None)
    if unknown is not None:
        raise InputError(f"no key {unknown!r} (there are {', '.join(known)})")
    return {key: _plain(value) for key, value in values.items()}


def _plain(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(_plain(item) for item in value)
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return os.path.expandvars(value) if isinstance(value, str) else value
