"""What a study is: scenes, methods, ratios and how compute is matched; read from TOML."""

from __future__ import annotations

import math
import os
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from g2ard import baselines
from g2ard.errors import InputError

__all__ = ["METHODS", "Definition", "Matched", "MethodSpec", "SceneSpec", "read_definition"]

_OURS = ("default", "no-views", "fast", "paper")
_RIVALS = ("splat-transform", "splat-transform-adaptive")
_REDUCERS = (*_OURS, *baselines.METHODS, *_RIVALS)
_POLICIES = ("auto", "directional", "coverage", "pose-diverse", "random", "uniform")


@dataclass(frozen=True)
class MethodSpec:
    """One method: how it reduces, in which rounds, and what of the recovery is its own.

    Args:
        name: as the rows call it.
        reduce: one of g2ard's policies (default, no-views, fast, paper), a baseline, or a rival program.
        rounds: "one" shot; "paper", 75 % a round with recovery after each; "pup", its two.
        round_share: share of the matched steps or seconds that the rounds before the last recovery take.
        prior: "lift", "trained" or "given": which of the scene's priors; None means the scene's own choice.
        policy: of view selection; None trains on all views.
        k: share of the training views that the policy keeps.
        preset: of the regularisers.
        anchor: overrides the preset's weight of L_anchor.
        shape: overrides the preset's weight of L_shape; 0 also ends the effective rank's barrier.
        period: overrides how many steps there are from one addition of the regularisers to the next, 100.
        protection: λ_h of the `paper` policy; 0 takes the flags away.
        released_steps: steps of each recovery in the method's own release; None where there is none.
        released_schedule: their rates.
    """

    name: str
    reduce: str
    rounds: str = "one"
    round_share: float = 0.5
    prior: str | None = None
    policy: str | None = None
    k: float = 1.0
    preset: str = "auto"
    anchor: float | None = None
    shape: float | None = None
    period: int | None = None
    protection: float | None = None
    released_steps: int | None = None
    released_schedule: str = "3dgs"

    def __post_init__(self) -> None:
        for key, known in (
            ("reduce", _REDUCERS),
            ("rounds", ("one", "paper", "pup")),
            ("prior", (None, "lift", "trained", "given")),
            ("policy", (None, *_POLICIES)),
            ("preset", ("auto", "trained", "lift", "noisy")),
            ("released_schedule", ("3dgs", "paper", "default")),
        ):
            if getattr(self, key) not in known:
                options = ", ".join(str(option) for option in known if option)
                raise InputError(
                    f"method {self.name}: {key}: expected one of {options}, got {getattr(self, key)!r}"
                )
        if self.period is not None and self.period < 1:
            raise InputError(f"method {self.name}: period: expected at least 1, got {self.period}")
        if not 0 < self.k <= 1 or not 0 <= self.round_share < 1:
            raise InputError(f"method {self.name}: k {self.k} and round_share {self.round_share}: shares")


_3DGS = {"released_schedule": "3dgs"}
METHODS: dict[str, MethodSpec] = {
    m.name: m
    for m in (
        MethodSpec("g2ard", "default"),
        MethodSpec("g2ard-fast", "fast"),
        MethodSpec(
            "g2ard-paper",
            "paper",
            rounds="paper",
            round_share=0.6,
            released_steps=38_000,
            released_schedule="paper",
        ),
        MethodSpec("lightgaussian", "lightgaussian", released_steps=5_000),
        MethodSpec("pup", "pup", rounds="pup", released_steps=5_000),
        MethodSpec("mini-splatting", "mini-splatting", released_steps=15_000),
        MethodSpec("nanogs", "nanogs", released_steps=0),
        MethodSpec("opacity-area", "opacity-area"),
        MethodSpec("random", "random"),
        MethodSpec("splat-transform", "splat-transform", released_steps=0),
        MethodSpec("splat-transform-adaptive", "splat-transform-adaptive", released_steps=0),
    )
}
"""What a definition may name without describing it. PUP's and LightGaussian's released steps are those of
their papers; Mini-Splatting trains on for 15,000 once it has simplified; NanoGS and splat-transform do not
recover. The paper's method takes 8,000 after each round, and after the last 30,000 more (`tab:s_config`)."""


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
        adapt: views of new appearance, for studies that adapt; every third is scored if they state no split.
        targets: "teacher", the prior's renders, or "photos".
        background: behind the scene.
        indoor: whether Mini-Splatting uses its importance for rooms.
        train_prior: steps that make a "trained" prior of a lift, at its own count.
        synth: options of `g2ard synth city`; the scene is then made.
    """

    name: str
    prior: str = "cloud.ply"
    train: str | None = None
    score: Mapping[str, str] = field(default_factory=dict)
    adapt: str | None = None
    targets: str = "teacher"
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    indoor: bool = False
    train_prior: int = 0
    synth: Mapping[str, Any] | None = None


@dataclass(frozen=True)
class Matched:
    """What a cell may spend: `amount` steps or seconds, or what the method's release spends."""

    kind: str
    amount: float = 0.0

    @property
    def label(self) -> str:
        """As rows and charts call it."""
        return {"steps": f"{self.amount:g} steps", "seconds": f"{self.amount:g} s"}.get(self.kind, self.kind)


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
        schedule: rates of the matched cells, the same for all.
        size: longer side of the views, pixels; None keeps them.
        sh_degree: of the results; None keeps the prior's, and 3 where photos are the targets.
        adapt_steps: steps of appearance on frozen geometry before scoring; 0 does not adapt.
        lpips: folder of the networks' weights.
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
    lpips: str | None = None
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
        if self.schedule not in ("default", "paper", "fast", "best"):
            raise InputError(f"schedule: expected default, fast, best or paper, got {self.schedule!r}")

    def matched(self, method: MethodSpec) -> list[Matched]:
        """The budgets under which a method is measured."""
        out = [Matched("steps", n) for n in self.steps] + [Matched("seconds", s) for s in self.seconds]
        if self.released and method.released_steps is not None:
            out.append(Matched("released"))
        return out

    def cells(self) -> Iterator[tuple[SceneSpec, float, MethodSpec, Matched, int]]:
        """Scene by scene, all that is to be measured."""
        for scene in self.scenes:
            for ratio in self.ratios:
                for method in self.methods:
                    for matched in self.matched(method):
                        for seed in self.seeds:
                            yield scene, ratio, method, matched, seed

    def narrowed(self, **options: Any) -> Definition:
        """The same with some fields given anew; None leaves a field."""
        return replace(self, **{key: value for key, value in options.items() if value is not None})


def read_definition(path: Path) -> Definition:
    """Read a study.

    Tables `[[scene]]` are `SceneSpec`s; `methods` lists names of `METHODS` or of tables `[method.NAME]`,
    which take over the fields of their `base`.

    Raises:
        InputError: it cannot be read, or a key or value is not known; the message names the file.
    """
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
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


def _scene(values: dict[str, Any]) -> SceneSpec:
    if "name" not in values:
        raise InputError("scene: lacks 'name'")
    made = SceneSpec(**_checked(SceneSpec, values, set()))
    if made.targets not in ("teacher", "photos"):
        raise InputError(f"scene {made.name}: targets: teacher or photos, not {made.targets!r}")
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
