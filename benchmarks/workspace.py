"""Scenes made ready for a study, and stages run on them: each once, whoever asks for it again."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.definition import Definition, SceneSpec
from benchmarks.process import Usage, measured
from benchmarks.stage import Stage, fingerprint, folder_of, scene_key
from benchmarks.worker import StoredTargets, store_targets
from g2ard import __version__, io
from g2ard.errors import InputError
from g2ard.progress import Progress, plural, silent
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats
from g2ard.scene.splits import (
    for_scores,
    for_training,
    not_held_out,
    split_mask,
    splits_of,
    states_splits,
)
from g2ard.scene.targets import Photos, PhotosOrRenders, Targets, TeacherRenders

if TYPE_CHECKING:
    from g2ard.rendering.renderer import RasterSettings

__all__ = ["Stage", "Workspace", "fingerprint", "folder_of", "scene_key"]

_POOL = 128
_MAX_LOGIT = 20.0


class Workspace:
    """One scene of a definition with its priors, views and targets, and the stages run on it.

    All lives in `folder`; a stage whose key is there already is not run again.
    """

    def __init__(
        self, folder: Path, definition: Definition, scene: SceneSpec, progress: Progress = silent
    ) -> None:
        self.definition, self.scene, self.progress = definition, scene, progress
        self.key = scene_key(definition, scene)
        self.folder = folder_of(folder, definition, scene)
        self.folder.mkdir(parents=True, exist_ok=True)

    @cached_property
    def place(self) -> Path:
        """What the definition's paths are relative to; a city is made here."""
        if self.scene.synth is None:
            return self.definition.folder
        from benchmarks.synth import CityConfig, write_city

        town = self.folder / "city"
        if not town.is_dir():
            options = dict(self.scene.synth)
            if "size" in options:
                options["size"] = tuple(options["size"])
            write_city(town, CityConfig(sky=self.scene.background, **options), progress=self.progress)
        return town

    @cached_property
    def kinds(self) -> tuple[str, ...]:
        """The priors there are, the usual one first."""
        if io.kind(self.place / self.scene.prior) == "splats":
            return ("given",)
        if self.scene.targets != "photos":
            raise InputError(f"scene {self.scene.name}: a cloud is no teacher: targets must be photos")
        return ("trained", "lift") if self.scene.train_prior else ("lift",)

    def prior(self, kind: str | None) -> Stage:
        """A prior, written out as .ply.

        Raises:
            InputError: the scene has no prior of that kind.
        """
        kind = kind or self.kinds[0]
        if kind not in self.kinds:
            raise InputError(f"scene {self.scene.name}: no {kind} prior (it has {', '.join(self.kinds)})")
        if kind == "trained":
            return self._trained()
        path = self.folder / "prior.ply"
        if not path.exists():
            source = self.place / self.scene.prior
            splats = _readable(source) if kind == "given" else _lifted(source)
            io.write_splats(path, splats)
        return Stage(f"{self.key}-{kind}", path, Usage(0, 0, 0), {})

    def _trained(self) -> Stage:
        from g2ard.stages.recover.anchors import PRESETS

        lift = self.prior("lift")
        return self.recover(
            lift,
            self.train,
            {
                "schedule": "default",
                "steps": self.scene.train_prior,
                "seconds": None,
                "regularizers": asdict(PRESETS["lift"]),
                "sh_degree": 3,
                "final": True,
                "seed": 0,
            },
        )

    @cached_property
    def train(self) -> Path:
        """Training views, at the study's size, photos named by absolute path; none that is scored on."""
        path = self.folder / "train.json"
        if not path.exists():
            if self.scene.train is None:
                cameras = self._pool("train")
            else:
                whole = self.place / self.scene.train
                apart = bool(self.scene.score)
                cameras = self._apart(whole, for_training) if apart else self._views(whole, "train")
                cameras = cameras.take(~self._last(cameras))
            cameras = self._not_scored(cameras, "train")
            io.write_views(path, cameras, splits=["train"] * len(cameras))
        return path

    @property
    def dropped(self) -> int:
        """How many views were given both to train or adapt on and to score on; they are scored on alone."""
        path = self.folder / "dropped.json"
        return sum(json.loads(path.read_text(encoding="utf-8")).values()) if path.exists() else 0

    def _not_scored(self, cameras: Cameras, what: str) -> Cameras:
        """Those that no split scores on, by photo or pose; how many were is kept in dropped.json."""
        keep = np.ones(len(cameras), bool)
        for name, scored in self.scored.items():
            if what == "adapt" or name != "adapt-val":  # another light's photos may be of places trained on
                keep &= not_held_out(cameras, scored)
        if not keep.any():
            raise InputError(
                f"scene {self.scene.name}: all {plural(len(keep), 'view')} to {what} on are scored on"
            )
        path = self.folder / "dropped.json"
        counts = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        path.write_text(
            json.dumps({**counts, what: int(np.count_nonzero(~keep))}), encoding="utf-8", newline="\n"
        )
        return cameras.take(keep)

    def _last(self, cameras: Cameras) -> NDArray[np.bool_]:
        """Those of the scene's `adapt_last`: the last by name."""
        last, given = self.scene.adapt_last, len(cameras)
        if last >= given:
            raise InputError(
                f"scene {self.scene.name}: adapt_last: {last} of {given} views leave none to train on"
            )
        rank = np.argsort(np.argsort(cameras.names, kind="stable"), kind="stable")
        return rank >= given - last

    def adaptation(self, split: str) -> Cameras | None:
        """Views of new appearance: "train" to adapt on and "test", as they state; where they state no split
        every third, by name, is "test", for they are few, or None where the study adapts on all."""
        if self.scene.adapt_last and self.scene.train is not None:
            if split == "test":
                return None
            cameras = self._views(self.place / self.scene.train, "train")
            return cameras.take(self._last(cameras))
        if self.scene.adapt is None:
            raise InputError(
                f"scene {self.scene.name}: the study adapts, and it has no `adapt` views and no `adapt_last`"
            )
        path = self.place / self.scene.adapt
        found = self._read(path)
        if states_splits(path, found.splits):
            return self._views(path, split)
        held_out = np.argsort(np.argsort(found.cameras.names)) % 3 == 1
        if self.definition.adapt_on == "all":
            held_out[:] = False
        chosen = held_out if split == "test" else ~held_out
        return self._small(found, chosen) if chosen.any() else None

    @cached_property
    def adapt(self) -> Path:
        """The views to adapt on, written out."""
        path = self.folder / "adapt.json"
        if not path.exists():
            cameras = self.adaptation("train")
            assert cameras is not None  # of a third there are two thirds left, and of none all
            cameras = self._not_scored(cameras, "adapt")
            io.write_views(path, cameras, splits=["train"] * len(cameras))
        return path

    def _read(self, path: Path) -> io.ViewSet:
        return io.read_view_set(path, unpictured=self.scene.targets == "either")

    def _views(self, path: Path, split: str) -> Cameras:
        found = self._read(path)
        return self._small(found, split_mask(path, found.cameras.names, split, stated=found.splits))

    def _small(self, found: io.ViewSet, mask: NDArray[np.bool_]) -> Cameras:
        return found.take(mask).resized(self.definition.size).cameras

    def _apart(self, path: Path, chosen: Callable[..., NDArray[np.bool_]]) -> Cameras:
        """The views that `for_training` or `for_scores` chooses, where a scene is scored on its own files."""
        found = self._read(path)
        return self._small(found, chosen(path, found.cameras.names, found.splits))

    def _pool(self, split: str) -> Cameras:
        """A pool made for the scene; every 8th pose is scored."""
        path = self.folder / "pool.json"
        if not path.exists():
            from g2ard.poses import make_pool

            pool = make_pool(io.read_splats(self.prior(None).output), _POOL, seed=0)
            io.write_views(path, pool, splits=splits_of(None, pool.names))
        return self._views(path, split)

    @cached_property
    def scored(self) -> dict[str, Cameras]:
        """Split → views to score on."""
        spec = self.scene
        if spec.score:
            views = {name: self._apart(self.place / path, for_scores) for name, path in spec.score.items()}
        elif spec.train is not None:
            views = {"test": self._views(self.place / spec.train, "test")}
        else:
            views = {"test": self._pool("test")}
        if self.definition.adapt_steps and (held_out := self.adaptation("test")) is not None:
            views["adapt-val"] = held_out
        return views

    @cached_property
    def test(self) -> dict[str, Targets]:
        """Split → targets to score against."""
        return {name: self._scored(name, cameras) for name, cameras in self.scored.items()}

    @cached_property
    def settings(self) -> RasterSettings:
        """Of the renderer that scores."""
        from g2ard.rendering.renderer import RasterSettings

        return RasterSettings(convention="inria" if self.definition.convention == "inria" else "gsplat")

    def _scored(self, name: str, cameras: Cameras) -> Targets:
        apart = "" if self.definition.convention == "gsplat" else f"-{self.definition.convention}"
        return StoredTargets(cameras, self._stored(f"targets-{name}{apart}", cameras, self.settings))

    @cached_property
    def train_targets(self) -> Path:
        """Where the targets of the training views lie."""
        return self._stored("targets-train", self._read(self.train).cameras)

    def _stored(self, name: str, cameras: Cameras, settings: RasterSettings | None = None) -> Path:
        folder = self.folder / name
        if not (folder / "names.json").exists():  # written last
            store_targets(self._made(cameras, settings), folder)
        return folder

    def _made(self, cameras: Cameras, settings: RasterSettings | None) -> Targets:
        if self.scene.targets == "photos":
            return Photos(cameras, limit=0)
        kind = TeacherRenders if self.scene.targets == "teacher" else PhotosOrRenders
        teacher = io.read_splats(self.prior(None).output)
        return kind(
            teacher=teacher, cameras=cameras, background=self.scene.background, settings=settings, limit=0
        )

    def reduce(self, source: Stage, views: Path, options: dict[str, Any], flags: Path | None = None) -> Stage:
        """Fewer Gaussians; `options` are those of the worker's job."""
        if options["method"].startswith("splat-transform"):
            return self._rival(source, options)
        job = {"kind": "reduce", **options, "indoor": self.scene.indoor}
        files = {"scene": source.output, "views": views, **({"flags": flags} if flags else {})}
        return self._run(job, source.key, "out.ply", files)

    def _rival(self, source: Stage, options: dict[str, Any]) -> Stage:
        program = shutil.which("splat-transform")
        if program is None:
            raise InputError("splat-transform: not on PATH (npm i -g @playcanvas/splat-transform)")
        mode = "--decimate-adaptive" if options["method"].endswith("adaptive") else "--decimate"

        def command(output: Path) -> list[str]:
            given = [program, "-q", "-w", "-g", "cpu", str(source.output), mode]
            return [*given, str(options["count"]), str(output)]

        return self._run({"kind": "rival", **options}, source.key, "out.ply", {}, command)

    def select(self, source: Stage, policy: str, k: float, seed: int) -> Stage:
        """Part of the training views, chosen by what the prior shows."""
        count = max(1, round(k * len(self._read(self.train).cameras)))
        job = {"kind": "select", "policy": policy, "k": count, "seed": seed}
        files = {"scene": source.output, "views": self.train}
        return self._run(job, source.key, "views.json", files)

    def recover(
        self, source: Stage, views: Path, options: dict[str, Any], anchors: Stage | None = None
    ) -> Stage:
        """Recovery against the training targets, held to the geometry of `anchors`, else of the source."""
        job = {"kind": "recover", **options, "background": list(self.scene.background)}
        files = self._inputs(source, views)
        if anchors is not None:
            job["anchored"] = anchors.key
            files["anchors"] = anchors.output
        return self._run(job, source.key, "out.ply", files)

    def readapt(self, source: Stage, sh_degree: int | None, seed: int) -> Stage:
        """New appearance on frozen geometry."""
        job = {
            "kind": "adapt",
            "steps": self.definition.adapt_steps,
            "schedule": self.definition.adapt_schedule,
            "sh_degree": sh_degree,
            "seed": seed,
            "background": list(self.scene.background),
        }
        files = {"scene": source.output, "views": self.adapt, "targets": self._adapt_targets}
        return self._run(job, source.key, "out.ply", files)

    @cached_property
    def _adapt_targets(self) -> Path:
        return self._stored("targets-adapt", self._read(self.adapt).cameras)

    def _inputs(self, source: Stage, views: Path) -> dict[str, Path]:
        return {"scene": source.output, "views": views, "targets": self.train_targets}

    def _run(
        self,
        job: dict[str, Any],
        upstream: str,
        output: str,
        files: dict[str, Path],
        command: Callable[[Path], list[str]] | None = None,
    ) -> Stage:
        views = files.get("views", self.train)
        chosen = None if views.parent == self.folder else views.read_text(encoding="utf-8")
        key = fingerprint([job, upstream, chosen, __version__])
        place = self.folder / "stages" / key
        made, usage = place / output, place / "usage.json"
        if not usage.exists():  # written last
            shutil.rmtree(place, ignore_errors=True)
            place.mkdir(parents=True)
            paths = {name: str(path) for name, path in files.items()}
            (place / "job.json").write_text(
                json.dumps({**job, **paths, "output": str(made)}), encoding="utf-8", newline="\n"
            )
            worker = [sys.executable, "-m", "benchmarks.worker", str(place / "job.json")]
            took = measured(worker if command is None else command(made), place / "log")
            usage.write_text(json.dumps(asdict(took)), encoding="utf-8", newline="\n")
        report = place / "report.json"
        return Stage(
            key,
            made,
            Usage(**json.loads(usage.read_text(encoding="utf-8"))),
            json.loads(report.read_text(encoding="utf-8")) if report.exists() else {},
        )


def _readable(path: Path) -> Splats:
    """The scene as every program can read it: an opacity of exactly 1 has no finite logit."""
    from dataclasses import replace

    splats = io.read_splats(path)
    return replace(splats, logit_opacities=np.clip(splats.logit_opacities, -_MAX_LOGIT, _MAX_LOGIT))


def _lifted(path: Path) -> Splats:
    from g2ard.stages.lift import lift

    points = io.read_points(path)
    return lift(points.positions, points.colors)
