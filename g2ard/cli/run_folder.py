"""The folder of a `distill` run: its files, and earlier runs in it."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from g2ard.cli.resume import (
    OPTIONS,
    check_same,
    check_stopped,
    has_checkpoints,
    identify_files,
    keep_checkpoints,
    list_finished_steps,
)
from g2ard.cli.run import Run
from g2ard.config.choices import BLACK, WHITE, Colour, Named, ViewFormat
from g2ard.errors import InputError, OutputError
from g2ard.io import Source, write_views
from g2ard.io.atomic import atomic_output, check_output, drop_empty, drop_temporaries
from g2ard.io.jsonfile import read_json
from g2ard.io.lock import check_unlocked, locked
from g2ard.io.reports import Report, plain
from g2ard.io.scene_formats import SUFFIXES
from g2ard.io.types import ViewSet
from g2ard.jobs.budget import DEVICES, Budget
from g2ard.jobs.cost import LARGEST_DENSE
from g2ard.jobs.viewer_frame import choose_backdrop, place_frame
from g2ard.pipeline.distill import RunViews
from g2ard.rendering.targets import fill
from g2ard.report.labels import DENSE, RESULT, label_scenes, name_scenes
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats

if TYPE_CHECKING:
    from g2ard.jobs.distill_job import DistillJob
    from g2ard.jobs.teaching import RunTargets
    from g2ard.pipeline.distill import Distilled
    from g2ard.report.distilled import Drawn
    from g2ard.report.run import RunReport

_WORK_FOLDER = ".unfinished"
"""Folder in a run's folder for finished rounds and checkpoints."""

_PICTURE = "preview.png"
"""Name of a run's picture."""

_VIEW_FILES: dict[ViewFormat, str] = {
    "inria": "cameras.json",
    "nerfstudio": "transforms.json",
    "colmap": "colmap",
}
"""Names of generated views for other programs, beside views.json."""


_VIEW_DEFAULTS: tuple[ViewFormat | None, ...] = (None, "g2ard")


class RunFolder:
    """Folder of a run with one budget.

    Args:
        name: name of the scene's file in it.
    """

    def __init__(self, run: Run, path: Path, name: str, resume: bool) -> None:
        self._run = run
        self._resume = resume
        self.path = path
        self.scene = path / name
        self.unfinished = path / _WORK_FOLDER
        self._report = path / "report.json"  # written last
        # with --keep, for `evaluate --anchors`
        self._simplified = path / "simplified" / "scene.ply"
        self._view = path / "view.html"
        self._views = path / "views.json"
        self._scored = path / "scored.json"  # if some scored views are not in views.json
        self._inputs: Named = {}  # identity of each file that this run reads

    def check(self, budget: Budget | None) -> Named | None:
        """Return the report of a finished run if --resume finds one; raise an `OutputError` unless the run
        may write here."""
        self._run.spare_inputs(
            self.scene, *self._list_other_scenes(), self._simplified, self._views, self._scored
        )
        check_unlocked(self.path)
        left = has_checkpoints(self.unfinished)
        killed = self.path.is_dir() and [path.name for path in self.path.iterdir()] == [
            _WORK_FOLDER
        ]
        done = self._resume and not self._run.overwrite and not left
        done = done and self.scene.exists() and self._report.exists()
        if done:
            record = self._read_finished(budget)
            if not (lacking := self._find_lacking(record)):
                self._run.say(f"{self.path}: already finished; -w without --resume starts over")
                return record
            self._run.say(
                f"{self.path}: finished without {', '.join(lacking)}; the run is repeated"
            )
            self._run.overwrite = True
        if not left and not killed:
            check_output(self.path, self._run.overwrite, folder=True)
        if left or not self._resume:
            check_stopped(self._run, self.unfinished, self._resume, self.scene)
        return None

    def _read_finished(self, budget: Budget | None) -> Named:
        """Return the finished run's report; raise an `OutputError` if its budget, options or input files were
        others."""
        record = read_json(self._report)
        check_same(self._run, record, self.path, *_name_other_budget(record, budget))
        assert isinstance(record, dict)
        return record

    def _find_lacking(self, record: Mapping[str, Any]) -> list[str]:
        """Return the options of this command whose files a finished run lacks."""
        then = record.get("config", {})
        now = self._run.config
        asked = {
            "--keep": now["keep"] and not self._simplified.exists(),
            "--page": now["page"] and not then.get("page", True),
            "--views-format": now["views_format"]
            not in (*_VIEW_DEFAULTS, then.get("views_format")),
        }
        return [name for name, lacks in asked.items() if lacks]

    @contextmanager
    def hold(self, job: DistillJob) -> Iterator[None]:
        """Create the folder, where no other run may write meanwhile; an empty folder is removed.

        It holds checkpoints too, which are kept after an error or Ctrl-C.
        """
        self._inputs = identify_files([*self._run.input_files(), *job.photos])
        made = [] if self.path.exists() else [self.path]
        self.path.mkdir(parents=True, exist_ok=True)
        try:
            with locked(self.path):
                if self.scene.exists() and not (
                    self._run.overwrite or has_checkpoints(self.unfinished)
                ):
                    raise OutputError("exists", path=self.path, hint="{overwrite=True} replaces it")
                drop_temporaries(self.path)
                with self._hold_checkpoints(job):
                    yield
        finally:
            drop_empty(made)

    @contextmanager
    def _hold_checkpoints(self, job: DistillJob) -> Iterator[None]:
        """Create the folder for checkpoints; after an error or Ctrl-C, keep what it holds."""
        # a run in tiles continues from their files
        if self._resume and job.plan is None and not has_checkpoints(self.unfinished):
            self._run.say(f"{self.path}: nothing to resume, starting over")
        with keep_checkpoints(
            self._run, self.unfinished, self._resume, self.path, f"in {self.path}"
        ):
            self.unfinished.mkdir(parents=True, exist_ok=True)
            counts = {"input_count": job.total, "output_count": job.budget.count}
            text = json.dumps({**counts, "config": self._run.config}, default=str)
            (self.unfinished / OPTIONS).write_text(text, encoding="utf-8", newline="\n")
            yield

    def write(self, done: Distilled, views: RunViews, targets: RunTargets) -> None:
        """Write the scene, with --keep the simplified one, and the views with their splits.

        An earlier run's scenes and the pages about them are removed. Generated views are also written in the
        format of --views-format, and all scored views if some of `targets` are of other kinds.
        """
        run = self._run
        if self.unfinished.is_dir():
            # from now on, --resume may replace this run's files
            (self.unfinished / "written").touch()
        run.write(self.scene, done.splats, overwrite=True, compare=False)
        pages = (self.path / name for name in ("report.json", "report.html", _PICTURE, "view.html"))
        for other in (*self._list_other_scenes(), *pages):
            other.unlink(missing_ok=True)
        if run.config["keep"]:
            self._simplified.parent.mkdir(exist_ok=True)
            run.write(self._simplified, done.simplified, overwrite=True)
        else:
            self._simplified.unlink(missing_ok=True)
        own = views.pool or views.train
        if "test" not in own.splits:
            splits = ("train",) * len(own.cameras) + ("test",) * len(views.test)
            own = ViewSet(_join_views(own.cameras, views.test), splits=splits)
        write_views(self._views, own.cameras, splits=own.splits, overwrite=True)
        also: ViewFormat = run.config["views_format"]
        if views.pool is not None and also in _VIEW_FILES:
            run.write_views(
                self.path / _VIEW_FILES[also], own.cameras, also, own.splits, overwrite=True
            )
        if targets.apart is None:
            self._scored.unlink(missing_ok=True)
            return
        scored = _join_views(targets.apart.cameras, targets.held_out.cameras)
        write_views(self._scored, scored, splits=["test"] * len(scored), overwrite=True)

    def write_pages(
        self,
        source: Source | Path,
        job: DistillJob,
        done: Distilled,
        report: RunReport,
        drawn: Drawn,
    ) -> tuple[RunReport, str]:
        """Write preview.png, with --page view.html, and report.html; return the report with the size of that
        page, and a line about it.

        Args:
            source: what was distilled.
            drawn: the views to show, and pictures of them.
        """
        from g2ard.report.distilled import (
            create_renderers,
            draw_pictures,
            write_distill_report,
            write_preview,
        )

        title = f"{name_scenes([Path(str(source))])[0]}: {report.title}"
        # a start of photos is a blur
        scenes = [] if report.photos else [("simplified", done.simplified)]
        scenes.append((RESULT, done.splats))
        recover = job.config.recover
        page = self.path / "report.html"
        renderers = create_renderers(scenes, recover.background)
        best = drawn.best
        shown = []
        with self._run.showing(_PICTURE):
            fill(best, self._run.progress)
            on_white = None
            if job.renders and self._choose_backdrop(recover.background, job.prior) is None:
                on_white = partial(job.dense.images, background=WHITE)
            rows = range(len(best.cameras))
            shown = [draw_pictures(best, row, renderers, on_white, drawn) for row in rows]
            write_preview(self.path / _PICTURE, shown, scenes)
        line = ""
        if self._run.config["page"]:
            dense = None
            config = self._run.config
            of_points = isinstance(source, Source) and source.kind == "points"
            alone = not config["compare"] or str(config["fit"]).startswith("page:")
            if (
                not alone
                and isinstance(source, Source)
                and not recover.from_points
                and job.plan is None
            ):
                dense = source, job.prior
            seen = job.views.train.cameras if job.views.pool is None else best.cameras
            size = None
            with self._run.showing("view.html"):
                size, line = self.write_view(
                    done.splats, dense, seen, recover.background, of_points
                )
            report = replace(report, bytes={**report.bytes, "view": size})
        with self._run.showing("report.html"):
            files = {
                self.scene.name: self.scene.name,
                "view in the browser": self._view.name,
                "folder": ".",
            }
            files = {text: name for text, name in files.items() if (self.path / name).exists()}
            command = shlex.join(["g2ard", *sys.argv[1:]])
            more: Any = {"best": shown[0], "on_white": on_white, "command": command, "files": files}
            write_distill_report(page, title, renderers, drawn, report, **more)
        return report, line

    def write_report(self, report: Report) -> None:
        told = {**report.as_dict(), "config": self._run.config, "inputs": self._inputs}
        with (
            self._run.finishing("report.json"),
            atomic_output(self._report, overwrite=True) as temporary,
        ):
            text = json.dumps(told, indent=2, default=plain)
            temporary.write_text(text + "\n", encoding="utf-8", newline="\n")

    def write_view(
        self,
        splats: Splats,
        dense: tuple[Source, Splats] | None,
        cameras: Cameras,
        background: Colour,
        of_points: bool = False,
    ) -> tuple[int | None, str]:
        """Write view.html unless browsers would not draw the scene smoothly; return its bytes, None if it was
        not written, and a line to print.

        Args:
            dense: file of the dense scene and the scene, shown left of the result unless it would make the
                page large.
            of_points: whether that scene is a point cloud.
        """
        count = len(splats)
        most = DEVICES["web"]
        if count > most:
            return (
                None,
                f"{self._view} skipped: over {most:,} Gaussians (`g2ard view` writes it anyway)",
            )
        stand = place_frame(splats, cameras)
        behind = self._choose_backdrop(background, splats if dense is None else dense[1], of_points)
        shown: list[Source | str] = [name_scenes([self.path])[0]]
        scenes = [splats]
        roles = [RESULT]
        if dense is not None and count < len(dense[1]) <= LARGEST_DENSE:
            shown = [dense[0], *shown]
            scenes = [dense[1], splats]
            roles = [DENSE, RESULT]
        labels = label_scenes(shown, [len(scene) for scene in scenes], roles)
        written, _ = stand.write_page(self._view, labels, scenes, background=behind, overwrite=True)
        return written, f"view: {self._view} ({written / 1e6:.2f} MB)"

    @staticmethod
    def _choose_backdrop(
        background: Colour, scene: Splats, of_points: bool = False
    ) -> Colour | None:
        """Return what is behind a scene in pictures and on pages, see `choose_backdrop`."""
        return choose_backdrop(
            None if background == BLACK else background, [scene], of_points=of_points
        )

    def say_files(self, page: str = "") -> None:
        """Name the files, and record that the run is finished."""
        picture = self.path / _PICTURE
        scene = f"scene: {self.scene} ({self.scene.stat().st_size / 1e6:.2f} MB)"
        shown = f"picture: {picture}" if picture.exists() else ""
        reports = [path for path in (self.path / "report.html", self._report) if path.exists()]
        report = f"report: {', '.join(map(str, reports))}"
        self._run.say("\n".join(filter(None, (scene, shown, report, page))))
        self._run.kept.append(f"{self.path} is finished")

    def _list_other_scenes(self) -> list[Path]:
        """Return the scene's file names in other formats."""
        names = (self.path / f"scene{suffix}" for suffix in SUFFIXES)
        return [path for path in names if path != self.scene]


def _join_views(cameras: Cameras, held_out: Cameras) -> Cameras:
    """Combine views, and mark names of held-out ones that other views have too."""
    taken = set(cameras.names)
    named = (
        replace(view, name=f"{view.name} (held out)") if view.name in taken else view
        for view in held_out
    )
    return Cameras.of([*cameras, *named])


def describe_stopped_run(folder: Path) -> Named | None:
    """Describe an interrupted run (checkpoints, counts, options), or return None without one."""
    work = folder / _WORK_FOLDER
    if not has_checkpoints(work):
        return None
    told = read_json(work / OPTIONS) if (work / OPTIONS).exists() else {}
    return {"path": str(folder), "kind": "stopped run", "kept": list_finished_steps(work), **told}


def _name_other_budget(before: Mapping[str, Any], budget: Budget | None) -> list[str]:
    """Return the name of the budget if an earlier run's was another one."""
    if budget is None or budget.is_measured or "output_count" not in before:  # options are compared
        return []
    with suppress(InputError):
        if budget.of(before["input_count"]) == before["output_count"]:
            return []
    return ["budget"]
