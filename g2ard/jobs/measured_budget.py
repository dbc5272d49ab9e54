"""Reductions of a scene, the count that fits a file size or keeps a quality, and what a format costs."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.config.checks import check_seed
from g2ard.errors import InputError
from g2ard.io import read_splats, write_splats
from g2ard.io.scene_formats import check_positions, scene_format, written_bytes
from g2ard.io.types import Note
from g2ard.jobs.budget import Budget
from g2ard.jobs.inputs import Views, say_regions
from g2ard.jobs.views import cameras_for_weights
from g2ard.poses import plan_pool
from g2ard.progress import Progress, Say, plural, silent, unsaid
from g2ard.rendering.metrics import psnr, ssim
from g2ard.rendering.renderer import Renderer
from g2ard.rendering.visibility import SampledVisibility, overdraw, visibility_source
from g2ard.report.run import Packed
from g2ard.scene.cameras import Cameras
from g2ard.scene.samples import evenly_spaced
from g2ard.scene.splats import Splats
from g2ard.scene.transform import change_of_axes, with_axes
from g2ard.stages.simplify import Pairs, SimplifyConfig, VisibilitySource, simplify
from g2ard.system.cached import cached_property

_QUALITY_VIEWS, _QUALITY_SIDE = 12, 400
"""Number of views in which quality is measured, and their longer side in pixels."""
_POOL_SAMPLE = 100_000
"""Gaussians that those views are planned on."""
_PROBE_ROWS = 4096
"""Gaussians of the first probe file, which estimates the bytes per Gaussian."""
_BYTES_PROBES, _BYTES_ACCEPTED, _BYTES_GOAL = 6, 0.98, 0.99
"""Most files written to find a count for bytes; shares of the bytes that are accepted and sought."""
_BYTES_SAFETY = 0.985
"""Safety factor on the bytes if recovery will change the scene after the search."""
_QUALITY_TRIALS = 8
"""Most counts at which quality is measured."""
_QUALITY_TOLERANCE = 0.25
"""Excess in dB at which the search stops."""
_GAIN_PER_DOUBLING = 4.0
"""Expected gain in dB for twice the Gaussians, until two counts are measured."""
_NEAR_VIEWS, _NEAR_POOL, _NEAR_SIZE, _NEAR_ROWS = 6, 16, (320, 240), 50_000
"""Near views, poses that they step from, their pixels, and the Gaussians they are planned by."""
_WARNED_LOSS, _INVISIBLE_LOSS_PSNR = 1.0, 45.0
"""Loss that is worth a warning, and the PSNR above which nobody sees it, dB."""
_GOOD_PSNR = 35.0
"""PSNR of a good scene, to which the difference between two scenes is related, dB."""
_LOSS_VIEWS, _LOSS_SIZE, _LOSS_ROWS = 4, (400, 300), 100_000
"""Generated views to compare in: their number, pixels, and the Gaussians they are planned by."""
_MOST_COMPARED_GAUSSIANS = 2_000_000
"""Gaussians above which scenes are not compared."""
_FEWEST_GAUSSIANS = 64
"""Smallest count that a search tries."""
_LAYER_TRIALS = 8
"""Most counts at which overdraw is measured."""


@dataclass(eq=False)
class Reduction:
    """Reductions of one scene to any budget: count → `Simplified`, as `simplify` returns it.

    Poses and visibility are computed once, and the last two results are cached. Other arguments and errors
    are those of `simplify`.

    Args:
        cameras: cameras that give visibility weights to every method, instead of `views`.
        recovered: whether the results are recovered afterwards, so that their gaps are not measured.
        notes: notes on the scene's file.
        tiles: the scene, if it is in tiles; `splats` is then a sample.
    """

    splats: Splats
    views: Views | None = None
    cameras: Cameras | None = None
    blind: bool = False
    config: SimplifyConfig = field(default_factory=SimplifyConfig)
    beside: str | Path | None = None
    up: Sequence[float] | None = None
    seed: int = 0
    recovered: bool = False
    notes: Sequence[Note] = ()
    progress: Progress = silent
    say: Say = unsaid
    _made: dict[int, Any] = field(default_factory=dict)
    tiles: Any = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        check_seed("seed", self.seed)
        if self.views is not None and self.blind:
            raise InputError("views and blind exclude each other")
        if self.views is not None and self.config.method == "paper":
            raise InputError("has no effect on the method paper", parameter="views")
        weighed = self.cameras is not None or self.views is not None or self.config.method == "default"
        if isinstance(self.config, Pairs):
            if self.config.pixel_scale != Pairs.pixel_scale and weighed and not self.blind:
                raise InputError("has no effect with views", parameter="simplify.pixel_scale")
            if self.config.dilation != Pairs.dilation and self.splats.antialiased:
                raise InputError("has no effect on antialiased scenes", parameter="simplify.dilation")
        if self.tiles is None:
            say_regions(self.splats, self.config, "the scene", self.say)
        else:
            say_regions(self.splats, self.config, "a sample of the scene", unsaid)

    @property
    def total(self) -> int:
        """Gaussians of the scene."""
        return len(self.splats) if self.tiles is None else int(self.tiles.plan.count)

    def __call__(self, count: int) -> Any:
        if count not in self._made:
            self._made = dict([*self._made.items(), (count, self.made(count))][-2:])
        return self._made[count]

    def made(self, count: int) -> Any:
        """Simplify the scene."""
        if self.tiles is not None:
            return self.tiles.simplified(count, self.seen if count < self.total else None, self.config)
        return simplify(
            self.splats,
            count,
            visibility=self._visibility if count < self.total else None,
            gaps=not self.recovered,
            config=self.config,
            progress=self.progress,
        )

    @cached_property
    def seen(self) -> Cameras | None:
        """Views that weigh Gaussians by visibility."""
        if self.blind or self.cameras is not None:
            return None if self.blind else self.cameras
        return cameras_for_weights(
            self.splats,
            self.views,
            self.config.method,
            beside=self.beside,
            up=self.up,
            seed=self.seed,
            represents=self.total / len(self.splats),
            progress=self.progress,
            say=self.say,
        )

    @cached_property
    def _visibility(self) -> VisibilitySource | None:
        if self.seen is None:
            return None
        source = visibility_source(self.seen, progress=self.progress)
        return _Remembering(source, source.views)

    def resolved(self, budget: Budget, name: str, file: str, sh_degree: int | None = None) -> ResolvedBudget:
        """Resolve a budget for the scene, called `name` in errors.

        If recovery follows, bytes are searched with the method `fast` and a margin.

        Args:
            file: a file name; its suffix is the format for `Budget.fit`.
            sh_degree: of the result; None is the scene's.
        """
        splats, say = self.splats, self.say
        if self.tiles is not None:
            return resolved_in_tiles(budget, self.total, splats, name, file, say)
        if budget.min_psnr is not None or budget.min_ssim is not None:
            return self._resolved_for_quality(Quality(budget.min_psnr or 0.0, budget.min_ssim or 0.0), file)

        def tried(count: int) -> Splats:
            small = simplify(splats, count, method="fast") if self.recovered else self(count)
            return small.splats

        if budget.bytes is not None:
            if sh_degree is not None:
                splats = splats.with_sh_degree(sh_degree)
            most = int(budget.bytes * _BYTES_SAFETY) if self.recovered else budget.bytes
            found = count_for_bytes(splats, most, file, tried)
        else:
            found = budget.of(len(splats), name)
            check_positions(file, splats, found)
        if budget.layers is not None:
            whole = found
            found, layers = count_for_layers(whole, budget.layers, tried)
            if found < whole:
                say(
                    f"{budget.fit}: near views blend more than {budget.layers} Gaussians per pixel at "
                    f"{whole:,}, {layers:.0f} at {found:,}"
                )
        if budget.fit is not None:
            fits = plural(found, "Gaussian") if budget.bytes is None else f"about {plural(found, 'Gaussian')}"
            all_fit = f"nothing to do, all {plural(found, 'Gaussian')} already fit"
            say(f"{budget.fit}: {all_fit if found == len(splats) else fits}")
        return ResolvedBudget(found, budget.bytes, file)

    def _resolved_for_quality(self, wanted: Quality, file: str) -> ResolvedBudget:
        """Find the count that keeps a quality in generated views, as read back from the format of `file`."""
        splats = self.splats
        pool = plan_pool(splats, _QUALITY_VIEWS, seed=self.seed, rows=_POOL_SAMPLE, progress=self.progress)
        cameras = pool.cameras.resized(_QUALITY_SIDE)

        def reduce(count: int) -> Splats:
            small = as_file(self(count).splats, file)
            self.progress("quality", 0, 0)
            return small

        found, near = count_for_quality(splats, wanted, cameras, reduce)
        if found == len(splats):
            self.say(f"no smaller count was found that keeps the quality; keeping all {found:,} Gaussians")
        else:
            stage = " before recovery" if self.recovered else ""
            views = plural(len(cameras), "view")
            self.say(
                f"{plural(found, 'Gaussian')} keep {near}{stage}, in {views} generated to choose the count"
            )
        return ResolvedBudget(found, file=file, wanted=wanted, dense=splats, cameras=cameras)


class _Remembering:
    """A source of visibility that keeps that of its first scene, with which every reduction starts."""

    def __init__(self, source: VisibilitySource, views: Cameras) -> None:
        self.source, self.views = source, views
        self.first: tuple[Splats, SampledVisibility] | None = None

    def __call__(self, scene: Splats) -> SampledVisibility:
        if self.first is not None and _same(self.first[0], scene):
            return self.first[1]
        seen = self.source(scene)
        if self.first is None:
            self.first = scene, seen
        return seen


def _same(a: Splats, b: Splats) -> bool:
    """Return whether two scenes share their geometry arrays; scales are clamped anew by each reduction."""
    return all(getattr(a, name) is getattr(b, name) for name in ("means", "quats", "logit_opacities"))


@dataclass(frozen=True)
class Quality:
    """Mean PSNR (dB) and SSIM against the dense scene's renders; as a requirement, 0 asks for nothing."""

    psnr: float
    ssim: float

    def __str__(self) -> str:
        """Format what is not 0.

        >>> str(Quality(38, 0)), str(Quality(38.154, 0.98))
        ('38.00 dB', '38.15 dB, SSIM 0.9800')
        """
        parts = {f"{self.psnr:.2f} dB": self.psnr, f"SSIM {self.ssim:.4f}": self.ssim}
        return ", ".join(text for text, value in parts.items() if value)

    def meets(self, wanted: Quality) -> bool:
        """Return whether both values are reached."""
        return self.psnr >= wanted.psnr and self.ssim >= wanted.ssim

    def over(self, wanted: Quality) -> float:
        """Return the smaller excess, dB, of PSNR and −10 log₁₀(1 − SSIM); ∞ if nothing is wanted."""
        ssims = (max(1 - value, 1e-9) for value in (wanted.ssim, self.ssim))
        of_ssim = 10 * math.log10(next(ssims) / next(ssims)) if wanted.ssim > 0 else math.inf
        return min(self.psnr - wanted.psnr if wanted.psnr > 0 else math.inf, of_ssim)


def file_bytes(splats: Splats, name: str, **options: Any) -> int:
    """Return the bytes of the scene as `write_splats` writes it under `name`."""
    with _written(splats, name, **options) as path:
        return written_bytes(path)


def as_file(splats: Splats, name: str) -> Splats:
    """Return the scene as read back from the format of `name`: quantised and without unsupported fields."""
    if scene_format(name).suffix in (".ply", ".usda", ".usdc"):
        return splats
    with _written(splats, name) as path:
        return read_splats(path)


@contextmanager
def _written(splats: Splats, name: str, **options: Any) -> Iterator[Path]:
    """Yield a temporary file of the scene in the format of `name`."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene" / "meta.json"
        if scene_format(name).function == "write":
            path = Path(folder) / f"scene{scene_format(name).suffix}"
        write_splats(path, splats, **options)
        yield path


def resolved_in_tiles(
    budget: Budget, total: int, sample: Splats, name: str, file: str, say: Say
) -> ResolvedBudget:
    """Resolve a budget for `total` Gaussians in tiles; `needs_whole` rejects those that need to measure them.

    Args:
        sample: some of them, with the SH degree of the result.
        file: name of a .ply, in which all Gaussians take as many bytes.
    """
    if budget.layers is not None:
        say(f"note: {budget.fit}: in tiles, Gaussians per pixel of near views are not measured")
    if budget.bytes is None:
        return ResolvedBudget(budget.of(total, name))
    one, two = (file_bytes(sample.take(np.arange(rows)), file) for rows in (1, 2))
    header = one - (two - one) + len(str(total))
    count = min(total, (budget.bytes - header) // (two - one))
    if count < 1:
        raise InputError(f"{budget.bytes:,} bytes are too few; a Gaussian takes {one:,}", path=file)
    say(f"{budget.fit}: {plural(count, 'Gaussian')}")
    return ResolvedBudget(count, budget.bytes, file)


def count_for_bytes(splats: Splats, wanted: int, name: str, reduce: Callable[[int], Splats]) -> int:
    """Return approximately the most Gaussians whose file has at most `wanted` bytes.

    A sample's bytes per Gaussian give the first count. Files of the scene reduced to trial counts then
    bracket the result, until one fills 98 % of the bytes.
    """
    fewest, most = min(_FEWEST_GAUSSIANS, len(splats)), len(splats)
    sample = splats.take(np.array(evenly_spaced(most, _PROBE_ROWS, floor=True)))
    count = int(len(sample) * wanted / file_bytes(sample, name))
    fits, over = (0, 0), (most + 1, 0)  # (count, bytes); 0 bytes means no such file yet
    files: list[tuple[int, int]] = []
    while len(files) < _BYTES_PROBES or not fits[0]:
        count = min(max(count, fits[0] + 1, fewest), over[0] - 1, most)
        size = file_bytes(reduce(count) if count < most else splats, name)
        files.append((count, size))
        if size <= wanted:
            fits = (count, size)
            if size >= _BYTES_ACCEPTED * wanted or count == most:
                break
        else:
            over = (count, size)
            if count == fewest:
                raise InputError(
                    f"{wanted:,} bytes are too few; {count:,} Gaussians take {size:,}", path=name
                )
        if over[0] - fits[0] <= 1:
            break
        if fits[0] and over[1]:  # file sizes grow in steps, so interpolate with limits
            share = (_BYTES_GOAL * wanted - fits[1]) / (over[1] - fits[1])
            count = round(fits[0] + min(max(share, 0.1), 0.9) * (over[0] - fits[0]))
        else:
            near = count * _BYTES_GOAL * wanted / size
            if len(files) > 1 and (slope := _slope(*files[-2:])) > 0:  # a file has a head too
                near = count + (_BYTES_GOAL * wanted - size) / slope
            count = int(min(max(near, count / 4), 4 * count))
    return fits[0]


def _slope(before: tuple[int, int], after: tuple[int, int]) -> float:
    return (after[1] - before[1]) / (after[0] - before[0])


def count_for_layers(count: int, most: float, reduce: Callable[[int], Splats]) -> tuple[int, float]:
    """Return a count up to `count` whose near views blend at most `most` Gaussians per pixel, and their mean.

    Overdraw falls about with the square root of the count, which predicts the next one. The mean exceeds
    `most` if no count tried is small enough; it is 0 for a scene without near views.
    """
    for _ in range(_LAYER_TRIALS):
        near = close_up(reduce(count))
        layers = 0.0 if near is None else near["mean"]
        if layers <= most or count <= _FEWEST_GAUSSIANS:
            break
        count = max(_FEWEST_GAUSSIANS, int(count * min((_BYTES_GOAL * most / layers) ** 2, 0.95)))
    return count, layers


def close_up(splats: Splats) -> dict[str, float] | None:
    """Return the mean Gaussians per pixel with α ≥ 1/255 over six near views, and in the worst; None for a
    scene without a place for them.

    Near views stand where what they look at has a standard deviation of about 1.5 pixels, at a quarter to six
    tenths of the distance of usual ones. A headset draws such views when its wearer steps closer.
    """
    try:
        near = plan_pool(splats, _NEAR_POOL, size=_NEAR_SIZE, rows=_NEAR_ROWS).more("near", _NEAR_VIEWS)
    except InputError:
        return None
    found = [overdraw(splats, Cameras.of([view])) for view in near]
    return {"mean": sum(found) / len(found), "worst": max(found)} if found else None


def _images(splats: Splats, cameras: Cameras) -> list[NDArray[Any]]:
    renderer = Renderer(splats)
    return [renderer.clipped(camera) for camera in cameras]


def quality(renders: list[Any], splats: Splats, cameras: Cameras) -> Quality:
    """Return the quality of a scene against images in [0, 1], one per camera."""
    pairs = list(zip(_images(splats, cameras), renders, strict=True))
    return Quality(
        float(np.mean([psnr(image, target) for image, target in pairs])),
        float(np.mean([ssim(image, target) for image, target in pairs])),
    )


def count_for_quality(
    splats: Splats, wanted: Quality, cameras: Cameras, reduce: Callable[[int], Splats]
) -> tuple[int, Quality]:
    """Return approximately the fewest Gaussians that keep a quality in these views, and their quality.

    They are all if no smaller count tried keeps it.

    The excess in dB over the wanted quality is nearly linear in the logarithm of the count. The search starts
    at a quarter of the scene, follows the slope, then interpolates between counts on both sides, until the
    excess is at most 0.25 dB.

    Args:
        reduce: count → scene, by the method that makes the result.
    """
    renders = _images(splats, cameras)
    met, good, missed = len(splats), Quality(float("inf"), 1.0), 0
    excesses: dict[int, float] = {}
    count = max(_FEWEST_GAUSSIANS, len(splats) // 4)
    while len(excesses) < _QUALITY_TRIALS and missed < count < met:
        measured = quality(renders, reduce(count), cameras)
        excesses[count] = excess = measured.over(wanted)
        if excess >= 0:
            met, good = count, measured
        else:
            missed = count
        if 0 <= excess <= _QUALITY_TOLERANCE or met <= _FEWEST_GAUSSIANS:
            break
        count = _next_count(excesses, met, missed, len(splats))
    return met, good


def _next_count(excesses: Mapping[int, float], met: int, missed: int, most: int) -> int:
    """Predict the count whose excess is half the tolerance.

    Args:
        excesses: excess in dB of the counts measured so far.
        met: smallest count that keeps the quality, `most` until one does.
        missed: largest count that does not, 0 until one does not.
    """
    goal = _QUALITY_TOLERANCE / 2
    if missed and met < most:  # interpolate between them; otherwise extrapolate from the only known side
        share = (goal - excesses[missed]) / max(excesses[met] - excesses[missed], 1e-12)
        return round(missed * (met / missed) ** min(max(share, 0.05), 0.95))
    near = met if met < most else missed
    (a, at_a), (b, at_b) = min(excesses.items()), max(excesses.items())
    slope = (at_b - at_a) / math.log2(b / a) if b > a else _GAIN_PER_DOUBLING
    steps = (goal - excesses[near]) / max(slope, _GAIN_PER_DOUBLING / 4)
    # Extrapolation is unreliable, and towards N the excess grows faster than linearly.
    highest = math.sqrt(near * most) if met == most else most
    return max(_FEWEST_GAUSSIANS, round(min(near * 2 ** min(max(steps, -3.0), 3.0), highest)))


@dataclass(frozen=True, eq=False)
class ResolvedBudget:
    """Budget resolved for a scene.

    Args:
        bytes: largest size of the result's file; None for no limit.
        file: a file name; its suffix is the format.
        wanted: quality to keep; None for no requirement.
    """

    count: int
    bytes: int | None = None
    file: str = "scene.ply"
    wanted: Quality | None = None
    dense: Splats | None = None
    cameras: Cameras | None = None

    def shrink(self, splats: Splats, say: Say = unsaid) -> Splats:
        """Merge the scene further while its file is too large."""
        while self.bytes is not None and (size := file_bytes(splats, self.file)) > self.bytes:
            fewer = max(1, int(len(splats) * self.bytes / size * 0.99))
            if fewer == len(splats):
                break
            say(f"{size:,} bytes are too many: merging {len(splats):,} to {plural(fewer, 'Gaussian')}")
            splats = simplify(splats, fewer, method="fast").splats
        return splats

    def judge(self, splats: Splats) -> tuple[bool, str] | None:
        """Return whether a result keeps the quality, with a message; None if no quality is required."""
        if self.wanted is None:
            return None

        assert self.dense is not None
        assert self.cameras is not None
        got = quality(_images(self.dense, self.cameras), as_file(splats, self.file), self.cameras)
        count, views = plural(len(splats), "Gaussian"), plural(len(self.cameras), "view")
        line = f"{count} keep {got} in the {views} that chose the count"
        if got.meets(self.wanted):
            return True, f"{line}; requested: {self.wanted}"
        more = f"request a count above {len(splats):,}"
        if len(splats) >= len(self.dense):
            more = f"{scene_format(self.file).suffix} cannot store more quality"
        return False, f"{line}, less than the requested {self.wanted}; {more}"


def score_lines(packed: Packed, size: int, unpacked: float, pixels: str) -> list[str]:
    """Return a packed file's size in bytes and score beside that of the unpacked scene, and a warning if its
    loss is large and visible. `pixels` is the size of the views.

    >>> score_lines(Packed("scene.sog", 37.86, 0.9), 1_310_000, 37.94, "800×600 px")
    ['scene.sog: 1.31 MB, 37.9 dB in held-out views, 800×600 px (37.9 as .ply)']
    >>> len(score_lines(Packed("scene.sog", 58.6, 0.9), 1_310_000, 62.6, "800×600 px"))
    1
    """
    name, lost = packed.file, unpacked - packed.psnr
    scores = f"{packed.psnr:.1f} dB in held-out views, {pixels} ({unpacked:.1f} as .ply)"
    lines = [f"{name}: {size / 1e6:.2f} MB, {scores}"]
    if lost > _WARNED_LOSS and packed.psnr < _INVISIBLE_LOSS_PSNR:
        lines.append(f"warning: {name}: the format costs {lost:.1f} dB; {_better(name)}")
    return lines


def loss_warning(path: Path, splats: Splats, options: dict[str, Any]) -> str | None:
    """Compare a written file with its scene in a few small generated views; return a warning if a scene of
    35 dB would lose more than 1 dB.

    Nothing is compared if the format is exact, the scene is large or no view shows it.
    """
    if not (scene_format(path).lossy or options.get("compress")) or len(splats) > _MOST_COMPARED_GAUSSIANS:
        return None
    try:
        cameras = plan_pool(splats, _LOSS_VIEWS, size=_LOSS_SIZE, rows=_LOSS_ROWS).cameras
    except InputError:
        return None
    stored = read_splats(path)
    if options.get("axes") == "RDF" and options.get("spz_version", 3) != 4:  # unnamed, so read as RUB
        stored = with_axes(stored, change_of_axes("RDF", "RUB"))
    away = quality(_images(splats, cameras), stored, cameras).psnr
    lowered = -10 * float(np.log10(10 ** (-_GOOD_PSNR / 10) + 10 ** (-away / 10)))
    if _GOOD_PSNR - lowered <= _WARNED_LOSS:
        return None
    return (
        f"warning: {path}: renders are {away:.1f} dB PSNR from the original's, which lowers a score of "
        f"{_GOOD_PSNR:.0f} dB to {lowered:.1f}; {_better(path.name)}"
    )


def _better(name: str) -> str:
    """Name formats that lose less than that of a file."""
    close = name.lower().endswith((".sog", "meta.json", ".compressed.ply"))
    return ".ply loses nothing" if close else ".sog loses less, .ply nothing"
