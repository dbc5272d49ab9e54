"""Summary of a `g2ard distill` run: table, warnings, views."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from g2ard.cli.run import Run
from g2ard.io.scene_formats import SUFFIXES, scene_format, written_bytes
from g2ard.progress import plural

if TYPE_CHECKING:
    from g2ard.cli.run_folder import RunFolder
    from g2ard.io.stream import PartsStream
    from g2ard.jobs.budget import Budget
    from g2ard.jobs.budget_search import ResolvedBudget
    from g2ard.jobs.cost import Cost
    from g2ard.jobs.distill_job import DistillJob
    from g2ard.jobs.memory import TilePlan
    from g2ard.pipeline.distill import Distilled
    from g2ard.report.run import RunReport, ViewsReport
    from g2ard.scene.splats import Splats


def tell_run(
    run: Run,
    source: Path,
    job: DistillJob,
    done: Distilled,
    report: RunReport,
    folder: RunFolder,
    page: str,
) -> None:
    """Print the summary of a run and write its result.

    Args:
        source: what was distilled.
        page: line about the page.
    """
    from g2ard.report.run import COLUMNS, describe_sizes, list_remarks, list_rows

    run.say(report.counts)
    title = f"held-out views against {report.against}, {describe_sizes(report)}, {report.stages}:"
    run.console.table(title, list(COLUMNS), list_rows(report))
    for line in list_remarks(report, verbose=run.verbose):
        run.say(line)
    say_views(run, report.views, job.config.select.views_count is not None)
    if not job.config.recover.from_points:  # such points are no scene to compare with
        lifted = job.prior if job.lifted and job.plan is None else None
        say_weight(run, source, folder.scene, done.splats, lifted=lifted)
    folder.say_files(page)
    run.result(report.as_dict())
    tell_quality(run, job.budget, done.splats)


def tell_plan(run: Run, count: int, cost: Cost, plan: TilePlan | None = None) -> None:
    """Print what a command would do that trains `count` Gaussians, and its rough memory."""
    run.answer(
        f"{plural(count, 'Gaussian')}, {plural(cost.views, 'target image')} of {cost.pixels:,} pixels, "
        f"{describe_steps(cost)}: roughly {describe_memory(cost)}"
    )
    run.say_dry()
    run.result({"count": count, **asdict(cost), **count_tiles(plan)})


def describe_steps(cost: Cost) -> str:
    """Describe the steps of a job, which a time limit leaves open."""
    return "as many steps as fit" if cost.steps is None else plural(cost.steps, "step")


def describe_memory(cost: Cost) -> str:
    """Describe the memory of a job, and the disk that tiles take."""
    disk = f", and {cost.disk / 1e6:,.0f} MB of disk" if cost.disk else ""
    return f"{cost.bytes / 1e6:,.0f} MB{disk}"


def count_tiles(plan: TilePlan | None) -> dict[str, int]:
    """Return the numbers of tiles and workers, for the result of a dry run."""
    return {} if plan is None else {"tiles": plan.tiles, "workers": plan.workers}


def say_views(run: Run, views: ViewsReport | None, chosen: bool) -> None:
    """Print the number of unused and selected views, if not all candidates are used."""
    if views is None:
        return
    if views.refused:
        count = plural(len(views.refused), "view")
        run.say(f"{count} not used: the scene is not in sight, or the camera is inside it")
    if chosen:
        run.say(
            f"views: {len(views.chosen)} of {views.candidates} by {views.policy};"
            f" the rest would have added {100 * views.left_out:.1f} %"
        )


def say_fit(run: Run, source: Path, budget: Budget, name: str) -> None:
    """Say that a file already has the bytes of a budget; `name` is that of the output."""
    if (
        budget.bytes is None
        or budget.of_page
        or not source.is_file()
        or source.stat().st_size > budget.bytes
    ):
        return
    fits = (
        f"{source.name} has {source.stat().st_size / 1e6:.2f} MB, which already fits {budget.fit}"
    )
    ours = scene_format(name).suffix
    if next((suffix for suffix in SUFFIXES if source.name.lower().endswith(suffix)), None) == ours:
        run.say(f"nothing to do: {fits}")
    else:
        run.say(f"{fits}; only its size as {ours} counts")


def say_weight(
    run: Run, source: Path, output: Path, splats: Splats, *, lifted: Splats | None = None
) -> None:
    """Print a hint if the output is larger than its source file, or than the `lifted` points."""
    inputs = [] if lifted is None else [(lifted.nbytes, "the lifted points have")]
    if source.is_file() and source.suffix.lower() != ".json":
        inputs.append((source.stat().st_size, f"{source.name} has"))
    made = written_bytes(output)
    given, what = min(inputs, default=(made + 1, ""))
    if made < given:
        return
    why = ""
    if share := splats.shN.nbytes / splats.nbytes:
        why = f"; {share:.0%} of it is SH above degree 0, which --sh-degree 0 removes"
    smaller = (
        ""
        if output.suffix == ".sog"
        else f"; smaller: g2ard convert {output} {output.with_suffix('.sog')}"
    )
    run.say(f"{output}: {made / 1e6:.2f} MB, {what} {given / 1e6:.2f} MB{why}{smaller}")


def tell_quality(run: Run, budget: ResolvedBudget, splats: Splats | PartsStream) -> None:
    """Print the quality of a result with a quality budget; exit with status 3 if it is too low."""
    run.begin("quality")
    judgement = budget.judge(splats)
    if judgement is None:
        return
    met, line = judgement
    if not met:
        run.exit_unmet(line)
    run.say(line)
