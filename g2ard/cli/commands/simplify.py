"""`g2ard simplify`: fewer Gaussians at an exact budget."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from g2ard.cli.frame import Run, command
from g2ard.cli.options import CountOption, OutputOption, RatioOption, SceneArgument, budget_of, one_budget

if TYPE_CHECKING:
    from g2ard.simplify import Simplified


@command("simplify", example="g2ard simplify garden.ply -r 10 -o garden_10x.ply")
def simplify(
    run: Run,
    scene: SceneArgument,
    output: OutputOption,
    count: CountOption = None,
    ratio: RatioOption = None,
    method: Annotated[str, typer.Option(metavar="default|paper", help="The policy.")] = "default",
    retention: Annotated[
        float | None,
        typer.Option(help="Share of the Gaussians that a round keeps; the method's own if absent."),
    ] = None,
) -> None:
    """Reduce a scene to an exact number of Gaussians; no images needed."""
    import time

    from g2ard import io
    from g2ard.simplify import SimplifyConfig
    from g2ard.simplify import simplify as reduce

    one_budget(count, ratio)
    io.check_output(output, overwrite=run.overwrite)
    began = time.perf_counter()
    found = io.read_scene(scene)
    for note in found.notes:
        run.say(f"{scene}: {note}")
    read = time.perf_counter()
    small = reduce(
        found.splats,
        budget_of(count, ratio, len(found.splats)),
        method=method,
        config=SimplifyConfig(retention=retention),
        progress=run.progress,
    )
    simplified = time.perf_counter()
    io.write_splats(output, small.splats, overwrite=run.overwrite)
    written = time.perf_counter()
    _tell(run, small)
    run.say(f"{output}: {len(small.splats):,} of {len(found.splats):,} Gaussians in {written - began:.1f} s")
    run.result(
        {
            **small.report,
            "method": method,
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
                r["merged_members"] - r["merged_groups"],
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
