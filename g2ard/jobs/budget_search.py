"""Search for the count that fits a file size, keeps a quality or limits overdraw."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from g2ard.arrays import Values
from g2ard.errors import InputError
from g2ard.io import write_splats
from g2ard.io.scene_formats import scene_format, written_bytes
from g2ard.io.scenes import read_back
from g2ard.io.stream import PartsStream
from g2ard.pipeline.dense import load_whole
from g2ard.progress import Say, plural, unsaid
from g2ard.rendering.metrics import psnr, ssim
from g2ard.rendering.renderer import Renderer
from g2ard.scene.cameras import Cameras
from g2ard.scene.samples import take_evenly
from g2ard.scene.splats import Splats
from g2ard.stages.simplify import simplify

_PROBE_ROWS = 4096
"""Gaussians of the first probe file, which estimates the bytes per Gaussian."""
_BYTES_PROBES = 6
"""Most files written to find a count for bytes."""
_BYTES_ACCEPTED = 0.98
"""Least share of the bytes that is accepted."""
_BYTES_GOAL = 0.99
"""Share of the bytes that is sought."""
_QUALITY_TRIALS = 8
"""Most counts at which quality is measured."""
_QUALITY_TOLERANCE = 0.25
"""Excess in dB at which the search stops."""
_GAIN_PER_DOUBLING = 4.0
"""Expected gain in dB for twice the Gaussians, until two counts are measured."""
_FEWEST_GAUSSIANS = 64
"""Smallest count that a search tries."""
_LAYER_TRIALS = 8
"""Most counts at which overdraw is measured."""


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


def measure_file(splats: Splats, name: str, **options: Any) -> int:
    """Return the bytes of the scene as `write_splats` writes it under `name`."""
    with _write_temporarily(splats, name, **options) as path:
        return written_bytes(path)


def pass_through_file(splats: Splats, name: str) -> Splats:
    """Return the scene as read back from the format of `name`: quantised and without unsupported fields."""
    if not scene_format(name).loss:
        return splats
    with _write_temporarily(splats, name) as path:
        return read_back(path, splats)


@contextmanager
def _write_temporarily(splats: Splats, name: str, **options: Any) -> Iterator[Path]:
    """Yield a temporary file of the scene in the format of `name`."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene" / "meta.json"
        if scene_format(name).function == "write":
            path = Path(folder) / f"scene{scene_format(name).suffix}"
        write_splats(path, splats, **options)
        yield path


def find_count_for_bytes(
    splats: Splats,
    wanted: int,
    name: str,
    reduce: Callable[[int], Splats] | None,
    total: int | None = None,
) -> int:
    """Return approximately the most Gaussians whose file has at most `wanted` bytes.

    A sample's bytes per Gaussian give the first count. Files of the scene reduced to trial counts then
    bracket the result, until one fills 98 % of the bytes.

    Args:
        reduce: reduces the scene to a count; None takes the first count, without trials.
        total: Gaussians of the scene, if `splats` is a sample of it. All of a .ply take as many bytes, so no
            trial is needed.
    """
    most = total or len(splats)
    fewest = min(_FEWEST_GAUSSIANS, most)
    if total is not None and scene_format(name).suffix == ".ply":
        return _find_count_of_ply(splats, wanted, name, most)
    sample = take_evenly(splats, _PROBE_ROWS, floor=True)
    count = int(len(sample) * wanted / measure_file(sample, name))
    if reduce is None:
        return min(max(count, fewest), most)
    goal = _BYTES_GOAL * wanted
    fits = small = 0  # largest count that fits, and its bytes
    over = most + 1  # smallest count that does not
    large = 0  # its bytes; 0 means no such file yet
    before: tuple[int, int] | None = None  # count and bytes of the file before
    files = 0
    while files < _BYTES_PROBES or not fits:
        files += 1
        count = min(max(count, fits + 1, fewest), over - 1, most)
        size = measure_file(reduce(count) if count < most else splats, name)
        if count == most:
            size = size * most // len(splats)  # of a sample
        if size <= wanted:
            fits = count
            small = size
            if size >= _BYTES_ACCEPTED * wanted or count == most:
                break
        else:
            over = count
            large = size
            if count == fewest:
                raise InputError(
                    f"{wanted:,} bytes are too few; {count:,} Gaussians take {size:,}", path=name
                )
        gap = over - fits
        if gap <= 1:
            break
        tried = count, size
        if fits and large:  # file sizes grow in steps, so interpolate with limits
            share = (goal - small) / (large - small)
            count = round(fits + min(max(share, 0.1), 0.9) * gap)
        else:
            near = count * _BYTES_GOAL * wanted / size
            slope = 0.0 if before is None else (size - before[1]) / (count - before[0])
            if slope > 0:  # a file has a head too
                near = count + (goal - size) / slope
            count = int(min(max(near, count / 4), 4 * count))
        before = tried
    return fits


def _find_count_of_ply(splats: Splats, wanted: int, name: str, most: int) -> int:
    one, two = (measure_file(splats.take(np.arange(rows)), name) for rows in (1, 2))
    header = one - (two - one) + len(str(most))
    count = min(most, (wanted - header) // (two - one))
    if count < 1:
        raise InputError(f"{wanted:,} bytes are too few; a Gaussian takes {one:,}", path=name)
    return count


def find_count_for_layers(
    count: int, most: float, reduce: Callable[[int], Splats]
) -> tuple[int, float]:
    """Return a count up to `count` whose near views blend at most `most` Gaussians per pixel, and their mean.

    Overdraw falls about with the square root of the count, which predicts the next one. The mean exceeds
    `most` if no count tried is small enough; it is 0 for a scene without near views.
    """
    from g2ard.jobs.close_up import close_up  # loads planning, which others do not need

    for _ in range(_LAYER_TRIALS):
        near = close_up(reduce(count))
        layers = 0.0 if near is None else near["mean"]
        if layers <= most or count <= _FEWEST_GAUSSIANS:
            break
        count = max(_FEWEST_GAUSSIANS, int(count * min((_BYTES_GOAL * most / layers) ** 2, 0.95)))
    return count, layers


def render_clipped(splats: Splats, cameras: Cameras) -> list[Values]:
    renderer = Renderer(splats)
    return [renderer.clipped(camera) for camera in cameras]


def measure_quality(renders: list[Any], splats: Splats, cameras: Cameras) -> Quality:
    """Return the quality of a scene against images in [0, 1], one per camera."""
    pairs = list(zip(render_clipped(splats, cameras), renders, strict=True))
    return Quality(
        float(np.mean([psnr(image, target) for image, target in pairs])),
        float(np.mean([ssim(image, target) for image, target in pairs])),
    )


def find_count_for_quality(
    renders: list[Values],
    total: int,
    wanted: Quality,
    cameras: Cameras,
    reduce: Callable[[int], Splats],
) -> tuple[int, Quality]:
    """Return approximately the fewest Gaussians that keep a quality in these views, and their quality.

    They are all if no smaller count tried keeps it.

    The excess in dB over the wanted quality is nearly linear in the logarithm of the count. The search starts
    at a quarter of the scene, follows the slope, then interpolates between counts on both sides, until the
    excess is at most 0.25 dB.

    Args:
        renders: images of the scene in these views.
        total: number of its Gaussians.
        reduce: count → scene, by the method that makes the result.
    """
    met = total
    good = Quality(float("inf"), 1.0)
    missed = 0
    excesses: dict[int, float] = {}
    count = max(_FEWEST_GAUSSIANS, total // 4)
    while len(excesses) < _QUALITY_TRIALS and missed < count < met:
        measured = measure_quality(renders, reduce(count), cameras)
        excesses[count] = excess = measured.over(wanted)
        if excess >= 0:
            met = count
            good = measured
        else:
            missed = count
        if 0 <= excess <= _QUALITY_TOLERANCE or met <= _FEWEST_GAUSSIANS:
            break
        count = _predict_count(excesses, met, missed, total)
    return met, good


def _predict_count(excesses: Mapping[int, float], met: int, missed: int, most: int) -> int:
    """Predict the count whose excess is half the tolerance.

    Args:
        excesses: excess in dB of the counts measured so far.
        met: smallest count that keeps the quality, `most` until one does.
        missed: largest count that does not, 0 until one does not.
    """
    goal = _QUALITY_TOLERANCE / 2
    # interpolate between them; otherwise extrapolate from the only known side
    if missed and met < most:
        share = (goal - excesses[missed]) / max(excesses[met] - excesses[missed], 1e-12)
        return round(missed * (met / missed) ** min(max(share, 0.05), 0.95))
    near = met if met < most else missed
    a, at_a = min(excesses.items())
    b, at_b = max(excesses.items())
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
        renders: images of the dense scene in the views `cameras`, and the number of its Gaussians, `total`.
    """

    count: int
    bytes: int | None = None
    file: str = "scene.ply"
    wanted: Quality | None = None
    renders: list[Values] = field(default_factory=list)
    cameras: Cameras | None = None
    total: int = 0

    def shrink(self, splats: Splats, say: Say = unsaid) -> Splats:
        """Merge the scene further while its file is too large."""
        while self.bytes is not None and (size := measure_file(splats, self.file)) > self.bytes:
            fewer = max(1, int(len(splats) * self.bytes / size * 0.99))
            if fewer == len(splats):
                break
            say(
                f"{size:,} bytes are too many: merging {len(splats):,} to {plural(fewer, 'Gaussian')}"
            )
            splats = simplify(splats, fewer, method="fast").splats
        return splats

    def judge(self, splats: Splats | PartsStream) -> tuple[bool, str] | None:
        """Return whether a result keeps the quality, with a message; None if no quality is required."""
        if self.wanted is None:
            return None

        assert self.cameras is not None
        got = measure_quality(
            self.renders, pass_through_file(load_whole(splats), self.file), self.cameras
        )
        count = plural(len(splats), "Gaussian")
        views = plural(len(self.cameras), "view")
        line = f"{count} keep {got} in the {views} that chose the count"
        if got.meets(self.wanted):
            return True, f"{line}; requested: {self.wanted}"
        more = f"request a count above {len(splats):,}"
        if len(splats) >= self.total:
            more = f"{scene_format(self.file).suffix} cannot store more quality"
        return False, f"{line}, less than the requested {self.wanted}; {more}"
