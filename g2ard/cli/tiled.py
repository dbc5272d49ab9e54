"""`simplify` and `distill` on scenes in tiles: outputs, reports and messages."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from g2ard.cli.frame import Run
from g2ard.cli.outputs import Outputs
from g2ard.cli.run_folder import is_done, tell_finished, write_pool, write_report
from g2ard.cli.run_result import loss
from g2ard.config.paths import listed
from g2ard.io.scene_formats import scene_format
from g2ard.progress import plural
from g2ard.system.memory import peak_rss_of_all

if TYPE_CHECKING:
    from g2ard.jobs.budget import Budget
    from g2ard.jobs.distill_options import DistillOptions
    from g2ard.jobs.tiling import Tiling
    from g2ard.stages.simplify import SimplifyConfig
    from g2ard.tiles.merging import TiledScene
    from g2ard.tiles.store import TileStore


_HINT = "the simplified scene is better there (`g2ard simplify` writes it)"


class TiledCommand:
    """A command on one scene.

    Finished steps stay in the work folder until the command succeeds, or longer if the user named it.
    """

    def __init__(
        self, run: Run, scene: Path, outputs: Outputs, tiling: Tiling, budgets: Sequence[Budget]
    ) -> None:
        self.run, self.scene, self.outputs, self.tiling, self.budgets = run, scene, outputs, tiling, budgets
        run.kept = [f"finished steps are in {tiling.folder}; run the same command to continue"]

    def simplify(self, config: SimplifyConfig, views: Any, blind: bool, up: Sequence[float] | None) -> None:
        """Run `g2ard simplify`."""
        from g2ard.jobs.tiled import simplify_in_tiles, working

        run, began, reports = self.run, time.perf_counter(), []
        with working(self.tiling, views):
            made = simplify_in_tiles(
                self.scene,
                self.budgets,
                self.tiling,
                views=views,
                blind=blind,
                config=config,
                up=up,
                seed=run.seed,
                render_model=run.render_model,
                progress=run.progress,
                say=run.say,
            )
            for at, (store, small) in enumerate(made):
                place = self.outputs.paths(store.count)[at]
                self._write(place, small)
                report = {
                    **_report(store, small, began),
                    "views": small.views,
                    "unseen": small.unseen,
                    "method": "default",
                    "settings": listed(
                        config.resolved("default", antialiased=small.render_model == "antialiased")
                    ),
                }
                seconds = report["seconds"]["total"]
                run.say(f"{place}: {len(small):,} of {store.count:,} Gaussians in {seconds:.1f} s")
                run.kept.append(f"{place} is written")
                reports.append(report)
        run.result(reports[0] if len(reports) == 1 else {"runs": reports})

    def distill(self, options: DistillOptions, name: str, resume: bool) -> None:
        """Run `g2ard distill`: write the scene, its views and the report into each run's folder.

        With `resume`, finished budgets are skipped.
        """
        from g2ard.jobs.tiled import distill_in_tiles, working
        from g2ard.jobs.tiling import refuse_whole, whole_budgets, whole_options
        from g2ard.report.distilled import tiled_report
        from g2ard.report.kinds import COLUMNS, cells

        run, began = self.run, time.perf_counter()
        with working(self.tiling, options.views, options.held_out):
            own = [name for name in ("dry_run", "keep") if run.config[name]]
            given = [*whole_options(options), *whole_budgets(self.budgets)]
            refuse_whole(self.scene, given + [f"--{name.replace('_', '-')}" for name in own])
            run.kept = [
                f"finished steps are in {self.tiling.folder}; run the same command with --resume to continue"
            ]
            places = [folder / name for folder in self.outputs.paths()]
            finished = [at for at, place in enumerate(places) if is_done(run, place, resume)]
            reports = {at: tell_finished(run, places[at]) for at in finished}
            left = [at for at in range(len(self.budgets)) if at not in reports]
            made = distill_in_tiles(
                self.scene,
                [self.budgets[at] for at in left],
                self.tiling,
                options,
                progress=run.progress,
                say=run.say,
            )
            for at, (store, small, scores, views) in zip(left, made, strict=True):
                folder = self.outputs.paths(store.count)[at]
                report = {
                    **_report(store, small, began),
                    "scores": asdict(scores),
                    "views": {"train": len(views.train.cameras), "test": len(views.test)},
                    "config": run.config,
                }
                if (pool := views.pool) is not None:
                    write_pool(run, folder, pool)
                self._write(folder / name, small)
                title = f"{self.scene.name}: {store.count:,} → {len(small):,}"
                tiled_report(folder / "report.html", title, report)
                write_report(folder, report)
                title = "held-out views against teacher renders, simplified → recovered:"
                run.console.table(title, list(COLUMNS), cells(scores.kinds))
                for line in filter(None, (loss(kind, _HINT) for kind in scores.kinds)):
                    run.say(line)
                run.say(
                    f"{folder}: {len(small):,} of {store.count:,} Gaussians; over all pixels "
                    f"{scores.simplified:.2f} → {scores.recovered:.2f} dB; "
                    f"{plural(scores.steps, 'step')} in all tiles together"
                )
                run.kept.append(f"{folder} is finished")
                reports[at] = report
        run.result(reports[0] if len(reports) == 1 else {"runs": [reports[at] for at in sorted(reports)]})

    def _write(self, place: Path, small: TiledScene) -> None:
        from g2ard.io.ply import write_parts

        if scene_format(place).suffix == ".ply":
            parts = small, len(small), small.sh_degree, small.offset
            model = small.render_model
            write_parts(place, *parts, render_model=model, overwrite=self.run.overwrite)
        else:
            self.run.write(place, small.whole(), compare=True)


def _report(store: TileStore, small: TiledScene, began: float) -> dict[str, Any]:
    """Return the numbers that both commands report."""
    return {
        "input_count": store.count,
        "output_count": len(small),
        "tiles": list(small.counts),
        "notes": {note.code: note.count for note in store.notes},
        "seconds": {"total": time.perf_counter() - began},
        "peak_rss_bytes": peak_rss_of_all(),
    }
