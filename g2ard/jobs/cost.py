"""Rough memory of commands that make scenes, from counts alone, for `--dry-run` and `--memory`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from g2ard.errors import InputError
from g2ard.io.sog_write import palette_size
from g2ard.io.tile_store import row_width
from g2ard.jobs.clean import CLUTTER_SIDE, CLUTTER_VIEWS
from g2ard.jobs.memory import RECOVERY_TIMES, TileMemory, format_bytes, whole_bytes
from g2ard.jobs.run_views import limit_pixels
from g2ard.pipeline.distill import plan_round_counts
from g2ard.progress import plural
from g2ard.rendering.targets import CACHE_BYTES
from g2ard.system.threads import threads_used

if TYPE_CHECKING:
    from g2ard.io.stream import SceneStream
    from g2ard.jobs.distill_job import DistillJob
    from g2ard.jobs.simplify import Reduction
    from g2ard.scene.cameras import Cameras
    from g2ard.scene.splats import Splats

_CLEANING_BYTES = 750
"""Bytes per Gaussian of `clean`: 700 to 860 on guitar, playbot and taebak_park/0_0."""
_IMAGE_FILE_BYTES = 6
"""Bytes per pixel of a render of a scene in tiles in its file."""

LARGEST_DENSE = 250_000
"""Largest dense scene that view.html shows beside the result: it adds at most 8 MB of SOG at SH degree 2."""
_PROGRAM_BYTES = 65_000_000
"""Bytes of the interpreter and loaded libraries."""
_KEPT_TIMES = 2.0
"""Memory of the scene and its prepared copy, which stay until the end, as a multiple of its arrays."""
_SURVEY = (35_000_000, 500)
"""Bytes, and bytes per Gaussian of a sample, that planning views or measuring visibility leaves."""
_LOOKS = (20_000_000, 300)
"""Bytes, and bytes per Gaussian of a sample, that the choice of views to show takes beyond what planning left.
Measured without a page on 20,000 to 400,000 Gaussians of SH degree 0 and 3, views given: predictions are 0.79 to
1.21 times the peak."""
_SAMPLE = 150_000
"""Largest sample on which views are planned and chosen."""
_IMAGE_BYTES = 60
"""Bytes per pixel of a view that is rendered and scored, of which every thread of `in_threads` has one."""
_PACKED_BYTES = 200
"""Bytes per Gaussian of packing the viewer page. Measured with the next: 22 and 39 MB for 20,000 Gaussians of
SH degree 1 and 3, 97 for 150,000 of degree 2, 118 for 250,000 of degree 3."""
_PALETTE_BYTES = 1_300
"""Bytes per entry of the page's palette of harmonics, of which there are at most 65,536."""
_TRAINER_TIMES = 4.0
"""Memory of recovery as a multiple of the result's arrays: the parameters, Adam's two moments, and the scene
that is scored. The start and the best scene so far are kept anyway."""
_TRAINER_BYTES = 450
"""Further bytes per Gaussian: anchors, and buffers of the rasteriser if a view sees all."""


def trainer_bytes(count: int, degree: int) -> int:
    """Return the memory of recovering `count` Gaussians of an SH degree, targets excluded."""
    return int(count * (_TRAINER_BYTES + _TRAINER_TIMES * 4 * row_width(degree)))


@dataclass(frozen=True)
class Cost:
    """Rough cost of making a scene.

    Args:
        views: number of views that need a target, including those for scoring.
        pixels: mean of the training views.
        steps: of all recoveries; None if a time limits them.
        bytes: peak memory.
        disk: bytes of temporary files: of a scene in tiles, or of images beyond what memory holds.
    """

    views: int
    pixels: int
    steps: int | None
    bytes: int
    disk: int = 0


def cost_of(job: DistillJob, count: int, *, page: bool = True) -> Cost:
    """Return the cost of distilling a prepared job's scene to `count` Gaussians.

    Args:
        page: whether pages with the result are written.
    """
    train = job.views.train.cameras
    untrained = sum(map(len, job.views.untrained))
    pixels = _mean_pixels(train)
    views = untrained + (len(train) if job.recovers else 0)
    trains = job.recovers and not job.is_kept(count)
    steps: int | None = 0
    if trains:
        steps = None if job.config.recover.recovery_time is not None else job.steps(count)
    memory = _peak_bytes(job, count, page, trains=trains)
    return Cost(views, pixels, steps, memory, _disk_bytes(job, pixels * views, trains=trains))


def cost_of_recovery(
    scene: Splats, views: Sequence[Cameras], steps: int | None, teacher: Splats | None = None
) -> Cost:
    """Return the cost of fitting a scene as it is, by `g2ard recover` or `g2ard adapt`.

    Args:
        views: for training, and others that need a target.
        steps: of the fit; None if a time limits them.
        teacher: scene that renders the targets; None if they are photos.
    """
    dense = 0 if teacher is None else int(_KEPT_TIMES * teacher.nbytes)
    memory = _PROGRAM_BYTES + _target_bytes(views, teacher, CACHE_BYTES) + _image_bytes(views)
    memory += dense + trainer_bytes(len(scene), scene.sh_degree)
    disk = _spilled_bytes(views, teacher, CACHE_BYTES)
    return Cost(sum(map(len, views)), _mean_pixels(views[0]), steps, memory, disk)


def _mean_pixels(cameras: Cameras) -> int:
    return int(cameras.pixels.mean())


def cost_of_reduction(reduce: Reduction, count: int) -> Cost:
    """Return the cost of simplifying a scene to `count` Gaussians; its views measure visibility."""
    seen = reduce.seen if count < reduce.total else None
    views = 0 if seen is None else len(seen)
    plan = reduce.plan
    if plan is not None:
        return Cost(views, 0, 0, plan.bytes, plan.disk)
    degree = reduce.dense.sample.sh_degree
    memory = _PROGRAM_BYTES + whole_bytes(reduce.total, 4 * row_width(degree))
    memory += _sampled(_SURVEY, reduce.total) if views else 0
    return Cost(views, 0, 0, memory)


def cost_of_cleaning(scene: SceneStream, kinds: Sequence[str]) -> Cost:
    """Return the cost of finding some kinds of clutter in a scene, or of only reading it for none."""
    count = scene.count
    if not kinds:
        return Cost(
            0, 0, 0, _PROGRAM_BYTES + int(_KEPT_TIMES * 4 * row_width(scene.sh_degree) * count)
        )
    memory = _PROGRAM_BYTES + _SURVEY[0] + _CLEANING_BYTES * count
    return Cost(CLUTTER_VIEWS, CLUTTER_SIDE**2 * 3 // 4, 0, memory)


def _peak_bytes(job: DistillJob, count: int, page: bool, *, trains: bool) -> int:
    """Return the peak memory: of simplification, of recovery, or of what is written at the end."""
    count = plan_round_counts(job.dense, count, job.config)[0]
    degree = job.sh_degree
    dense = len(job.prior)
    scene = job.prior.nbytes
    small = 4 * row_width(degree) * count
    rows = 0 if job.plan else dense  # that view.html may show
    used = _target_views(job, trains=trains)
    targets = _target_bytes(used, job.prior if job.renders else None, job.teaching.limit)
    kept = _PROGRAM_BYTES + _sampled(_SURVEY, dense) + targets + _image_bytes(used) + 2 * small
    packing = _packing_bytes(count, degree)
    if count < rows <= LARGEST_DENSE:  # shown beside the result
        packing = max(packing, _packing_bytes(dense, job.prior.sh_degree))
    written = _KEPT_TIMES * scene + max(_sampled(_LOOKS, dense), packing if page else 0)
    merging = whole_bytes(dense, 4 * row_width(job.prior.sh_degree))
    held = kept + int(max(merging, scene + trainer_bytes(count, degree), written))
    return held if job.plan is None else max(held, job.plan.bytes)


def _target_views(job: DistillJob, *, trains: bool) -> list[Cameras]:
    """Return the parts of a job's views that have targets of their own."""
    views = job.views
    parts: list[Cameras] = []
    if trains:
        train = views.train.cameras
        chosen = job.config.select.count_of(len(train))
        parts.append(train if chosen == "auto" else train.take(range(min(chosen, len(train)))))
    parts += views.untrained
    if views.twice is not None:
        parts.append(views.twice)
    if views.full is not None:
        parts.append(limit_pixels(views.full))
    return parts


def _disk_bytes(job: DistillJob, pixels: int, *, trains: bool) -> int:
    """Return the bytes of temporary files: of tiles and renders in tiles, or of images beyond what memory holds."""
    if job.plan is not None and job.renders:
        return job.plan.disk + _IMAGE_FILE_BYTES * pixels
    teacher = job.prior if job.renders else None
    spilled = _spilled_bytes(_target_views(job, trains=trains), teacher, job.teaching.limit)
    return spilled if job.plan is None else job.plan.disk + spilled


def _target_bytes(views: Sequence[Cameras], teacher: Splats | None, limit: int) -> int:
    """Return the bytes of targets in memory, at most `limit` per part."""
    return sum(min(limit, size) for size in _image_sizes(views, teacher))


def _spilled_bytes(views: Sequence[Cameras], teacher: Splats | None, limit: int) -> int:
    """Return the bytes of targets that memory does not hold, see `Spill`."""
    return sum(max(0, size - limit) for size in _image_sizes(views, teacher))


def _image_sizes(views: Sequence[Cameras], teacher: Splats | None) -> list[int]:
    """Return the bytes of each part's targets: renders in 16 bits, or photos in 8."""
    pixel = 3 if teacher is None else 6
    return [pixel * int(part.pixels.sum()) for part in views]


def _sampled(cost: tuple[int, int], count: int) -> int:
    """Return the bytes of work on at most `_SAMPLE` of a scene's Gaussians."""
    fixed, per_gaussian = cost
    return fixed + per_gaussian * min(count, _SAMPLE)


def _image_bytes(views: Sequence[Cameras]) -> int:
    """Return the bytes of rendering and scoring as many of the largest views as there are threads."""
    largest = max((int(part.pixels.max()) for part in views if len(part)), default=0)
    return _IMAGE_BYTES * largest * threads_used()


def _packing_bytes(count: int, degree: int) -> int:
    return _PACKED_BYTES * count + (_PALETTE_BYTES * palette_size(count) if degree else 0)


def check_job_memory(job: DistillJob, most: int | None, need: int) -> None:
    """Reject a job that needs more than `most` bytes; None means no limit."""
    if most is None or need <= most:
        return
    count = job.total
    what = f"{plural(count, 'Gaussian')} in one piece take"
    if job.plan is not None:
        largest = plan_round_counts(job.dense, job.budget.count, job.config)[0]
        what = f"recovering {plural(largest, 'Gaussian')} takes"
    message = (
        f"--memory: {what} about {format_bytes(need, ceil=True)}, more than {format_bytes(most)}"
    )
    lower = ", a lower --sh-degree" if job.sh_degree else ""
    message += f"; fewer Gaussians{lower} and smaller views, --size, take less"
    if job.plan is None and job.renders:  # tiles support this job
        tiles = TileMemory(count, 4 * row_width(job.prior.sh_degree), RECOVERY_TIMES)
        message += f"; in tiles {tiles.advice(most, max(1, count // 2))}"
    raise InputError(message)
