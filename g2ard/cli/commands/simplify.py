"""`g2ard simplify`: fewer Gaussians at an exact budget."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from g2ard import io
from g2ard.cli import options as opt
from g2ard.cli.frame import Run, command
from g2ard.cli.outputs import Outputs, budgets_of
from g2ard.cli.run_result import say_fit, say_weight, tell_quality
from g2ard.cli.tiling import tiling_of, working
from g2ard.config.choices import is_made
from g2ard.config.schema import listed
from g2ard.io.atomic import atomic_output
from g2ard.io.scene_formats import written_bytes
from g2ard.progress import plural
from g2ard.system.peak_memory import peak_rss

if TYPE_CHECKING:
    from g2ard.io.types import Scene
    from g2ard.jobs.budget import Budget
    from g2ard.jobs.tiling import Tiling
    from g2ard.stages.simplify import Simplified, SimplifyConfig


@command(
    "simplify",
    example="g2ard simplify garden.ply -r 10 -o garden_10x.ply",
    settings="g2ard.stages.simplify:SimplifyConfig",
    fields=("simplify.method", "simplify.keep_region"),
    scenes=True,
    budgets=True,
    tiles=True,
    outputs=("output", "parents"),
)
def simplify(
    run: Run,
    *,
    scene: opt.SceneArgument,
    views: opt.ViewsOrMadeOption = None,
    images: opt.ImagesOption = None,
    no_views: Annotated[
        bool, typer.Option("--no-views", help="Use no cameras, neither found nor generated.")
    ] = False,
    preset: opt.PaperOption = None,
    up: opt.UpOption = None,
    output: opt.OutputOption,
    parents: Annotated[
        Path | None,
        typer.Option(metavar="FILE.npy", help="Also write each Gaussian's row in the result, or -1."),
    ] = None,
) -> None:
    """Reduce a scene to an exact number of Gaussians; no images needed.

    The default method weighs errors by visibility. It uses --views, or cameras found beside the scene, or
    generated views. The fast method uses views only if --views is given; the paper's method uses none.
    Scenes larger than memory and folders of tiles are simplified tile by tile to the same exact budget.
    """
    from g2ard.jobs.cost import WHOLE_TIMES, check_whole_memory
    from g2ard.jobs.inputs import say_notes
    from g2ard.jobs.measured_budget import Reduction, resolved
    from g2ard.jobs.tiling import is_tiled, needs_whole, refuse_whole
    from g2ard.stages.simplify import SimplifyConfig

    config = run.settled(SimplifyConfig(), preset)[1]
    budgets = budgets_of(run)
    if views is not None and no_views:
        raise typer.BadParameter("--views and --no-views exclude each other; give one")
    if run.config["keep_region"] and no_views:
        raise typer.BadParameter("--keep-region needs views; remove --no-views")
    if config.method == "paper":
        run.refuse_typed("on the method paper", "views", "images")
    given_views = views is not None and not is_made(views)
    if given_views or no_views or config.method == "paper" or (config.method == "fast" and views is None):
        run.refuse_typed("without generated views", "up")
    tiling = tiling_of(run, scene, output)
    outputs = Outputs(output, budgets, run.claim_scene)
    outputs.check()
    given = opt.with_images(views, images)
    if is_tiled(scene, tiling):
        refuse_whole(scene, needs_whole(config, preset, budgets, parents=parents))
        _in_tiles(run, scene, tiling, outputs, budgets, config, views=given, blind=no_views, up=up)
        return
    say_fit(run, scene, budgets[0], output.name)
    check_whole_memory(scene, tiling, WHOLE_TIMES)
    maps = None if parents is None else Outputs(parents, budgets, run.claim_file, name="--parents")
    if maps is not None:
        maps.check()
    seen = [("read", 0.2), ("poses", 1.0), ("visibility", 2.0)]  # seconds for playbot
    run.console.expect([*seen, *[("simplify", 1.2), ("visibility", 0.5), ("write", 0.1)] * len(budgets)])
    began = time.perf_counter()
    run.begin("read")
    found = io.read_scene(scene, render_model=run.render_model)
    say_notes(scene, found.notes, run.say)
    splats, total = found.splats, len(found.splats)
    for named in filter(None, (outputs, maps)):
        named.check(total)
    started = time.perf_counter()
    reading = started - began  # shared by all budgets
    common: dict[str, Any] = {"seed": run.seed, "progress": run.progress, "say": run.say}
    reduce = Reduction(splats, views=given, blind=no_views, config=config, beside=scene, up=up, **common)
    wanted = [resolved(budget, reduce, str(scene), output.name) for budget in budgets]
    reports = []
    rows = maps.paths(total) if maps else [None] * len(wanted)
    for one, place, parents in zip(wanted, outputs.paths(total), rows, strict=True):
        small = reduce(one.count)
        simplified = time.perf_counter()
        run.write(place, small.splats)
        if parents is not None:
            with run.finishing("--parents"):
                _write_parents(run, parents, small)
        written = time.perf_counter()
        seconds = {"read": reading, "simplify": simplified - started, "write": written - simplified}
        seconds["total"] = sum(seconds.values())
        started = written
        reports.append(_report(found, small, config, seconds))
        _tell(run, scene, small, place, seconds["total"])
        if one.bytes is not None:
            run.say(f"{place}: {written_bytes(place):,} of {one.bytes:,} bytes")
    run.results(reports)
    tell_quality(run, wanted[0], small.splats)


def _in_tiles(
    run: Run,
    scene: Path,
    tiling: Tiling,
    outputs: Outputs,
    budgets: Sequence[Budget],
    config: SimplifyConfig,
    *,
    views: Any,
    **options: Any,
) -> None:
    """Simplify tile by tile; finished steps stay in the work folder until it succeeds, or longer if named."""
    from g2ard.jobs.tiled import simplify_in_tiles
    from g2ard.stages.simplify.growth import say_gaps
    from g2ard.system.peak_memory import peak_rss_of_all

    began, reports = time.perf_counter(), []
    with working(run, tiling, views):
        made = simplify_in_tiles(
            scene,
            budgets,
            tiling,
            views=views,
            config=config,
            seed=run.seed,
            render_model=run.render_model,
            counted=outputs.check,
            **options,
            **run.callbacks,
        )
        for at, (store, small) in enumerate(made):
            place = outputs.paths(store.count)[at]
            run.write(place, small, compare=True)
            seconds = time.perf_counter() - began
            merging = config.turned("default").resolved(antialiased=small.render_model == "antialiased")
            reports.append(
                {
                    "input_count": store.count,
                    "output_count": len(small),
                    "tiles": list(small.counts),
                    "notes": {note.code: note.count for note in store.notes},
                    "seconds": {"total": seconds},
                    "peak_rss_bytes": peak_rss_of_all(),
                    "views": small.views,
                    "unseen": small.unseen,
                    "growth": small.growth,
                    "opacity_lost": small.opacity_lost,
                    "method": "default",
                    "settings": listed(merging),
                }
            )
            say_gaps(small.opacity_lost, run.say)
            run.say(f"{place}: {len(small):,} of {store.count:,} Gaussians in {seconds:.1f} s")
    run.results(reports)


def _report(
    found: Scene, small: Simplified, config: SimplifyConfig, seconds: dict[str, float]
) -> dict[str, Any]:
    config = config.resolved(antialiased=small.splats.antialiased)
    return {
        **small.report.as_dict(),
        "method": config.method,
        "settings": listed(config),
        "notes": {note.code: note.count for note in found.notes},
        "seconds": seconds,
        "peak_rss_bytes": peak_rss(),
    }


def _write_parents(run: Run, path: Path, small: Simplified) -> None:
    """Write the parents, (N,) int64 in the scene's row order."""
    import numpy as np

    with atomic_output(path, overwrite=run.overwrite) as temporary, temporary.open("wb") as file:
        np.save(file, small.parents)


def _tell(run: Run, scene: Path, small: Simplified, output: Path, seconds: float) -> None:
    from g2ard.stages.simplify.growth import say_gaps

    if run.verbose:
        _table(run, small)
    total = small.report.input_count
    share = (small.report.unseen or 0) / total
    if share >= 0.02:
        run.say(f"note: no view sees {share:.0%} of the Gaussians; they are weighted by size only")
    say_gaps(small.report.opacity_lost, run.say)
    say_weight(run, scene, output, small.splats)
    run.say(f"{output}: {len(small.splats):,} of {plural(total, 'Gaussian')} in {seconds:.1f} s")


def _table(run: Run, small: Simplified) -> None:
    columns = ["round", "before", "dropped", "merged", "refused", "trimmed", "after"]
    rows = []
    for number, r in enumerate(small.report.rounds, start=1):
        refused = sum((r.refused or {}).values())
        counts = (r.before, r.dropped, r.merged, refused, r.trimmed, r.after)
        rows.append([str(number), *(f"{count:,}" for count in counts)])
    run.console.table("Rounds", columns, rows)
