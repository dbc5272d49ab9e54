"""Methods under matched compute: reduction, then recovery in the same steps or seconds on the same views.

Every reduction and recovery runs once in a process of its own (`benchmarks.kinds.worker`), and is shared by
all cells that need it.
"""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, ClassVar, get_args

import numpy as np
from numpy.typing import NDArray

from benchmarks import baselines
from benchmarks.baselines.pup import rounds as pup_rounds
from benchmarks.kinds.methods import METHODS, ROUND_STEPS, Budget, Leg, MethodSpec
from benchmarks.kinds.worker import StoredTargets, store_targets
from benchmarks.process import Usage, measured, splat_transform
from benchmarks.rows import Row
from benchmarks.runner import fingerprint
from benchmarks.score import figures, pictured, save_jpeg, score
from benchmarks.study import Cell, SceneSpec, Study, key
from benchmarks.workspace import Workspace, budget_of
from g2ard import __version__, io
from g2ard.config.choices import AdaptSchedule, Convention, Engine, LpipsInput, Method, ScheduleName
from g2ard.errors import InputError
from g2ard.io.splits import states_splits
from g2ard.rendering.metrics import Lpips, load_lpips
from g2ard.rendering.renderer import RasterSettings
from g2ard.rendering.targets import Targets
from g2ard.scene.cameras import Cameras
from g2ard.scene.shape import needle_share
from g2ard.scene.splats import Splats
from g2ard.stages.recover.anchors import REGULARIZERS, choose_regularizers
from g2ard.stages.simplify import round_counts

__all__ = ["Matched", "MatchedWorkspace"]


@dataclass(frozen=True)
class Matched(Study):
    """A study of methods under matched compute.

    Args:
        steps: budgets in optimiser steps; each is a cell.
        seconds: budgets in wall seconds of reduction and recovery together; each is a cell.
        released: whether to add each method's own schedule, if it has one.
        schedule: rates of matched cells, for methods without their own.
        sh_degree: SH degree of the results; None keeps the prior's, or 3 if photos are the targets.
        adapt_steps: steps of adaptation before scoring; 0 does not adapt.
        adapt_schedule: "default", or "paper": all steps at its rates, without blending.
        adapt_on: "train", or "all" views of `adapt` that are not of another split.
        convention: conventions of the renderer for scores.
        eight_bit: whether to round renders and targets to 8 bits before scoring, as in saved PNGs.
        engine: engine of recovery and adaptation.
        fold: the paper's rounds end with the one before if the last removes less than this share; the
            text has 0.
        lpips: folder of LPIPS weights.
        lpips_input: "scaled" to [−1, 1], or "unscaled" as in 3DGS's evaluation (`g2ard.rendering.metrics`).
    """

    METHODS: ClassVar[Mapping[str, Any]] = METHODS
    DEFAULT: ClassVar[MethodSpec] = METHODS["g2ard"]
    PROCESSES: ClassVar[bool] = True

    steps: tuple[int, ...] = key((), least=1, axis=True)
    seconds: tuple[float, ...] = key((), least=1e-6, axis=True)
    released: bool = key(False, axis=True)
    schedule: str = key("default", choices=get_args(ScheduleName))
    sh_degree: int | None = key(None, least=0)
    adapt_steps: int = key(0, least=0)
    adapt_schedule: str = key("default", choices=get_args(AdaptSchedule))
    adapt_on: str = key("train", choices=("train", "all"))
    convention: str = key("gsplat", choices=get_args(Convention))
    eight_bit: bool = key(False)
    engine: str = key("fused", choices=get_args(Engine))
    fold: float = key(0.0, least=0)
    lpips: str | None = key(None)
    lpips_input: str = key("scaled", choices=get_args(LpipsInput))

    def __post_init__(self) -> None:
        if not (self.steps or self.seconds or self.released):
            raise InputError("nothing to measure; give steps, seconds or released")

    def budgets(self, method: MethodSpec) -> list[Budget]:
        """Return the budgets of a method's cells."""
        if not method.recovers:
            return [Budget("none")]
        out = [Budget("steps", n) for n in self.steps] + [
            Budget("seconds", s) for s in self.seconds
        ]
        if self.released and method.released_steps is not None:
            out.append(Budget("released"))
        return out

    def cells(self, scene: SceneSpec, work: Path) -> Iterator[Cell]:
        """Yield a cell per ratio, method, budget and seed, and one per scene for the teacher."""
        place = MatchedWorkspace(work, self, scene)
        whole = [(1.0, m, Budget("none"), self.seeds[0]) for m in self.methods if not m.recovers]
        grid = [
            (ratio, method, budget, seed)
            for ratio in self.ratios
            for method in self.methods
            if method.recovers
            for budget in self.budgets(method)
            for seed in self.seeds
        ]
        for ratio, method, budget, seed in whole + grid:
            names = {
                "ratio": ratio,
                "method": method.name,
                "matched": budget.kind,
                "amount": budget.amount,
                "seed": seed,
            }
            shared = self.seeds[0] if method.shared_start else None
            measure = partial(self._measured, place, ratio, method, budget, seed)
            yield Cell(names, measure, more=[asdict(method), shared])

    def check(self) -> None:
        """Check paths and the engine, and load the LPIPS networks early."""
        super().check()
        self.networks  # noqa: B018

    def notes(self, scene: SceneSpec, work: Path) -> list[str]:
        """Return missing optional files, and counts that differ from the paper's."""
        return MatchedWorkspace(work, self, scene).notes()

    def derived(self, rows: list[Row]) -> list[Row]:
        """Add the difference to the teacher's row of the same scene, prior and split."""

        def place(row: Row) -> tuple[Any, ...]:
            return row["scene"], row.get("prior"), row.get("split")

        teachers = {
            place(row): row["psnr"] for row in rows if row["matched"] == "none" and "psnr" in row
        }
        return [
            {**row, "delta_psnr": row["psnr"] - teachers[place(row)]}
            if "psnr" in row and row["matched"] != "none" and place(row) in teachers
            else row
            for row in rows
        ]

    @cached_property
    def networks(self) -> dict[str, Lpips]:
        """LPIPS networks, if there are weights."""
        if self.lpips is None:
            return {}
        scaled = self.lpips_input == "scaled"
        return load_lpips(self.folder / self.lpips, scaled=scaled)

    def _measured(
        self, place: MatchedWorkspace, ratio: float, method: MethodSpec, budget: Budget, seed: int
    ) -> list[Row]:
        pipeline = _Pipeline(place, method, ratio, budget, seed)
        result = pipeline.run()
        splats = io.read_splats(result.output)
        if len(splats) != pipeline.budget:
            raise InputError(f"got {len(splats)} Gaussians, expected {pipeline.budget}")
        folder = place.work.parent
        shared = {
            **pipeline.figures(),
            "against": place.scene.targets,
            "count": len(splats),
            "bytes": splats.nbytes,
            "needle": needle_share(splats.scales),
            "dropped": place.dropped,
        }
        rows = []
        for split, targets in place.test.items():
            pictures, wanted = f"images/{result.key}/{split}", f"images/{place.key}/{split}"
            scored = score(
                splats,
                targets,
                place.scene.background,
                lpips=self.networks,
                settings=place.settings,
                eight_bit=self.eight_bit,
                pictures=folder / pictures,
            )
            for view in pictured(len(scored)):
                if not (folder / wanted / f"{view}.jpg").exists():
                    save_jpeg(folder / wanted / f"{view}.jpg", np.clip(targets[view], 0, 1))
            views = {"targets": wanted, "views": scored}
            (folder / pictures / "views.json").write_text(
                json.dumps(views), encoding="utf-8", newline="\n"
            )
            rows.append({**shared, **figures(scored), "split": split, "pictures": pictures})
        return rows


@dataclass(frozen=True)
class _Stage:
    """A finished stage: a hash of its inputs, its output, cost and report."""

    key: str
    output: Path
    usage: Usage
    report: dict[str, Any]


class MatchedWorkspace(Workspace):
    """A scene with priors of several kinds, views to adapt on, and the stages run on it."""

    study: Matched

    @property
    def kinds(self) -> tuple[str, ...]:
        """The available priors, the default first."""
        if not self.lifted:
            return ("given",)
        return ("trained", "lift") if self.scene.train_prior else ("lift",)

    def prior(self, kind: str | None) -> _Stage:
        """Return a prior as a .ply."""
        kind = kind or self.kinds[0]
        if kind not in self.kinds:
            raise InputError(
                f"scene {self.scene.name}: no {kind} prior (it has {', '.join(self.kinds)})"
            )
        if kind != "trained":
            return _Stage(f"{self.key}-{kind}", self.prior_file, Usage(0, 0, 0), {})
        job = {
            "schedule": "default",
            "steps": self.scene.train_prior,
            "seconds": None,
            "regularizers": asdict(REGULARIZERS["lift"]),
            "sh_degree": 3,
            "final": True,
            "seed": 0,
        }
        return self.recover(self.prior("lift"), self.train, job)

    def _training(self) -> Cameras:
        cameras = super()._training()
        return cameras.take(~self._last(cameras)) if self.scene.adapt_last else cameras

    def _last(self, cameras: Cameras) -> NDArray[np.bool_]:
        """Return a mask of the scene's `adapt_last` views, the last by name."""
        last, given = self.scene.adapt_last, len(cameras)
        if last >= given:
            raise InputError(f"adapt_last: {last} of {given} views leave none to train on")
        rank = np.argsort(np.argsort(cameras.names, kind="stable"), kind="stable")
        return rank >= given - last

    def adaptation(self, split: str) -> Cameras | None:
        """Return views of new appearance: "train" to adapt on, or "test".

        Without stated splits, every third by name is "test", or none if the study adapts on all.
        """
        if self.scene.adapt_last and self.scene.train is not None:
            if split == "test":
                return None
            cameras = self.views(self.place / self.scene.train, "train")
            return cameras.take(self._last(cameras))
        if self.scene.adapt is None:
            raise InputError("the study adapts; the scene needs `adapt` views or `adapt_last`")
        path = self.place / self.scene.adapt
        found = self.read(path)
        if states_splits(path, found.splits):
            return self.views(path, split)
        held_out = np.argsort(np.argsort(found.cameras.names)) % 3 == 1
        if self.study.adapt_on == "all":
            held_out[:] = False
        chosen = held_out if split == "test" else ~held_out
        return self.small(found, chosen) if chosen.any() else None

    @cached_property
    def adapted(self) -> Path:
        """The file of views to adapt on."""
        path = self.folder / "adapt.json"
        if not path.exists():
            cameras = self.adaptation("train")
            assert cameras is not None  # of a third there are two thirds left, and of none all
            self.write_views(path, cameras, "adapt")
        return path

    @property
    def dropped(self) -> int:
        """The number of views that were dropped from training or adaptation because they are scored."""
        adapt = self.adaptation("train") if self.study.adapt_steps else None
        return super().dropped + (
            0 if adapt is None else len(adapt) - len(self.read(self.adapted).cameras)
        )

    @cached_property
    def scored(self) -> dict[str, Cameras]:
        """Split → views to score on."""
        views = dict(super().scored)
        if self.study.adapt_steps and (held_out := self.adaptation("test")) is not None:
            views["adapt-val"] = held_out
        return views

    def notes(self) -> list[str]:
        """Add the number of views to adapt on."""
        notes, wanted = super().notes(), self.scene.expects.get("adapt")
        if wanted is not None and self.study.adapt_steps:
            found = len(self.read(self.adapted).cameras)
            notes += (
                [] if found == wanted else [f"adapt: {found:,} views, the paper has {wanted:,}"]
            )
        return notes

    @cached_property
    def settings(self) -> RasterSettings:
        """The settings of the renderer that scores."""
        return RasterSettings(convention="inria" if self.study.convention == "inria" else "gsplat")

    @cached_property
    def test(self) -> dict[str, Targets]:
        """Split → targets to score against."""
        apart = "" if self.study.convention == "gsplat" else f"-{self.study.convention}"
        return {
            name: StoredTargets(
                cameras, self._stored(f"targets-{name}{apart}", cameras, self.settings)
            )
            for name, cameras in self.scored.items()
        }

    def _stored(self, name: str, cameras: Cameras, settings: RasterSettings | None = None) -> Path:
        folder = self.folder / name
        if not (folder / "names.json").exists():  # written last
            store_targets(self.targets(cameras, settings, limit=0), folder)
        return folder

    def reduce(
        self, source: _Stage, views: Path, job: dict[str, Any], flags: Path | None
    ) -> _Stage:
        """Reduce a scene with the worker's options `job`."""
        if job["method"].startswith("splat-transform"):
            mode = "--decimate-adaptive" if job["method"].endswith("adaptive") else "--decimate"
            given = (str(source.output), mode, str(job["count"]))
            splat_transform()  # check early that it is installed
            return self._run(
                {"kind": "rival", **job},
                source,
                "out.ply",
                {},
                lambda out: splat_transform(*given, str(out)),
            )
        files = {"scene": source.output, "views": views, **({"flags": flags} if flags else {})}
        return self._run(
            {"kind": "reduce", **job, "indoor": self.scene.indoor}, source, "out.ply", files
        )

    def select(self, source: _Stage, policy: str, k: float, seed: int) -> _Stage:
        """Select training views by the prior."""
        count = max(1, round(k * len(self.train_cameras)))
        job = {"kind": "select", "policy": policy, "k": count, "seed": seed}
        return self._run(job, source, "views.json", {"scene": source.output, "views": self.train})

    def recover(
        self, source: _Stage, views: Path, options: dict[str, Any], anchors: _Stage | None = None
    ) -> _Stage:
        """Recover against the training targets, anchored to the geometry of `anchors` or of the source."""
        job = {
            "kind": "recover",
            "engine": self.study.engine,
            **options,
            "background": list(self.scene.background),
        }
        files = {"scene": source.output, "views": views}
        files["targets"] = self._stored("targets-train", self.read(self.train).cameras)
        if anchors is not None:
            job["anchored"] = anchors.key
            files["anchors"] = anchors.output
        return self._run(job, source, "out.ply", files)

    def adapt(self, source: _Stage, sh_degree: int | None, seed: int) -> _Stage:
        """Adapt appearance on frozen geometry."""
        job = {
            "kind": "adapt",
            "engine": self.study.engine,
            "steps": self.study.adapt_steps,
            "schedule": self.study.adapt_schedule,
            "sh_degree": sh_degree,
            "seed": seed,
            "background": list(self.scene.background),
        }
        files = {"scene": source.output, "views": self.adapted}
        files["targets"] = self._stored("targets-adapt", self.read(self.adapted).cameras)
        return self._run(job, source, "out.ply", files)

    def _run(
        self,
        job: dict[str, Any],
        source: _Stage,
        output: str,
        files: dict[str, Path],
        command: Callable[[Path], list[str]] | None = None,
    ) -> _Stage:
        """Run a job in a process, unless it has run before, and return its stage."""
        views = files.get("views", self.train)
        chosen = None if views.parent == self.folder else views.read_text(encoding="utf-8")
        name = fingerprint([job, source.key, chosen, __version__])
        place = self.folder / "stages" / name
        made, usage, report = place / output, place / "usage.json", place / "report.json"
        if not usage.exists():  # written last
            shutil.rmtree(place, ignore_errors=True)
            place.mkdir(parents=True)
            paths = {name: str(path) for name, path in files.items()}
            text = json.dumps({**job, **paths, "output": str(made)})
            (place / "job.json").write_text(text, encoding="utf-8", newline="\n")
            worker = [sys.executable, "-m", "benchmarks.kinds.worker", str(place / "job.json")]
            took = measured(worker if command is None else command(made), place / "log")
            usage.write_text(json.dumps(asdict(took)), encoding="utf-8", newline="\n")
        spent = Usage(**json.loads(usage.read_text(encoding="utf-8")))
        told = json.loads(report.read_text(encoding="utf-8")) if report.exists() else {}
        return _Stage(name, made, spent, told)


class _Pipeline:
    """The stages of a cell, from the prior to the scored scene."""

    def __init__(
        self, place: MatchedWorkspace, method: MethodSpec, ratio: float, matched: Budget, seed: int
    ) -> None:
        self.place, self.method, self.matched, self.seed = place, method, matched, seed
        self.source = place.prior(method.prior)
        self.prior = method.prior or place.kinds[0]
        splats = io.read_splats(self.source.output)
        self.count, self.budget = len(splats), budget_of(len(splats), ratio)
        self.regularizers = self._regularizers(splats)
        self.sh_degree = place.study.sh_degree
        if self.sh_degree is None and place.scene.targets != "teacher":
            self.sh_degree = 3
        # and wall seconds
        self.spent: dict[str, list[tuple[Usage, float]]] = {"reduce": [], "recover": []}
        self.steps = 0
        self.last: dict[str, Any] = {}

    def figures(self) -> Row:
        """Return the columns on cost and on the last recovery."""
        row: Row = {}
        for name, runs in self.spent.items():
            row[f"{name}_cpu_s"] = sum(usage.cpu_s for usage, _ in runs)
            row[f"{name}_peak_mb"] = max((usage.peak_mb for usage, _ in runs), default=0.0)
        return {
            **row,
            "prior": self.prior,
            "input_count": self.count,
            "budget": self.budget,
            "drift95": self.last.get("drift95", 0.0),  # scenes without recovery have not moved
            "steps": self.steps,
            "reduce_wall_s": self._wall("reduce"),
            "recover_wall_s": self._wall("recover"),
            "cpu_s": sum(row[f"{name}_cpu_s"] for name in self.spent if name != "adapt"),
            "seconds": self._wall("select", "reduce", "recover"),
        }

    def _wall(self, *names: str) -> float:
        """Return the seconds that stages of these kinds took."""
        return sum(wall for name in names for _, wall in self.spent.get(name, []))

    def _regularizers(self, prior: Splats) -> dict[str, Any]:
        """Return the method's weights of regularisers: the paper's for this kind of prior, or ours."""
        method = self.method
        papers = method.lambdas == "paper"
        known = (
            {"given": self.place.scene.regularizers}.get(self.prior, self.prior)
            if papers
            else "auto"
        )
        chosen, _, _ = choose_regularizers(
            known if method.preset == "auto" else method.preset, prior, paper=papers
        )
        return asdict(replace(chosen, **method.regularizers))

    def counts(self) -> list[int]:
        """Return the count after each round; the last is the budget."""
        if not self.method.recovers:
            return []
        if self.method.rounds == "paper":
            return round_counts(self.count, self.budget, fold=self.place.study.fold) or [
                self.budget
            ]
        return pup_rounds(self.count, self.budget) if self.method.rounds == "pup" else [self.budget]

    def run(self) -> _Stage:
        """Run all stages and return the scored scene."""
        method, place = self.method, self.place
        views = place.train
        if method.policy is not None:
            chosen = place.select(self.source, method.policy, method.k, self.seed)
            views = chosen.output
            self.spent["select"] = [(chosen.usage, chosen.usage.wall_s)]
        early = place.train if method.shared_start else views
        counts = self.counts()
        legs = method.legs(len(counts)) if counts else []
        state, flags = self.source, None
        for number, count in enumerate(counts):
            built = state = self._reduce(state, early, count, flags)
            if method.reduce in (*get_args(Method), "no-views"):
                flags = state.output.with_name("flags.npy")
            for leg in (leg for leg in legs if leg.round == number):
                state = self._recover(state, views if leg.final else early, leg, legs, built)
        if place.study.adapt_steps:
            state = place.adapt(state, self.sh_degree, self.seed)
            self.spent["adapt"] = [(state.usage, state.usage.wall_s)]
        return state

    def _seed(self, final: bool) -> int:
        """Return the seed; stages before a shared start's last recovery are shared by all rows."""
        return self.place.study.seeds[0] if self.method.shared_start and not final else self.seed

    def _reduce(self, state: _Stage, views: Path, count: int, flags: Path | None) -> _Stage:
        method = self.method
        job: dict[str, Any] = {"method": method.reduce, "count": count, "seed": self._seed(False)}
        if method.reduce not in baselines.METHODS:
            job |= {"budget": self.budget, "protection": method.protection}
        done = self.place.reduce(state, views, job, flags)
        self.spent["reduce"].append((done.usage, done.report.get("seconds", done.usage.wall_s)))
        return done

    def _recover(
        self, state: _Stage, views: Path, leg: Leg, legs: list[Leg], built: _Stage
    ) -> _Stage:
        """Recover; a second recovery at the same count stays anchored to the geometry as `built`."""
        spend = self._spend(leg, legs)
        if spend is None:
            return state
        job = {
            **spend,
            "regularizers": self.regularizers,
            "sh_degree": self.sh_degree,
            "final": leg.final,
            "seed": self._seed(leg.final),
        }
        done = self.place.recover(state, views, job, None if state is built else built)
        self.spent["recover"].append((done.usage, done.report["seconds"]))
        self.steps += done.report["steps"]
        self.last = done.report
        return done

    def _spend(self, leg: Leg, legs: list[Leg]) -> dict[str, Any] | None:
        """Return rates, and steps or seconds, of a recovery; None if none remain."""
        method, matched = self.method, self.matched
        if matched.kind == "released":
            if not method.released_steps:
                return None
            own = method.rounds == "paper" and not leg.final
            steps = ROUND_STEPS if own else method.released_steps
            return {"schedule": method.released_schedule, "steps": steps, "seconds": None}
        schedule = method.schedule or self.place.study.schedule
        # the checkpoint is not matched
        before = [] if method.shared_start else legs[: legs.index(leg)]
        if matched.kind == "steps":
            steps = int(leg.share * matched.amount)
            if leg.final:
                steps = int(matched.amount) - sum(int(b.share * matched.amount) for b in before)
            return {"schedule": schedule, "steps": steps, "seconds": None} if steps else None
        counted = ("select",) if method.shared_start else ("select", "reduce", "recover")
        left = matched.amount - self._wall(*counted)
        if left <= 0:  # scored without recovery; the row has the seconds
            return None
        limit = left if leg.final else left * leg.share / (1 - sum(b.share for b in before))
        return {"schedule": schedule, "steps": None, "seconds": round(limit, 3)}
