"""`g2ard select`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from g2ard.cli.budget_options import Count
from g2ard.cli.frame import Run, command
from g2ard.cli.options import (
    OutputOption,
    PaperOption,
    PolicyOption,
    SceneArgument,
    SplitOption,
    ViewsOption,
    views_count,
)
from g2ard.progress import plural

if TYPE_CHECKING:
    from g2ard.io import ViewSet


@command("select", example="g2ard select scene.ply --views poses.json -k 100 -o chosen.json", settings=True)
def select(
    run: Run,
    scene: SceneArgument,
    output: OutputOption,
    k: Annotated[
        Count | None,
        typer.Option(
            "-k", parser=views_count, metavar="K", help="How many: 100, 25%, or auto (where the curve bends)."
        ),
    ] = None,
    views: ViewsOption = None,
    policy: PolicyOption = None,
    split: SplitOption = "train",
    preset: PaperOption = None,
) -> None:
    """Choose the views worth having, best first, with a weight for how often to draw each.

    Views that are not for training follow after them, with their split and no weight, to score on.
    """
    from g2ard.config.paths import listed
    from g2ard.config.presets import configured
    from g2ard.errors import InputError
    from g2ard.io import check_views_output
    from g2ard.pipeline import SelectConfig
    from g2ard.policy.inputs import load_scene, load_split_views
    from g2ard.policy.view_checks import warn_of_sight
    from g2ard.stages.select import select as choose

    settings = run.settings(SelectConfig(), "policy", preset=preset)
    if k is not None:
        settings["select.views_count"] = k.number if isinstance(k, Count) else k
    if views is None:
        raise typer.BadParameter("--views VIEWS: the candidates to select from")
    try:
        config = configured(SelectConfig(), preset or "auto", settings)
    except InputError as error:
        raise typer.BadParameter(str(error)) from None
    if config.views_count is None:
        raise typer.BadParameter("-k K: how many views to choose")
    check_views_output(output, run.overwrite)
    splats = load_scene(scene, run.say)
    pool, candidates = load_split_views(views, split, run.say)
    cameras = pool.cameras.take(candidates)
    warn_of_sight(splats, cameras, run.say)
    chosen = choose(
        splats,
        cameras,
        config.count_of(len(cameras)),
        policy=config.policy,
        seed=run.seed,
        options=config,
        progress=run.progress,
    )
    kept = cameras.take(chosen.order)
    _write(run, output, pool, candidates.nonzero()[0][chosen.order], chosen.weights)
    if len(chosen.refused):
        count = plural(len(chosen.refused), "view")
        run.say(f"{count} refused: nothing of the scene in sight, or within its matter")
    run.say(
        f"{output}: {len(kept)} of {plural(len(cameras), 'view')} by {config.policy};"
        f" those left out would add {100 * chosen.left_out:.1f} %"
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


def _write(run: Run, output: Path, pool: ViewSet, chosen: Any, weights: Any) -> None:
    """The chosen rows of the pool, best first, then all others that are not for training."""
    import numpy as np

    from g2ard.io import write_views

    kept = np.isin(np.arange(len(pool.splits)), chosen)
    held_out = [i for i, word in enumerate(pool.splits) if word not in ("train", None) and not kept[i]]
    rows = np.array([*chosen, *held_out], int)
    write_views(
        output,
        pool.cameras.take(rows),
        splits=[pool.splits[i] for i in rows],
        weights=[*weights, *[np.nan] * len(held_out)],
        overwrite=run.overwrite,
    )
    tests = sum(pool.splits[i] not in ("train", None) for i in chosen)
    if tests:
        run.say(f"held out among the chosen ones: {plural(tests, 'view')}, which recovery leaves out")
    if held_out:
        words = ", ".join(sorted({str(pool.splits[i]) for i in held_out}))
        run.say(f"held out after the chosen ones: {plural(len(held_out), 'view')} ({words})")
