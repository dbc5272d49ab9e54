"""`g2ard.simplify`: choosing views for visibility weights, then running the stage."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from g2ard.config.checks import checks_arguments
from g2ard.config.choices import FormatName, RenderModel
from g2ard.io import kind, read_cloud, read_scene
from g2ard.io.types import Note
from g2ard.jobs.budget import Budget
from g2ard.jobs.inputs import Views, say_notes
from g2ard.jobs.measured_budget import Reduction
from g2ard.pipeline.presets import configured
from g2ard.progress import Progress, Say, plural, silent, unsaid
from g2ard.scene.splats import Splats
from g2ard.stages.lift import lift
from g2ard.stages.simplify import Simplified, SimplifyConfig
from g2ard.stages.simplify.gaps import say_gaps

if TYPE_CHECKING:
    from g2ard.jobs.tiling import Tiling


@contextmanager
def reducing(
    scene: Splats | str | Path,
    tiling: Tiling | None = None,
    *,
    planned: bool = False,
    counted: Callable[[int], None] = lambda total: None,
    render_model: RenderModel | None = None,
    beside: str | Path | None = None,
    progress: Progress = silent,
    say: Say = unsaid,
    **options: Any,
) -> Iterator[Reduction]:
    """Read a scene to be simplified, see `simplify`, or open its tiles.

    Args:
        tiling: how to process the scene, a path, in tiles; None for one piece.
        planned: whether tiles are only planned.
        counted: called with the number of Gaussians before any work on them.
        options: other fields of `Reduction`.
    """
    callbacks: dict[str, Any] = {"progress": progress, "say": say}
    beside = beside if isinstance(scene, Splats) else beside or scene
    if tiling is not None:
        from g2ard.jobs.tiled import opened

        how: dict[str, Any] = {"render_model": render_model, "planned": planned, **callbacks}
        with opened(Path(str(scene)), tiling, 1.0, **how) as tiles:
            counted(tiles.plan.count)
            options |= {"beside": beside, "notes": tiles.store.notes if tiles.store else (), **callbacks}
            yield Reduction(tiles.sample(options["config"]), tiles=tiles, **options)
        return
    notes: Sequence[Note] = ()
    if not isinstance(scene, Splats):
        progress("read", 0, 0)
        if kind(scene) == "points":
            scene, notes = _lifted(scene, progress, say)
    if not isinstance(scene, Splats):
        found = read_scene(scene, render_model=render_model)
        say_notes(scene, found.notes, say)
        scene, notes = found.splats, found.notes
    counted(len(scene))
    yield Reduction(scene, beside=beside, notes=notes, **options, **callbacks)


def _lifted(cloud: str | Path, progress: Progress, say: Say) -> tuple[Splats, Sequence[Note]]:
    """Read a point cloud and lift it, like `g2ard lift`."""
    found = read_cloud(cloud)
    for note in found.notes:
        say(f"{cloud}: {note}")
    points = found.points
    lifted = lift(points.positions, points.colors, progress=progress)
    discs = plural(len(lifted), "disc")
    say(f"{cloud}: {plural(len(points), 'point')} lifted to {discs}, as `g2ard lift` does")
    return lifted, found.notes


@checks_arguments
def simplify(
    scene: Splats | str | Path,
    *,
    count: int | None = None,
    ratio: float | None = None,
    fit: str | None = None,
    min_psnr: float | None = None,
    min_ssim: float | None = None,
    format: FormatName = "ply",
    views: Views | None = None,
    blind: bool = False,
    method: str | None = None,
    keep_region: Sequence[Sequence[float]] | None = None,
    config: SimplifyConfig | None = None,
    settings: Mapping[str, Any] | None = None,
    beside: str | Path | None = None,
    up: Sequence[float] | None = None,
    render_model: RenderModel | None = None,
    seed: int = 0,
    progress: Progress = silent,
    say: Say = unsaid,
) -> Simplified:
    """Reduce a scene to an exact number of Gaussians, exactly like the command `g2ard simplify`.

    No images are needed. The default method weights errors by visibility in `views`, in cameras found beside
    the scene, or in generated views. `fast` uses only given views, `paper` none.

    Args:
        scene: the dense scene, or its path; a coloured point cloud is lifted first.
        count: Gaussians to keep, at most those of the scene.
        ratio: reduction factor, at least 1; the result has round(N/ratio).
        fit: largest file, such as "5MB", or a device (see `Budget`).
        min_psnr: PSNR (dB) to keep against the scene, in generated views.
        min_ssim: SSIM to keep; with `min_psnr` both hold. `say` receives the result's quality.
        format: file format for `fit`: ply, compressed.ply, sog, spz, glb, splat, usda or usdc.
        views: cameras in world coordinates, or their path; the training split is used. "made" always
            generates views.
        blind: use no cameras at all.
        method: default, fast or paper; see `g2ard.stages.simplify.simplify`.
        keep_region: spheres (x, y, z, r) and boxes (x, y, z, x, y, z) in world coordinates that get more of
            the budget, as if views were √keep_times times closer.
        config: constants; None means the method's defaults. `method` and `keep_region` override it.
        settings: values of `config` by path, such as {"simplify.max_energy": 0.02}; they override everything
            else.
        beside: where to look for cameras, if `scene` is not a path: in its folder and its trainer's.
        up: (3,) direction away from the ground for generated views; None estimates it.
        render_model: overrides what the scene's file says.
        seed: seed of generated views.
        progress: called during planning, visibility and merging.
        say: called with log messages.

    Returns:
        The scene, the new row of each row, protection flags and a report.

    Raises:
        InputError: no budget or several, a budget that does not fit, an unknown method or setting, unreadable
            views, or both `views` and `blind`.

    >>> import numpy as np
    >>> ball = np.random.default_rng(0).normal(size=(900, 3))
    >>> ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    >>> small = simplify(Splats.create(ball, scales=np.full((900, 3), 0.05)), ratio=10)
    >>> len(small.splats), small.parents.shape, small.report.output_count
    (90, (900,), 90)
    """
    fields = {"method": method, "keep_region": keep_region}
    given = {name: value for name, value in fields.items() if value is not None}
    config = configured(config or SimplifyConfig(), settings=given | dict(settings or {}))
    wanted = Budget(count, ratio, fit=fit, min_psnr=min_psnr, min_ssim=min_ssim)
    name = "scene" if isinstance(scene, Splats) else str(scene)
    inputs: dict[str, Any] = {"views": views, "blind": blind, "beside": beside, "up": up, "seed": seed}
    inputs |= {"render_model": render_model, "progress": progress, "say": say}
    with reducing(scene, config=config, **inputs) as reduce:
        budget = reduce.resolved(wanted, name, f"scene.{format}")
        small: Simplified = reduce(budget.count)
    say_gaps(small.report.opacity_lost, say)
    if judgement := budget.judge(small.splats):
        say(judgement[1])
    return small
