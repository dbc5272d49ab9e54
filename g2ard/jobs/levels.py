"""`g2ard.lod`: levels of detail, each merged from the previous one and recovered at its viewing size."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeVar, cast

import numpy as np

from g2ard.arrays import Float
from g2ard.config.checks import AtLeastOne, checks_arguments
from g2ard.config.choices import BLACK, UNITS, Colour, LengthUnit, RenderModel
from g2ard.errors import InputError
from g2ard.io import Source
from g2ard.io.reports import Report
from g2ard.io.scenes import tell
from g2ard.jobs.budget import Budget
from g2ard.jobs.comparison import is_made_of_points
from g2ard.jobs.cost import Cost, cost_of, trainer_bytes
from g2ard.jobs.distill import open_job
from g2ard.jobs.distill_job import DistillJob
from g2ard.jobs.distill_options import DistillOptions
from g2ard.jobs.inputs import GivenViews, Numbers, Scene, Views, load_scene
from g2ard.jobs.viewer_frame import choose_backdrop, choose_frame, up_of
from g2ard.levels.tileset import TILE_OF_SCENE, Georeference, is_outside, map_system, metres_of
from g2ard.levels.tileset import save_tileset as write_tileset
from g2ard.levels.tree import Cut, Level, aligned
from g2ard.pipeline.dense import Dense, InMemory
from g2ard.progress import Progress, Say, direction, plural, silent, unsaid
from g2ard.rendering.metrics import psnr
from g2ard.rendering.targets import Targets, fill
from g2ard.report.labels import name_scenes
from g2ard.scene.regions import sky_mask
from g2ard.scene.samples import take_evenly
from g2ard.scene.splats import Splats
from g2ard.stages.evaluate import evaluate
from g2ard.stages.simplify.gaps import say_gaps
from g2ard.system.shown import Shown
from g2ard.viewer.page import Start, write_globe_page, write_stream_page

if TYPE_CHECKING:
    from g2ard.jobs.tile_options import Tiling

RATIOS = (1.0, 2.0, 4.0, 8.0, 16.0)
"""Reduction factors; each level has half the Gaussians of the previous one, as in viewers' own tools."""

_UP_SAMPLE = 100_000
"""Gaussians used to estimate the up direction."""

_SMALLEST_VIEW_SIDE = 200
"""Smallest longer side of a level's views in pixels; below it, edges dominate the error."""


@dataclass(frozen=True)
class LevelReport(Report):
    """Figures of one level.

    Args:
        ratio: reduction factor relative to the scene.
        size: longer side in pixels of the views for recovery and scoring.
        simplified, recovered: PSNR, dB, in held-out views of that size; None for the scene itself.
    """

    count: int
    ratio: float
    size: int
    seconds: float
    simplified: float | None = None
    recovered: float | None = None

    def line(self, number: int) -> str:
        """Describe the level of a number.

        >>> LevelReport(50, 2.0, 200, 1.0, simplified=31.5).line(1)
        'level 1: 50 Gaussians (31.50 dB merged, in held-out views of 200 pixels)'
        """
        scores = {"merged": self.simplified, "recovered": self.recovered}
        figures = [f"{psnr:.2f} dB {what}" for what, psnr in scores.items() if psnr is not None]
        told = (
            f" ({', '.join(figures)}, in held-out views of {self.size} pixels)" if figures else ""
        )
        return f"level {number}: {plural(self.count, 'Gaussian')}{told}"


L = TypeVar("L", bound=Level, covariant=True)


@dataclass(frozen=True, eq=False)
class Levels(Shown, Generic[L]):
    """Levels of detail of a scene, finest first, with a report on each, and the sky if it is apart."""

    splats: tuple[L, ...]
    reports: tuple[LevelReport, ...]
    sky: Splats | None = None

    def __repr__(self) -> str:
        return f"Levels({', '.join(f'{len(level):,}' for level in self.splats)} Gaussians)"


@dataclass(frozen=True, eq=False)
class LevelsJob:
    """Prepared levels: inputs are read and everything is decided.

    Args:
        job: the distillation that levels are steps of.
        sky: sky and far background, kept apart; None without.
    """

    job: DistillJob
    ratios: Numbers
    sky: Splats | None = None

    def plan(self) -> Iterator[tuple[float, int, int]]:
        """Yield the ratio of each level, its Gaussians, and the longer side in pixels of its views."""
        longest = int(self.job.views.train.cameras.sides.max())
        for ratio in self.ratios:
            shrunk = max(_SMALLEST_VIEW_SIDE, round(longest / ratio**0.25))
            yield ratio, Budget(ratio=ratio).of(self.job.total), longest if ratio == 1 else shrunk

    def cost_of(self, count: int, size: int) -> Cost:
        """Return the cost of a level that is not the scene itself."""
        return cost_of(replace(self.job, views=self.job.views.resized(size)), count, page=False)

    def run(self, work: Path | None = None) -> Levels[Level]:
        """Make the levels; `work` is the folder for resuming.

        Each is merged from the one before as it was merged. The job returns a level, the same before
        recovery, and the PSNR of both, None without recovery.
        """
        from g2ard.tiles.dense import InTiles

        job = self.job
        levels: list[Level] = []
        reports: list[LevelReport] = []
        finer: Dense = job.dense
        scene = finer
        for ratio, count, size in self.plan():
            began = time.perf_counter()
            level = scene
            scores: list[float | None] = []
            if ratio > 1:
                level, finer, *scores = self._level(finer, count, size, work)
            report = LevelReport(count, ratio, size, time.perf_counter() - began, *scores)
            job.say(report.line(len(levels)))
            levels.append(level.store if isinstance(level, InTiles) else level.sample)
            reports.append(report)
        return Levels(tuple(levels), tuple(reports), self.sky)

    def _level(
        self, finer: Dense, count: int, size: int, work: Path | None
    ) -> tuple[Dense, Dense, float, float | None]:
        """Make a level; return it, the same before recovery, and the PSNR of the latter and of the former."""
        job = replace(self.job, views=replace(self.job.views.resized(size), full=None))
        held_out = job.targets.held_out
        fill(held_out, job.progress)
        fits = job.plan is None or trainer_bytes(count, job.sh_degree) <= job.plan.memory
        if job.recovers and fits:
            done = job.reduce(finer, count, work)
            lost = job.dense.opacity_lost(done.splats, held_out.cameras)
            say_gaps(lost, job.say, f"give levels more Gaussians (--ratios), here {count:,}")
            on = done.match_exposures(held_out)
            level = InMemory(done.splats)
            merged = InMemory(done.simplified)
            return level, merged, _measure_psnr(job, merged, on), _measure_psnr(job, level, on)
        if job.recovers:
            job.say(
                f"{plural(count, 'Gaussian')} are too many for the memory to recover: merged only"
            )
        cameras = self.job.views.merging or self.job.views.train.cameras  # at full size
        config = job.config.simplify
        small = finer.merge(count, cameras, config, gaps=True, progress=job.progress)
        say_gaps(small.report.opacity_lost, job.say)
        derived = finer.derive(small.splats, "merged")
        return derived, derived, _measure_psnr(job, derived, held_out), None


def _measure_psnr(job: DistillJob, scene: Dense, on: Targets) -> float:
    """Return the mean PSNR of a level in some views."""
    background = job.config.recover.background
    if isinstance(scene, InMemory):
        return evaluate(
            scene.splats, on, stage="scoring", background=background, progress=job.progress
        ).psnr
    drawn = scene.images(on.cameras, background)
    return float(np.mean([psnr(drawn[view], on[view]) for view in range(len(on.cameras))]))


@contextmanager
def open_levels(
    scene: Splats | Source,
    tiling: Tiling | None = None,
    *,
    ratios: Numbers,
    recover: bool,
    steps: int | None,
    background: Colour,
    split_sky: bool,
    seed: int,
    say: Say = unsaid,
    **inputs: Any,
) -> Iterator[LevelsJob]:
    """Read the scene and decide everything for `lod`, whose arguments these are.

    Args:
        tiling: how to process the scene in tiles; None for one piece.
        inputs: other fields of `DistillOptions`.
    """
    check_ratios(ratios)
    sky = None
    if isinstance(scene, Splats):
        scene = scene.narrowed()  # levels and sky then have one offset
    else:
        inputs["beside"] = inputs.get("beside") or scene.path
    if split_sky:
        scene = load_scene(scene, say)
        if (far := sky_mask(scene)).any():
            say(f"sky: {plural(int(far.sum()), 'Gaussian')}, kept whole")
            sky = scene.take(far)
            scene = scene.take(~far)
        else:
            say("sky: none found, so nothing is kept apart")
    settings = {"recover.background": background, "recover.seed": seed}
    settings |= {} if steps is None else {"recover.steps": steps}
    inputs.setdefault("photos", False)
    use: Any = "levels" if recover else "merging"
    options = DistillOptions(settings=settings, use=use, say=say, **inputs)
    with open_job(scene, Budget(ratio=ratios[-1]), options, tiling) as job:
        yield LevelsJob(job, ratios, sky)


@checks_arguments
def lod(
    scene: Scene,
    *,
    ratios: Numbers = RATIOS,
    recover: bool = True,
    views: Views | None = None,
    photos: bool | None = False,
    steps: int | None = None,
    size: AtLeastOne | None = None,
    background: Colour = BLACK,
    beside: str | Path | None = None,
    up: Numbers | None = None,
    render_model: RenderModel | None = None,
    split_sky: bool = False,
    seed: int = 0,
    work: Path | None = None,
    progress: Progress = silent,
    say: Say = unsaid,
) -> Levels[Splats]:
    """Make levels of detail of a trained scene, exactly like the command `g2ard lod`.

    Each level is merged from the previous one, so its Gaussians are unions of finer ones. At √r times the
    distance, N/r Gaussians cover as many pixels each. Viewers also show coarse levels close up while loading,
    so level r is recovered in views shrunk by √√r, a compromise.

    Args:
        scene: the dense scene, or its path.
        ratios: reduction factor of each level, rising; 1 is the unchanged scene.
        recover: recover each level; otherwise only merge.
        views: cameras in world coordinates, or their path. None uses cameras found beside the scene, or
            generates views; "made" always generates them.
        photos: training images. False renders the scene, True takes photos, None takes the photo of each view
            and a render if it has none.
        steps: steps of each recovery; None chooses like `g2ard.distill`.
        size: longer side in pixels of the finest level's views; photos only shrink to it.
        background: RGB in [0, 1] behind the scene.
        beside: where to look for cameras, if `scene` is not a path.
        up: (3,) direction away from the ground for generated views; None estimates it.
        render_model: overrides what the scene's file says.
        split_sky: keep sky and far background apart, whole; ratios then count the rest.
        seed: random seed.
        work: folder for finished levels and checkpoints; the same call resumes from it after Ctrl-C.
        progress: called by all stages.
        say: called with log messages.

    Returns:
        The levels, with exactly round(N/r) Gaussians each.

    Raises:
        InputError: ratios that do not rise, or an unreadable scene or views.
        KeyboardInterrupt: after Ctrl-C; the same call resumes from `work`.

    >>> import numpy as np
    >>> ball = np.random.default_rng(0).normal(size=(800, 3))
    >>> ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    >>> ball = Splats.create(ball, scales=np.full((800, 3), 0.05), logit_opacities=np.full(800, 4))
    >>> [len(level) for level in lod(ball, ratios=(1, 4, 8), steps=3, size=48).splats]
    [800, 200, 100]
    """
    with open_levels(
        scene if isinstance(scene, Splats) else Source(scene, render_model),
        ratios=ratios,
        recover=recover,
        steps=steps,
        background=background,
        split_sky=split_sky,
        seed=seed,
        progress=progress,
        say=say,
        views=views,
        photos=photos,
        size=size,
        beside=beside,
        up=up,
    ) as job:
        return cast("Levels[Splats]", job.run(work))  # not in tiles


def check_ratios(ratios: Numbers) -> None:
    """Reject ratios that do not rise from 1 or more."""
    rising = all(a < b for a, b in pairwise(ratios))
    if not len(ratios) or not rising or not all(1 <= ratio < math.inf for ratio in ratios):
        given = ", ".join(f"{ratio:g}" for ratio in ratios)
        raise InputError(f"expected rising numbers of at least 1, got {given}", parameter="ratios")


@checks_arguments
def save_tileset(
    path: str | Path,
    levels: Sequence[Level],
    *,
    up: Numbers | None = None,
    place: Georeference | str | None = None,
    unit: LengthUnit | None = None,
    cut: Cut | None = None,
    overwrite: bool = False,
    work: Path | None = None,
    progress: Progress = silent,
    say: Say | None = None,
) -> int:
    """Write levels of detail as 3D Tiles 1.1, exactly like the command `g2ard lod --format 3dtiles`.

    A tile's geometric error is 16 standard deviations of its median Gaussian, so that viewers refine it where
    these exceed a pixel at the usual 16 pixels of screen-space error.

    Args:
        path: the output folder, for `tileset.json` and `LEVEL_N.glb`.
        levels: the same scene at several levels, finest first, with equal offsets.
        up: (3,) direction away from the ground; None means z for map coordinates, otherwise an estimate.
        place: where the scene's `offset` lies on the globe, or the name of the map system of its coordinates,
            such as "EPSG:32635". None leaves it at the tileset's origin, z up.
        unit: unit of the scene: m, ft or us-ft; None means that of a map system, otherwise the metre.
        cut: splitting rule of the tree, and the most Gaussians of a tile; None means `Cut()`.
        overwrite: replace files in the folder, and remove files of its previous `tileset.json`.
        work: folder for temporary files, which saves memory.
        progress: called for files written.
        say: called with the place, with an estimated up direction, and with a note if positions are rounded
            by as much as `g2ard.save` would warn of; None only warns of the latter.

    Returns:
        Bytes written.

    Raises:
        InputError: no levels, a level that is empty or not finite, different offsets, or an unknown map
            system.
        OutputError: the folder exists and may not be replaced, or cannot be written.

    >>> import tempfile
    >>> grid = np.stack(np.meshgrid(range(8), range(8), [0]), -1).reshape(-1, 3)
    >>> fine = Splats.create(grid, scales=np.ones((64, 3)))
    >>> folder = Path(tempfile.mkdtemp()) / "tiles"
    >>> size = save_tileset(folder, [fine, fine.take(range(0, 64, 4))], up=(0, 0, 1))
    >>> sorted(path.suffix for path in folder.iterdir() if path.suffix == ".json")
    ['.json']
    """
    told = say or unsaid
    near, *_ = aligned(levels)
    metres = UNITS[unit or "m"]
    if isinstance(place, str):
        system = map_system(place)
        metres = metres_of(system)
        place, name = Georeference.of_map(system, near[0].offset), place
        told(
            f"longitude {place.longitude:.6f}, latitude {place.latitude:.6f}, heading {place.heading:.3f}"
        )
        if is_outside(system, place):
            told(
                f"warning: the scene lies outside the area of {name}; is it in that map system and its unit?"
            )
    elif place is not None:
        told(_describe_extent(near[-1], metres, known=unit is not None))
    size, notes = write_tileset(
        path,
        levels,
        axis=choose_tileset_up(near, None, told) if up is None else up,
        place=place,
        unit=metres,
        cut=cut,
        overwrite=overwrite,
        work=work,
        progress=progress,
    )
    tell(path, notes, say)
    return size


def _describe_extent(coarsest: Level, metres: float, *, known: bool) -> str:
    """Describe the extent of a scene, and warn if it is improbable."""
    some = take_evenly(coarsest, _UP_SAMPLE, floor=True)
    low, high = np.percentile(some.means, (1, 99), axis=0)
    across = metres * float((high - low).max())
    text = (
        f"the scene is {across:,.3g} m across"
        if across < 1000
        else f"the scene is {across:,.0f} m across"
    )
    if not known:
        text += ", if its unit is the metre; --unit ft otherwise"
    return text if _PROBABLE[0] < across < _PROBABLE[1] else f"warning: {text}"


_PROBABLE = 0.1, 20_000.0
"""Least and largest probable extent of a scene on a globe, metres."""


def choose_tileset_up(
    levels: Sequence[Level], up: Numbers | None = None, say: Say = unsaid
) -> Float:
    """Return the (3,) up direction for 3D Tiles: `up`, z in map coordinates, or an estimate."""
    coarse = levels[-1]
    if up is None and coarse.up is None and coarse.offset.any():
        axis = np.array([0.0, 0, 1])
    else:
        axis = up_of(take_evenly(coarse, _UP_SAMPLE, floor=True), up)
    say(f"up is {direction(axis)}" + ("" if up else "; --up X,Y,Z changes it"))
    return axis


_ROWS = 500_000
"""Gaussians of the coarsest level among which the opening view is chosen."""


def write_level_page(
    folder: Path,
    levels: Sequence[Level],
    kind: Literal["sog", "3dtiles"],
    given: GivenViews,
    *,
    background: Colour | None = None,
    source: Source | None = None,
) -> int:
    """Write the page that shows the levels in a folder, and return its bytes.

    Args:
        levels: the levels in the folder, finest first.
        kind: streamed SOG, or 3D Tiles with z up.
        given: see `g2ard.jobs.viewer_frame.choose_frame`. The page's title names the scene, or the folder.
        background: see `g2ard.jobs.viewer_frame.choose_backdrop`.
        source: the source of the scene beside `given`, if it is open.
    """
    few = take_evenly(levels[-1], _ROWS, floor=True)
    frame = choose_frame(few, given)
    finest = take_evenly(levels[0], _ROWS, floor=True)
    of_points = given.beside is not None and is_made_of_points(Path(given.beside), source)
    behind = choose_backdrop(background, [finest], of_points=of_points)
    page = folder / "index.html"
    offset = np.asarray(few.offset)
    title = name_scenes([Path(given.beside or folder)])[0]
    if kind == "sog":
        rotation, position = frame.place(offset, few.axes)
        return write_stream_page(
            page,
            title,
            start=frame.start,
            antialiased=few.antialiased,
            background=behind,
            rotation=rotation,
            position=position,
        )
    reach = float(np.linalg.norm(np.ptp(few.means, axis=0)))
    start = frame.start or Start((0.0, reach / 4, -reach), (0.0, 0.0, 0.0), ((1.0, 60.0),))
    eye, target = (
        (TILE_OF_SCENE @ (frame.world(point) - offset)).tolist()
        for point in (start.position, start.target)
    )
    return write_globe_page(page, title, eye=eye, target=target, fov=start.fov, background=behind)
