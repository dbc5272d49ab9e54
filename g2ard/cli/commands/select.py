"""`g2ard select`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from g2ard.cli import options as opt
from g2ard.cli.budget_options import Count
from g2ard.cli.command import command
from g2ard.cli.run import Run
from g2ard.config.schema import listed
from g2ard.pipeline.presets import configure
from g2ard.progress import plural

if TYPE_CHECKING:
    from g2ard.arrays import Float, Int
    from g2ard.config.choices import ViewFormat
    from g2ard.io.types import ViewSet


@command(
    "select",
    example="g2ard select scene.ply --views poses.json -k 100 -o chosen.json",
    settings="g2ard.pipeline.config:SelectConfig",
    fields=("select.policy",),
    scenes=True,
    without=("seed",),
)
def select(
    run: Run,
    scene: opt.SceneArgument,
    output: opt.OutputOption,
    format: opt.ViewFormatOption = None,
    k: Annotated[
        Count | None,
        typer.Option(
            "-k",
            parser=opt.views_count,
            metavar="K",
            help="Views to select: 100, 25%, or auto (the knee of the curve).",
        ),
    ] = None,
    views: opt.ViewsOption = None,
    images: opt.ImagesOption = None,
    split: opt.SplitOption = "train",
    preset: opt.PaperOption = None,
) -> None:
    """Select the most useful views, best first, each with a sampling weight.

    Views outside the training split are appended without a weight, for scoring.
    """
    from g2ard.jobs.inputs import load_split_views
    from g2ard.jobs.view_checks import warn_of_sight
    from g2ard.pipeline.config import SelectConfig
    from g2ard.stages.select import CoverageOptions
    from g2ard.stages.select import select as choose

    settings = run.settle(SelectConfig(), preset)[0]
    if k is not None:
        settings["select.views_count"] = k.value if isinstance(k, Count) else k
    if views is None:
        raise typer.BadParameter("give the candidates with --views VIEWS")
    with run.usage():
        config = configure(SelectConfig(), preset or "auto", settings)
    if config.views_count is None:
        raise typer.BadParameter("give the number of views with -k K")
    run.claim_views(output, format)
    splats = run.load(scene)
    pool, candidates = load_split_views(opt.with_images(views, images), split, run.say)
    cameras = pool.cameras.take(candidates)
    warn_of_sight(splats, cameras, run.say)
    chosen = choose(
        splats,
        cameras,
        config.count_of(len(cameras)),
        policy=config.policy,
        options=config if isinstance(config, CoverageOptions) else None,
        progress=run.progress,
    )
    run.begin("write")
    kept = cameras.take(chosen.order)
    _write(run, output, format, pool, candidates.nonzero()[0][chosen.order], chosen.weights)
    if len(chosen.refused):
        count = plural(len(chosen.refused), "view")
        run.say(f"{count} not used: the scene is not in sight, or the camera is inside it")
    run.say(
        f"{output}: {len(kept)} of {plural(len(cameras), 'view')} by {config.policy};"
        f" the rest would add {100 * chosen.left_out:.1f} %"
    )
    run.result(
        {
            "policy": config.policy,
            "views": [
                {"name": name, "gain": gain, "weight": weight}
                for name, gain, weight in zip(
                    kept.names, chosen.gains.tolist(), chosen.weights.tolist(), strict=True
                )
            ],
            "left_out": chosen.left_out,
            "curve": chosen.curve.tolist(),
            "refused": [cameras.names[i] for i in chosen.refused],
            "evaluations": chosen.evaluations,
            "seconds": chosen.seconds,
            "settings": listed(config),
        }
    )


def _write(
    run: Run,
    output: Path,
    format: ViewFormat | None,
    pool: ViewSet,
    chosen: Int,
    weights: Float,
) -> None:
    """Write the chosen views, best first, then the other views outside the training split."""
    import numpy as np

    kept = np.isin(np.arange(len(pool.splits)), chosen)
    held_out = [
        i for i, word in enumerate(pool.splits) if word not in ("train", None) and not kept[i]
    ]
    rows = np.array([*chosen, *held_out], int)
    run.write_views(
        output,
        pool.cameras.take(rows),
        format,
        splits=[pool.splits[i] for i in rows],
        weights=[*weights, *[np.nan] * len(held_out)],
    )
    tests = sum(pool.splits[i] not in ("train", None) for i in chosen)
    if tests:
        run.say(f"{plural(tests, 'chosen view')} held out: recovery will not train on them")
    if held_out:
        words = ", ".join(sorted({str(pool.splits[i]) for i in held_out}))
        run.say(f"{plural(len(held_out), 'held-out view')} appended ({words})")
