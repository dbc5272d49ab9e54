"""`g2ard.simplify`, and the reductions of one scene to any budget that several commands make."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from g2ard.arrays import Int
from g2ard.config.checks import check_seed, checks_arguments
from g2ard.config.choices import FormatName, PointColor, RenderModel
from g2ard.errors import InputError
from g2ard.io import Source
from g2ard.io.scene_formats import check_positions, scene_format
from g2ard.io.stream import PartsStream
from g2ard.io.types import Note
from g2ard.jobs.budget import Budget, parse_count
from g2ard.jobs.budget_search import (
    Quality,
    ResolvedBudget,
    find_count_for_bytes,
    find_count_for_layers,
    find_count_for_quality,
    pass_through_file,
)
from g2ard.jobs.chosen_points import PointChoice
from g2ard.jobs.inputs import GivenViews, Numbers, Scene, Views, lift_cloud, load_scene, say_regions
from g2ard.pipeline.dense import Dense, InMemory, Merged, load_whole
from g2ard.pipeline.presets import configure
from g2ard.progress import Progress, Say, plural, silent, unsaid
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats
from g2ard.stages.simplify import Pairs, Simplified, SimplifyConfig
from g2ard.stages.simplify import simplify as merge
from g2ard.stages.simplify.gaps import say_gaps
from g2ard.system.cached import cached_property
from g2ard.viewer.page import room_for_scene

if TYPE_CHECKING:
    from g2ard.jobs.memory import TilePlan
    from g2ard.jobs.tile_options import Tiling

_QUALITY_VIEWS = 12
"""Number of views in which quality is measured."""
_QUALITY_SIDE = 400
"""Longer side of these views in pixels."""
_POOL_SAMPLE = 100_000
"""Gaussians that those views are planned on."""
_BYTES_SAFETY = 0.985
"""Safety factor on the bytes if recovery will change the scene after the search."""


@dataclass(eq=False)
class Reduction:
    """Reductions of one scene to any budget: count → `Simplified`, as `simplify` returns it.

    Poses and visibility are computed once, and the last two results are cached. Other arguments and errors
    are those of `simplify`.

    Args:
        dense: the scene.
        given: views that give visibility weights.
        cameras: cameras that give them to every method instead.
        recovered: whether the results are recovered afterwards, so that their gaps are not measured.
        notes: notes on the scene's file.
        plan: of the scene's tiles; None if it is in memory.
    """

    dense: Dense
    given: GivenViews = field(default_factory=GivenViews)
    cameras: Cameras | None = None
    blind: bool = False
    config: SimplifyConfig = field(default_factory=SimplifyConfig)
    recovered: bool = False
    notes: Sequence[Note] = ()
    _merged: dict[int, Merged] = field(default_factory=dict)
    plan: TilePlan | None = None

    def __post_init__(self) -> None:
        config = self.config
        check_seed("seed", self.given.seed)
        if self.given.views is not None:
            if self.blind:
                raise InputError("views and blind exclude each other")
            if config.method == "paper":
                raise InputError("has no effect on the method paper", parameter="views")
        if isinstance(config, Pairs):
            useless = (
                {"pixel_scale": "with views"}
                if self._is_weighed
                else {"edge_weight": "without views"}
            )
            for name in ("edge_weight", "dilation") if self.splats.antialiased else ():
                useless.setdefault(name, "on antialiased scenes")
            for name, where in useless.items():
                if getattr(config, name) != getattr(Pairs, name):
                    raise InputError(f"has no effect {where}", parameter=f"simplify.{name}")
        if self.plan is None:
            say_regions(self.splats, config, "the scene", self.given.say)
        else:
            say_regions(self.splats, config, "a sample of the scene", unsaid)

    @property
    def splats(self) -> Splats:
        """The scene, or a sample of one in tiles."""
        return self.dense.sample

    @property
    def total(self) -> int:
        """Gaussians of the scene."""
        return self.dense.total

    @property
    def _is_viewed(self) -> bool:
        """Whether the user or another job gave views."""
        return self.cameras is not None or self.given.views is not None

    @property
    def _is_weighed(self) -> bool:
        """Whether views weigh Gaussians by visibility, if there is room for them."""
        return not self.blind and (self._is_viewed or self.config.method == "default")

    def __call__(self, count: int) -> Merged:
        if count not in self._merged:
            last = list(self._merged.items())[-1:]
            seen = self.seen if count < self.total else None
            small = self.dense.merge(
                count, seen, self.config, gaps=not self.recovered, progress=self.given.progress
            )
            self._merged = {**dict(last), count: small}
        return self._merged[count]

    @cached_property
    def seen(self) -> Cameras | None:
        """Views that weigh Gaussians by visibility."""
        if not self._is_weighed:
            return None
        if self.cameras is not None:
            return self.cameras
        # loads planning, which others do not need
        from g2ard.jobs.run_views import choose_weighing_views

        return choose_weighing_views(self.dense, self.given)

    def warnings(self, small: Splats | PartsStream) -> list[str]:
        """Return warnings about the views, and about regions of a result that is in memory."""
        if not isinstance(small, Splats) or len(small) >= self.total:
            return []
        from g2ard.jobs.doubts import doubt_merging, doubt_views  # as above

        told = doubt_merging(self.splats, small, blind=self.seen is None)
        if self.seen is not None and self._is_viewed:
            told += doubt_views(self.splats, self.seen)
        return told

    def resolve(
        self, budget: Budget, name: str, file: str, sh_degree: int | None = None
    ) -> ResolvedBudget:
        """Resolve a budget for the scene, called `name` in errors.

        If recovery follows, bytes are searched with the method `fast` and a margin. A rough job tries
        nothing: bytes are those of a sample, and no quality is measured.

        Args:
            file: a file name; its suffix is the format for `Budget.fit`.
            sh_degree: of the result; None is the scene's.
        """
        splats = self.splats
        say = self.given.say
        total = self.total
        rough = self.given.rough
        if budget.min_psnr is not None or budget.min_ssim is not None:
            if rough:
                say("the run measures how many Gaussians keep the quality; here, a tenth")
                return ResolvedBudget(max(1, total // 10))
            return self._resolve_for_quality(
                Quality(budget.min_psnr or 0.0, budget.min_ssim or 0.0), file
            )

        def tried(count: int) -> Splats:
            if self.recovered and self.plan is None:
                return merge(splats, count, method="fast").splats
            return load_whole(self(count).splats)  # in tiles, recovery starts from this one

        size = budget.bytes
        if size is not None and budget.of_page:
            size = room_for_scene(size)
            file = "scene.sog"
        if size is not None:
            if sh_degree is not None:
                splats = splats.with_sh_degree(sh_degree)
            exact = self.plan is not None and scene_format(file).suffix == ".ply"
            most = int(size * _BYTES_SAFETY) if self.recovered and not exact else size
            try_it = None if rough else tried
            found = find_count_for_bytes(
                splats, most, file, try_it, None if self.plan is None else total
            )
        else:
            found = budget.of(total, name)
            check_positions(file, splats, found)
        if budget.layers is not None and not rough:
            before = found
            found, layers = find_count_for_layers(before, budget.layers, tried)
            if found < before:
                say(
                    f"{budget.fit}: near views blend more than {budget.layers} Gaussians per pixel at "
                    f"{before:,}, {layers:.0f} at {found:,}"
                )
        if budget.fit is not None:
            fits = plural(found, "Gaussian")
            if found == total:
                fits = f"nothing to do, all {fits} already fit"
            elif size is not None:
                fits = f"about {fits}"
            say(f"{budget.fit}: {fits}")
        return ResolvedBudget(found, size, file)

    def _resolve_for_quality(self, wanted: Quality, file: str) -> ResolvedBudget:
        """Find the count that keeps a quality in generated views, as read back from the format of `file`."""
        from g2ard.poses import plan_pool  # as above

        splats = self.splats
        progress = self.given.progress
        say = self.given.say
        pool = plan_pool(
            splats,
            _QUALITY_VIEWS,
            seed=self.given.seed,
            rows=_POOL_SAMPLE,
            represents=self.total / len(splats),
            progress=progress,
        )
        cameras = pool.cameras.resized(_QUALITY_SIDE)

        def reduce(count: int) -> Splats:
            small = pass_through_file(load_whole(self(count).splats), file)
            progress("quality", 0, 0)
            return small

        drawn = self.dense.images(cameras)
        renders = [drawn[view] for view in range(len(cameras))]
        found, near = find_count_for_quality(renders, self.total, wanted, cameras, reduce)
        if found == self.total:
            say(
                f"no smaller count was found that keeps the quality; keeping all {found:,} Gaussians"
            )
        else:
            stage = " before recovery" if self.recovered else ""
            views = plural(len(cameras), "view")
            say(
                f"{plural(found, 'Gaussian')} keep {near}{stage}, in {views} generated to choose the count"
            )
        return ResolvedBudget(
            found, file=file, wanted=wanted, renders=renders, cameras=cameras, total=self.total
        )


def read_parents(small: Merged, source: Source) -> Int:
    """Return the (N,) new row of each row of a scene, in its file's order; −1 if it was dropped."""
    if isinstance(small, Simplified):
        return small.parents
    from g2ard.tiles.merging import Merged as MergedTiles

    assert isinstance(small, MergedTiles)
    return small.parents(source.scene)


@contextmanager
def open_reduction(
    scene: Splats | Source,
    tiling: Tiling | None = None,
    *,
    budgets: Sequence[Budget] = (),
    counted: Callable[[int], None] = lambda total: None,
    given: GivenViews,
    **options: Any,
) -> Iterator[Reduction]:
    """Read a scene to be simplified, see `simplify`, or open its tiles.

    Args:
        tiling: how to process the scene, a file, in tiles, which are only planned if `given` is rough; None
            for one piece.
        budgets: checked before tiles are written.
        counted: called with the number of Gaussians before any work on them.
        options: other fields of `Reduction`.
    """
    if isinstance(scene, Splats):
        counted(len(scene))
        yield Reduction(InMemory(scene), given, **options)
        return
    given = replace(given, beside=given.beside or scene.path)
    progress = given.progress
    say = given.say
    if tiling is not None:
        from g2ard.jobs.dense import open_tiles

        config = options["config"]
        with open_tiles(
            scene,
            tiling,
            1.0,
            config,
            budgets=budgets,
            planned=given.rough,
            progress=progress,
            say=say,
        ) as tiles:
            counted(tiles.plan.count)
            yield Reduction(tiles.dense, given, notes=tiles.notes, plan=tiles.plan, **options)
        return
    progress("read", 0, 0)
    if scene.kind == "points":
        splats = lift_cloud(scene, progress, say)
        notes = scene.cloud().all_notes()
    else:
        splats = load_scene(scene, say)
        notes = scene.notes
    counted(len(splats))
    yield Reduction(InMemory(splats), given, notes=notes, **options)


@checks_arguments
def simplify(
    scene: Scene,
    *,
    count: int | str | None = None,
    ratio: float | None = None,
    fit: str | None = None,
    min_psnr: float | None = None,
    min_ssim: float | None = None,
    format: FormatName = "ply",
    views: Views | None = None,
    blind: bool = False,
    method: str | None = None,
    keep_region: Sequence[Numbers] | None = None,
    config: SimplifyConfig | None = None,
    settings: Mapping[str, Any] | None = None,
    beside: str | Path | None = None,
    up: Numbers | None = None,
    render_model: RenderModel | None = None,
    box: Numbers | None = None,
    where: str | None = None,
    color: PointColor | None = None,
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
        format: file format for `fit`, a name in `g2ard.io.scene_formats.FORMATS`.
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
        box: of a point cloud's file, keep points between two corners (x, y, z, x, y, z).
        where: keep points for which this holds, such as "classification == 2".
        color: "intensity" or "class" to colour points by.
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
    config = configure(config or SimplifyConfig(), settings=given | dict(settings or {}))
    wanted = Budget(parse_count(count), ratio, fit=fit, min_psnr=min_psnr, min_ssim=min_ssim)
    name = "scene" if isinstance(scene, Splats) else str(scene)
    given_views = GivenViews(views, beside, up, seed, progress=progress, say=say)
    source = scene if isinstance(scene, Splats) else Source(scene, render_model)
    PointChoice(box, where, color).narrow(source, progress)
    with open_reduction(source, given=given_views, blind=blind, config=config) as reduce:
        budget = reduce.resolve(wanted, name, f"scene.{format}")
        small = reduce(budget.count)
    assert isinstance(small, Simplified)  # not in tiles
    say_gaps(small.report.opacity_lost, say)
    if judgement := budget.judge(small.splats):
        say(judgement[1])
    return small
