"""How many Gaussians fit what people ask for: bytes of a file, a device, a quality."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from g2ard.cameras import Cameras
from g2ard.errors import InputError
from g2ard.metrics import psnr, ssim
from g2ard.render import Renderer
from g2ard.splats import Splats

__all__ = ["DEVICES", "Quality", "count_for_bytes", "count_for_quality", "file_bytes", "quality"]

DEVICES = {"quest3": 400_000, "mobile": 1_000_000, "web": 2_000_000}
"""Gaussians that run smoothly: what users of Quest 3 report; PlayCanvas' defaults for streamed scenes, on
phones and in desktop browsers."""

_SAMPLE = 4096
_MARGIN = 0.985
"""Of the bytes asked for: merged scenes pack a little better or worse than the probe."""
_PROBES, _CLOSE = 2, 0.05
_STEP = 0.65
"""Share of the Gaussians between looks at the quality."""
_FEWEST = 64


@dataclass(frozen=True)
class Quality:
    """Mean PSNR (dB) and SSIM against the dense scene's renders."""

    psnr: float
    ssim: float

    def meets(self, wanted: Quality) -> bool:
        """Whether both are reached."""
        return self.psnr >= wanted.psnr and self.ssim >= wanted.ssim


Reduce = Callable[[Splats, int], Splats]
"""A scene and a count → a scene of that count."""


def file_bytes(splats: Splats, name: str, **options: Any) -> int:
    """Bytes of the scene as `write_splats` writes it under `name`."""
    from g2ard.io import write_splats
    from g2ard.io.scene_formats import scene_format

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene" / "meta.json"
        if scene_format(name).function == "write":
            path = Path(folder) / f"scene{scene_format(name).suffix}"
        write_splats(path, splats, **options)
        return sum(file.stat().st_size for file in Path(folder).rglob("*") if file.is_file())


def count_for_bytes(splats: Splats, wanted: int, name: str, reduce: Reduce) -> int:
    """About the most Gaussians whose file has at most `wanted` bytes.

    A sample's bytes per Gaussian give a first count, a real write of the scene reduced to it a better one; a
    second write follows only where that is far off.

    Args:
        splats: the dense scene.
        wanted: bytes.
        name: of the file; its suffix is the format.
        reduce: a fast way to reduce it, for the probe.

    Raises:
        InputError: not even a few Gaussians fit.
    """
    sample = splats.take(np.unique(np.linspace(0, len(splats) - 1, min(len(splats), _SAMPLE)).astype(int)))
    before = (len(sample), file_bytes(sample, name))
    count = _count(before, (0, 0), wanted)
    for _ in range(_PROBES):
        count = min(max(count, min(_FEWEST, len(splats))), len(splats))
        probe = (count, file_bytes(reduce(splats, count) if count < len(splats) else splats, name))
        if count == len(splats) and probe[1] <= wanted:
            return count
        count = _count(probe, before, wanted)
        before = probe
        if abs(count / probe[0] - 1) < _CLOSE:
            break
    if count < min(_FEWEST, len(splats)):
        raise InputError(f"{name}: {wanted:,} bytes hold hardly a Gaussian; {probe[1]:,} hold {probe[0]:,}")
    return min(count, len(splats))


def _count(a: tuple[int, int], b: tuple[int, int], wanted: int) -> int:
    """Where the line through two (count, bytes) reaches the bytes, with a margin; through one and the origin
    where two are no line upwards."""
    rises = (a[0] - b[0]) * (a[1] - b[1]) > 0 and not 0.8 < a[0] / max(b[0], 1) < 1.25
    slope = (a[1] - b[1]) / (a[0] - b[0]) if rises else a[1] / a[0]
    return int(a[0] + (wanted * _MARGIN - a[1]) / slope)


def quality(renders: list[Any], splats: Splats, cameras: Cameras) -> Quality:
    """Of a scene against images in [0, 1], one for each camera."""
    renderer = Renderer(splats)
    images = [np.clip(renderer.image(cameras, i), 0, 1) for i in range(len(cameras))]
    pairs = list(zip(images, renders, strict=True))
    return Quality(
        float(np.mean([psnr(image, target) for image, target in pairs])),
        float(np.mean([ssim(image, target) for image, target in pairs])),
    )


def count_for_quality(
    splats: Splats, wanted: Quality, cameras: Cameras, reduce: Reduce
) -> tuple[int, Quality]:
    """About the fewest Gaussians that keep a quality in these views, and the quality there.

    One scene shrinks on and on by 0.65, each step from the last, until it falls short; between the last two
    counts PSNR is taken as linear in the logarithm of the count, which one more look checks.

    Returns:
        The count, and what the scene of the shrinking had at or just above it.

    Raises:
        InputError: the first step falls short already by more than the whole scene could gain.
    """
    whole = Renderer(splats)
    renders = [np.clip(whole.image(cameras, i), 0, 1) for i in range(len(cameras))]
    above, scene, good = len(splats), splats, Quality(float("inf"), 1.0)
    while above > _FEWEST:
        below = max(int(above * _STEP), _FEWEST)
        smaller = reduce(scene, below)
        found = quality(renders, smaller, cameras)
        if not found.meets(wanted):
            return _between(scene, above, good, below, found, wanted, renders, cameras, reduce)
        scene, above, good = smaller, below, found
    return above, good


def _between(
    scene: Splats,
    above: int,
    good: Quality,
    below: int,
    bad: Quality,
    wanted: Quality,
    renders: list[Any],
    cameras: Cameras,
    reduce: Reduce,
) -> tuple[int, Quality]:
    """The count between one that meets the quality and one that does not."""
    share = 1.0
    for name in ("psnr", "ssim"):
        low, high, need = getattr(bad, name), getattr(good, name), getattr(wanted, name)
        if np.isfinite(high) and need > low:
            share = min(share, (high - need) / max(high - low, 1e-12))
        elif need > low:
            share = min(share, 0.5)
    count = round(above * (below / above) ** max(share, 0.0))
    if count >= above:
        return above, good
    found = quality(renders, reduce(scene, count), cameras)
    return (count, found) if found.meets(wanted) else (above, good)
