"""Reader and writer for antimatter15's .splat: 32 bytes per Gaussian, no header, SH degree 0."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.errors import DAMAGED, InputError
from g2ard.io.atomic import atomic_output
from g2ard.io.packing import world_means, writable
from g2ard.io.sanitize import Raw
from g2ard.io.stream import SceneStream
from g2ard.scene.splats import SH_C0, Splats, unit_quats

_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])


def stream(path: Path) -> SceneStream:
    """Open a .splat: linear scales, 8-bit colour and opacity, quaternions as bytes around 128."""
    return _SplatStream(path)


class _SplatStream(SceneStream):
    def __init__(self, path: Path) -> None:
        super().__init__(path, _count(path))

    def raw(self, rows: int, start: int) -> Iterator[Raw]:
        for first in range(start, self.count, rows):
            block = np.fromfile(self.path, _ROW, rows, offset=first * _ROW.itemsize)
            if len(block) < min(rows, self.count - first):
                raise InputError("was truncated while it was read", path=self.path)
            yield _raw(block)


def _count(path: Path) -> int:
    size = path.stat().st_size
    if not size or size % _ROW.itemsize:
        raise InputError(
            f"is not a complete .splat: {size:,} bytes are not a multiple of 32", path=path, hint=DAMAGED
        )
    return size // _ROW.itemsize


def _raw(rows: NDArray[Any]) -> Raw:
    raw = Raw.empty(len(rows), 0)
    raw.means[:] = rows["mean"]
    with np.errstate(
        divide="ignore", invalid="ignore"
    ):  # rows with a negative scale become NaN and are dropped
        raw.log_scales[:] = np.log(rows["scale"].astype(np.float64))
        alphas = rows["rgba"][:, 3] / 255
        raw.logit_opacities[:] = np.log(alphas) - np.log1p(-alphas)
    raw.sh0[:, 0] = (rows["rgba"][:, :3] / 255 - 0.5) / SH_C0
    raw.quats[:] = (rows["quat"].astype(np.float32) - 128) / 128
    return raw


def write(path: Path, splats: Splats, *, overwrite: bool = False) -> None:
    """Write a .splat, largest and most opaque first as its viewers expect; bands past 0 are dropped."""
    splats = writable(path, splats)
    weight = splats.scales.astype(np.float64).prod(1) * splats.opacities
    splats = splats.take(np.argsort(-weight, kind="stable"))
    rows = np.empty(len(splats), _ROW)
    rows["mean"] = world_means(path, splats, ".splat")
    rows["scale"] = splats.scales
    rows["rgba"][:, :3] = _bytes(splats.colors * 255)
    rows["rgba"][:, 3] = _bytes(splats.opacities * 255)
    rows["quat"] = _bytes(unit_quats(splats.quats) * 128 + 128)
    with atomic_output(path, overwrite) as temporary:
        temporary.write_bytes(rows.tobytes())


def _bytes(values: NDArray[Any]) -> NDArray[np.uint8]:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)
