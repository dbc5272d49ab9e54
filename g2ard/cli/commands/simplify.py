"""`g2ard simplify`: fewer Gaussians at an exact budget."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from g2ard.cli import options as opt
from g2ard.cli.command import command
from g2ard.cli.outputs import Outputs, read_budgets
from g2ard.cli.run import Run
from g2ard.cli.run_result import count_tiles, describe_memory, say_fit, say_weight, tell_quality
from g2ard.cli.work_folder import read_tiling, work_folder
from g2ard.config.choices import is_given
from g2ard.config.schema import listed
from g2ard.io import Source
from g2ard.io.atomic import atomic_output
from g2ard.io.scene_formats import written_bytes
from g2ard.progress import plural
from g2ard.report.labels import count_content
from g2ard.system.peak_memory import peak_rss_of_all

if TYPE_CHECKING:
    from g2ard.jobs.simplify import Reduction
    from g2ard.pipeline.dense import Merged


@command(
    "simplify",
    example="g2ard simplify garden.ply -r 10 -o garden_10x.ply",
    settings="g2ard.stages.simplify:SimplifyConfig",
    fields=("simplify.method", "simplify.keep_region"),
    scenes=True,
    budgets=True,
    several=True,
    tiles=True,
    points=True,
    outputs=("output", "parents"),
)
def simplify(
    run: Run,
    *,
    scene: opt.SceneArgument,
    others: opt.OthersArgument = None,
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
        typer.Option(
            metavar="FILE.npy", help="Also write each Gaussian's row in the result, or -1."
        ),
    ] = None,
    dry_run: opt.DryRunOption = False,
) -> None:
    """Reduce a scene to an exact number of Gaussians; no images needed.

    The default method weighs errors by visibility. It uses --views, or cameras found beside the scene, or
    generated views. The fast method uses views only if --views is given; the paper's method uses none.
    A coloured point cloud is lifted first, as by `g2ard lift`.
    Scenes larger than memory and folders of tiles are simplified tile by tile to the same exact budget.
    """
    import numpy as np

    from g2ard.jobs.inputs import GivenViews
    from g2ard.jobs.memory import check_whole_memory
    from g2ard.jobs.simplify import open_reduction, read_parents
    from g2ard.jobs.tile_options import is_tiled
    from g2ard.stages.simplify import SimplifyConfig

    config = run.settle(SimplifyConfig(), preset)[1]
    budgets = read_budgets(run)
    if views is not None and no_views:
        raise typer.BadParameter("--views and --no-views exclude each other; give one")
    if run.config["keep_region"] and no_views:
        raise typer.BadParameter("--keep-region needs views; remove --no-views")
    if config.method == "paper":
        run.refuse_typed("on the method paper", "views", "images")
    given_views = is_given(views)
    if (
        given_views
        or no_views
        or config.method == "paper"
        or (config.method == "fast" and views is None)
    ):
        run.refuse_typed("without generated views", "up")
    source = Source(scene, run.render_model, others or ())
    opt.choose_points(run, source)
    tiling = read_tiling(run, source, output)
    given = opt.with_images(views, images)
    name = "scene.ply" if output == opt.UNWRITTEN else output.name
    outputs = None if dry_run else Outputs(output, budgets, run.claim_scene)
    if outputs is not None:
        outputs.check()
    how = tiling if is_tiled(source, tiling) else None
    maps = None
    if parents is not None and how is not None and source.kind == "points":
        raise typer.BadParameter(
            f"--parents: points become rows when tiles are written; run `g2ard ingest {scene} -o DIR`, "
            "then simplify DIR"
        )
    if parents is not None and not dry_run:
        maps = Outputs(parents, budgets, run.claim_file, name="--parents")
    if how is None:
        say_fit(run, scene, budgets[0], name)
        if source.kind != "points":
            check_whole_memory(source, tiling)
    named = list(filter(None, (outputs, maps)))
    for each in named:
        each.check()

    def counted(total: int) -> None:
        for each in named:
            each.check(total)

    began = time.perf_counter()
    reports = []
    opening = open_reduction(
        source,
        how,
        budgets=budgets,
        counted=counted,
        given=GivenViews(given, None, up, run.seed, rough=dry_run, **run.callbacks),
        blind=no_views,
        config=config,
    )
    with work_folder(run, None if dry_run else how, given), opening as reduce:
        reading = (started := time.perf_counter()) - began  # shared by all budgets
        wanted = [reduce.resolve(budget, str(scene), name) for budget in budgets]
        if outputs is None:
            _tell_plan(run, reduce, [one.count for one in wanted])
            return
        rows = maps.paths(reduce.total) if maps else [None] * len(wanted)
        for one, place, parents in zip(wanted, outputs.paths(reduce.total), rows, strict=True):
            small = reduce(one.count)
            simplified = time.perf_counter()
            run.write(place, small.splats, compare=how is not None)
            if parents is not None:
                with (
                    run.finishing("--parents"),
                    atomic_output(parents, overwrite=run.overwrite) as temporary,
                    temporary.open("wb") as file,
                ):
                    np.save(file, read_parents(small, source))
            written = time.perf_counter()
            seconds = {
                "read": reading,
                "simplify": simplified - started,
                "write": written - simplified,
            }
            seconds["total"] = sum(seconds.values())
            started = written
            warnings = reduce.warnings(small.splats)
            reports.append(
                {
                    **small.report.as_dict(),
                    "warnings": warnings,
                    "method": config.method,
                    "settings": listed(config.resolved(antialiased=reduce.splats.antialiased)),
                    "notes": {note.code: note.count for note in reduce.notes},
                    "seconds": seconds,
                    "peak_rss_bytes": peak_rss_of_all(),
                }
            )
            for warning in warnings:
                run.say(warning)
            _tell_result(run, source, reduce, small, place, seconds["total"])
            if one.bytes is not None:
                run.say(f"{place}: {written_bytes(place):,} of {one.bytes:,} bytes")
        run.results(reports)
        tell_quality(run, wanted[0], small.splats)  # reads files of tiles


def _tell_plan(run: Run, reduce: Reduction, counts: Sequence[int]) -> None:
    """Print the counts, and the rough memory of each."""
    from g2ard.jobs.cost import cost_of_reduction

    plans = []
    for count in counts:
        cost = cost_of_reduction(reduce, count)
        views = plural(cost.views, "view")
        run.answer(
            f"{plural(count, 'Gaussian')}, weighed in {views}: roughly {describe_memory(cost)}"
        )
        told = {"count": count, "views": cost.views, "bytes": cost.bytes}
        plans.append({**told, **count_tiles(reduce.plan)})
    run.say_dry()
    run.results(plans)


def _tell_result(
    run: Run, source: Source, reduce: Reduction, small: Merged, output: Path, seconds: float
) -> None:
    from g2ard.stages.simplify.gaps import say_gaps

    if run.verbose and small.report.rounds:
        _print_rounds(run, small)
    share = (small.report.unseen or 0) / reduce.total
    if share >= 0.02:
        run.say(f"note: no view sees {share:.0%} of the Gaussians; they are weighted by size only")
    say_gaps(small.report.opacity_lost, run.say)
    say_weight(run, source.path, output, reduce.splats)  # a sample has as much SH
    run.say(
        f"{output}: {len(small.splats):,} of {count_content(reduce.total, source)} in {seconds:.1f} s"
    )


def _print_rounds(run: Run, small: Merged) -> None:
    columns = ["round", "before", "dropped", "merged", "refused", "trimmed", "after"]
    rows = []
    for number, r in enumerate(small.report.rounds, start=1):
        refused = sum((r.refused or {}).values())
        counts = (r.before, r.dropped, r.merged, refused, r.trimmed, r.after)
        rows.append([str(number), *(f"{count:,}" for count in counts)])
    run.console.table("Rounds", columns, rows)
