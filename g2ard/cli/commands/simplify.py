"""`g2ard simplify`: fewer Gaussians at an exact budget."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from g2ard.cli.frame import Run, command
from g2ard.cli.options import (
    CountOption,
    Method,
    OutputOption,
    PaperOption,
    RatioOption,
    SceneArgument,
    UpOption,
    ViewsOrMadeOption,
    budget_of,
    is_made,
    one_budget,
)

if TYPE_CHECKING:
    from g2ard.cameras import Cameras
    from g2ard.cli.options import Triple
    from g2ard.splats import Splats
    from g2ard.stages.simplify import Simplified

_VIEWS, _NEAR = 96, 0.25
"""Poses of a pool of its own, as many of them are used as the scene needs; and the most that step nearer."""

_ROWS = 100_000
"""Gaussians that those are planned on."""


@command("simplify", example="g2ard simplify garden.ply -r 10 -o garden_10x.ply", constants=True)
def simplify(
    run: Run,
    scene: SceneArgument,
    output: OutputOption,
    count: CountOption = None,
    ratio: RatioOption = None,
    views: ViewsOrMadeOption = None,
    no_views: Annotated[
        bool,
        typer.Option("--no-views", help="Use no cameras at all, neither found ones nor a pool of its own."),
    ] = False,
    parents: Annotated[
        Path | None,
        typer.Option(metavar="FILE.npy", help="Also write the row that each Gaussian went to; -1 is none."),
    ] = None,
    preset: PaperOption = None,
    method: Annotated[Method, typer.Option(help="The policy.")] = "default",
    retention: Annotated[
        float | None,
        typer.Option(help="Share of the Gaussians that a round keeps; the method's own if absent."),
    ] = None,
    up: UpOption = None,
) -> None:
    """Reduce a scene to an exact number of Gaussians; no images needed.

    The default method weighs errors by what is seen: from --views, else from the cameras that lie beside the
    scene, else from a pool of poses of its own. The fast one looks only at given views, the paper's at none.
    """
    import time

    from g2ard import io
    from g2ard.constants import changed, listed
    from g2ard.stages.simplify import SimplifyConfig
    from g2ard.stages.simplify import simplify as reduce
    from g2ard.visibility import looker

    one_budget(count, ratio)
    if views is not None and no_views:
        raise typer.BadParameter("--views and --no-views exclude each other")
    values = run.constants(simplify=SimplifyConfig(), over_options=True)
    config = changed(SimplifyConfig(retention=retention), "simplify", values)
    io.check_scene_output(output, run.overwrite)
    if parents is not None:
        _check_parents(run, parents, scene, views)
    began = time.perf_counter()
    found = io.read_scene(scene)
    for note in found.notes:
        run.say(f"{scene}: {note}")
    read = time.perf_counter()
    budget = budget_of(scene, count, ratio, len(found.splats))
    looks = not no_views and budget < len(found.splats)
    cameras = _cameras(run, scene, found.splats, views, method, up) if looks else None
    small = reduce(
        found.splats,
        budget,
        method=method,
        visibility=None if cameras is None else looker(cameras, progress=run.progress),
        config=config,
        progress=run.progress,
    )
    simplified = time.perf_counter()
    io.write_splats(output, small.splats, overwrite=run.overwrite)
    if parents is not None:
        _write_parents(run, parents, small)
    written = time.perf_counter()
    _tell(run, small)
    share = (small.report["unseen"] or 0) / len(found.splats)
    if share >= 0.005:
        run.say(f"no view sees {share:.0%} of the Gaussians: they count by their own size alone")
    run.say(f"{output}: {len(small.splats):,} of {len(found.splats):,} Gaussians in {written - began:.1f} s")
    run.result(
        {
            **small.report,
            "method": method,
            "constants": listed({"simplify": config.resolved(method)}),
            "notes": {note.code: note.count for note in found.notes},
            "seconds": {
                "read": read - began,
                "simplify": simplified - read,
                "write": written - simplified,
                "total": written - began,
            },
            "peak_rss_bytes": _peak_rss(),
        }
    )


def _cameras(
    run: Run, scene: Path, splats: Splats, views: Path | None, method: str, up: Triple | None
) -> Cameras | None:
    """The views given, else those beside the scene, else a few of its own where it leaves room for them."""
    from g2ard.cli.found import as_pool, found_views
    from g2ard.cli.scenes import load_views
    from g2ard.errors import InputError

    made = is_made(views)
    if method == "paper" and views is not None:
        run.say("paper uses no views")
    if method == "paper" and made:
        return None
    if views is None and method == "default" and (found := found_views(run, scene, splats, ["train"])):
        return as_pool(load_views(run, found, "train", None))
    if views is not None and not made:
        return load_views(run, views, "train", None)
    if method != "default" and not made:
        return None
    from g2ard.poses import plan_pool

    try:
        pool = plan_pool(
            splats, _VIEWS, up=up, seed=run.seed, rows=_ROWS, near=_NEAR, looks=True, progress=run.progress
        )
    except InputError as e:
        run.say(f"goes on without views: {e}")
        return None
    return pool.cameras


def _check_parents(run: Run, parents: Path, scene: Path, views: Path | None) -> None:
    from g2ard.io.atomic import check_output

    if parents.resolve() in {path.resolve() for path in (scene, views) if path and not is_made(path)}:
        raise typer.BadParameter(f"--parents: {parents} is an input; name another output")
    check_output(parents, run.overwrite)


def _write_parents(run: Run, path: Path, small: Simplified) -> None:
    """(N,) int64 in the order of the scene's rows, for `render --color parents`."""
    import numpy as np

    from g2ard.io.atomic import atomic_output

    with atomic_output(path, overwrite=run.overwrite) as temporary, temporary.open("wb") as file:
        np.save(file, small.parents)


def _tell(run: Run, small: Simplified) -> None:
    if not run.verbose:
        return
    columns = ["round", "before", "dropped", "merged", "refused", "trimmed", "after"]
    rows = [
        [str(i + 1)]
        + [
            f"{v:,}"
            for v in (
                r["before"],
                r["dropped"],
                r["merged"],
                sum(r.get("refused", {}).values()),
                r["trimmed"],
                r["after"],
            )
        ]
        for i, r in enumerate(small.report["rounds"])
    ]
    run.console.table("Rounds", columns, rows)


def _peak_rss() -> int | None:
    """Bytes; None where the system does not tell."""
    import sys

    try:
        import resource
    except ImportError:  # Windows
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak
