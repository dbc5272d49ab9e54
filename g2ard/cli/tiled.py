"""`simplify` and `distill` on scenes in tiles: outputs, reports and messages."""

import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from g2ard.cli.frame import Run
from g2ard.cli.outputs import Outputs
from g2ard.cli.run_folder import RunFolder
from g2ard.cli.run_result import loss
from g2ard.config.schema import listed
from g2ard.io import ply
from g2ard.io.scene_formats import scene_format
from g2ard.io.tile_store import TileStore
from g2ard.jobs.budget import Budget
from g2ard.jobs.distill_options import DistillOptions
from g2ard.jobs.tiled import distill_in_tiles, simplify_in_tiles, working
from g2ard.jobs.tiling import Tiling, refuse_whole, whole_budgets, whole_options
from g2ard.pipeline.run_views import RunViews
from g2ard.progress import plural
from g2ard.report.distilled import tiled_report
from g2ard.report.kinds import COLUMNS, cells
from g2ard.stages.simplify import SimplifyConfig
from g2ard.stages.simplify.growth import say_gaps
from g2ard.system.peak_memory import peak_rss_of_all
from g2ard.tiles.merging import TiledScene
from g2ard.tiles.recover import TiledScores

_HINT = "the simplified scene is better there (`g2ard simplify` writes it)"


class TiledCommand:
    """A command on one scene.

    Finished steps stay in the work folder until the command succeeds, or longer if the user named it.
    """

    def __init__(self, run: Run, scene: Path, tiling: Tiling) -> None:
        self.run, self.scene, self.tiling = run, scene, tiling
        self.began = time.perf_counter()

    def simplify(
        self,
        outputs: Outputs,
        budgets: Sequence[Budget],
        config: SimplifyConfig,
        views: Any,
        blind: bool,
        up: Sequence[float] | None,
    ) -> None:
        """Run `g2ard simplify`."""
        run, reports = self.run, []
        run.unfinished = f"finished steps are in {self.tiling.folder}; run the same command to continue"
        with working(self.tiling, views):
            made = simplify_in_tiles(
                self.scene,
                budgets,
                self.tiling,
                views=views,
                blind=blind,
                config=config,
                up=up,
                seed=run.seed,
                render_model=run.render_model,
                counted=outputs.check,
                **run.callbacks,
            )
            for at, (store, small) in enumerate(made):
                place = outputs.paths(store.count)[at]
                self._write(place, small)
                antialiased = small.render_model == "antialiased"
                report = {
                    **self._report(store, small),
                    "views": small.views,
                    "unseen": small.unseen,
                    "growth": small.growth,
                    "opacity_lost": small.opacity_lost,
                    "method": "default",
                    "settings": listed(config.turned("default").resolved(antialiased=antialiased)),
                }
                seconds = report["seconds"]["total"]
                say_gaps(small.opacity_lost, run.say)
                run.say(f"{place}: {len(small):,} of {store.count:,} Gaussians in {seconds:.1f} s")
                reports.append(report)
        run.results(reports)

    def distill(self, budget: Budget, options: DistillOptions, folder: RunFolder) -> None:
        """Run `g2ard distill`: write the scene, its views and the report into the run's folder."""
        run = self.run
        with working(self.tiling, options.views, options.held_out):
            own = [f"--{name.replace('_', '-')}" for name in ("dry_run", "keep") if run.config[name]]
            refuse_whole(self.scene, [*whole_options(options), *whole_budgets([budget]), *own])
            again = "run the same command with --resume to continue"
            run.unfinished = f"finished steps are in {self.tiling.folder}; {again}"
            made = distill_in_tiles(self.scene, budget, self.tiling, options, **run.callbacks)
            report = self._write_run(folder, *made)
        run.result(report)

    def _write_run(
        self, folder: RunFolder, store: TileStore, small: TiledScene, scores: TiledScores, views: RunViews
    ) -> dict[str, Any]:
        """Write a run's folder, print its scores and return its report."""
        run = self.run
        report = {
            **self._report(store, small),
            "scores": asdict(scores),
            "views": {"train": len(views.train.cameras), "test": len(views.test)},
        }
        self._write(folder.scene, small)
        folder.write_views(views)
        title = f"{self.scene.name}: {store.count:,} → {len(small):,}"
        with run.finishing("report.html"):
            tiled_report(folder.path / "report.html", title, report)
        folder.write_report(report)
        title = "held-out views against teacher renders, simplified → recovered:"
        run.console.table(title, list(COLUMNS), cells(scores.kinds))
        for line in filter(None, (loss(kind, _HINT) for kind in scores.kinds)):
            run.say(line)
        run.say(
            f"{folder.path}: {len(small):,} of {store.count:,} Gaussians; over all pixels "
            f"{scores.simplified:.2f} → {scores.recovered:.2f} dB; "
            f"{plural(scores.steps, 'step')} in all tiles together\n"
            f"scene: {folder.scene} ({folder.scene.stat().st_size / 1e6:.2f} MB)\n"
            f"report: {folder.path / 'report.html'}, {folder.path / 'report.json'}"
        )
        run.kept.append(f"{folder.path} is finished")
        return report

    def _write(self, place: Path, small: TiledScene) -> None:
        if scene_format(place).suffix == ".ply":
            ply.write(place, small.stream(), overwrite=self.run.overwrite)
            self.run.kept.append(f"{place} is written")
        else:
            self.run.write(place, small.whole(), compare=True)

    def _report(self, store: TileStore, small: TiledScene) -> dict[str, Any]:
        """Return the numbers that both commands report."""
        return {
            "input_count": store.count,
            "output_count": len(small),
            "tiles": list(small.counts),
            "notes": {note.code: note.count for note in store.notes},
            "seconds": {"total": time.perf_counter() - self.began},
            "peak_rss_bytes": peak_rss_of_all(),
        }
