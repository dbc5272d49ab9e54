"""`simplify` and `distill` on scenes in tiles: outputs, reports and messages."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from g2ard.cli.frame import Run
from g2ard.cli.outputs import Outputs
from g2ard.cli.run_folder import RunFolder
from g2ard.cli.run_result import loss
from g2ard.config.schema import listed
from g2ard.io.tile_store import TileStore
from g2ard.jobs import tiled
from g2ard.jobs.budget import Budget
from g2ard.jobs.distill_options import DistillOptions
from g2ard.jobs.tiling import Tiling
from g2ard.progress import plural
from g2ard.report.distilled import tiled_report
from g2ard.report.kinds import COLUMNS, cells
from g2ard.stages.simplify import SimplifyConfig
from g2ard.stages.simplify.growth import say_gaps
from g2ard.system.peak_memory import peak_rss_of_all
from g2ard.tiles.merging import TiledScene


def simplify_in_tiles(
    run: Run,
    scene: Path,
    tiling: Tiling,
    outputs: Outputs,
    budgets: Sequence[Budget],
    config: SimplifyConfig,
    views: Any,
    blind: bool,
    up: Sequence[float] | None,
) -> None:
    """Run `g2ard simplify`; finished steps stay in the work folder until it succeeds, or longer if named."""
    began, reports = time.perf_counter(), []
    run.unfinished = f"finished steps are in {tiling.folder}; run the same command to continue"
    with tiled.working(tiling, views):
        made = tiled.simplify_in_tiles(
            scene,
            budgets,
            tiling,
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
            run.write(place, small, compare=True)
            antialiased = small.render_model == "antialiased"
            report = {
                **_report(store, small, began),
                "views": small.views,
                "unseen": small.unseen,
                "growth": small.growth,
                "opacity_lost": small.opacity_lost,
                "method": "default",
                "settings": listed(config.turned("default").resolved(antialiased=antialiased)),
            }
            say_gaps(small.opacity_lost, run.say)
            seconds = report["seconds"]["total"]
            run.say(f"{place}: {len(small):,} of {store.count:,} Gaussians in {seconds:.1f} s")
            reports.append(report)
    run.results(reports)


def distill_in_tiles(
    run: Run, scene: Path, tiling: Tiling, budget: Budget, options: DistillOptions, folder: RunFolder
) -> None:
    """Run `g2ard distill`: write the scene, its views and the report into the run's folder."""
    began = time.perf_counter()
    again = "run the same command with --resume to continue"
    run.unfinished = f"finished steps are in {tiling.folder}; {again}"
    with tiled.working(tiling, options.views, options.held_out):
        done = tiled.distill_in_tiles(scene, budget, tiling, options, **run.callbacks)
        store, small, scores = done.store, done.recovered, done.scores
        with folder.writing():
            report = {
                **_report(store, small, began),
                "scores": scores,
                "size": done.views.test.size_text,
                "views": {"train": len(done.views.train.cameras), "test": len(done.views.test)},
            }
            folder.write_scene(small, compare=True)
            folder.write_simplified(done.simplified if run.config["keep"] else None)
            folder.write_views(done.views)
            title = f"{scene.name}: {store.count:,} → {len(small):,}"
            with run.finishing("report.html"):
                tiled_report(folder.path / "report.html", title, report)
            folder.write_report(report)
    title = f"held-out views against teacher renders, {done.views.test.size_text}, simplified → recovered:"
    run.console.table(title, list(COLUMNS), cells(scores.kinds))
    for line in filter(None, map(loss, scores.kinds)):
        run.say(line)
    run.say(
        f"{folder.path}: {len(small):,} of {store.count:,} Gaussians; over all pixels "
        f"{scores.simplified:.2f} → {scores.recovered:.2f} dB; "
        f"{plural(scores.steps, 'step')} in all tiles together\n"
        f"scene: {folder.scene} ({folder.scene.stat().st_size / 1e6:.2f} MB)\n"
        f"report: {folder.path / 'report.html'}, {folder.path / 'report.json'}"
    )
    run.kept.append(f"{folder.path} is finished")
    run.result(report)


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
