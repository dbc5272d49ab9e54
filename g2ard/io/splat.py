"""Reader and writer for antimatter15's .splat: 32 bytes per Gaussian, no header, SH degree 0."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from g2ard.errors import InputError, damaged
from g2ard.io.atomic import atomic_output
from g2ard.io.packing import FAR_FROM_ORIGIN, as_bytes, as_packed
from g2ard.io.plyfiles import row_blocks, spread_rows
from g2ard.io.sanitize import Raw
from g2ard.io.stream import RawStream
from g2ard.scene.splats import Splats, unit_quats
from g2ard.scene.transform import restored

_ROW = np.dtype(
    [
        ("mean", "<f4", 3),
        ("scale", "<f4", 3),
        ("rgba", "u1", 4),
        ("quat", "u1", 4),
    ]
)


_FAR = 1e18  # largest possible scale
_POSSIBLE = 0.75  # least share of rows with possible values
_READ = 128  # rows that are looked at
_TEXT = [*range(9, 14), *range(32, 127)]  # bytes that are all of a text


class Stream(RawStream):
    """Rows of a .splat: linear scales, 8-bit colour and opacity, quaternions as bytes around 128."""

    def __init__(self, path: Path) -> None:
        size = path.stat().st_size
        if not size or size % _ROW.itemsize:
            text = f"is not a complete .splat: {size:,} bytes are not a multiple of 32"
            raise damaged(text)
        rows = spread_rows(np.memmap(path, _ROW, "r"))
        scales = rows["scale"]
        with np.errstate(invalid="ignore"):
            possible = (scales >= 0) & (scales < _FAR)
        right = np.isfinite(rows["mean"]).all(1) & possible.all(1)
        content = rows.view("u1").reshape(len(rows), -1)
        right &= content.any(1)
        start = np.frombuffer(rows[:_READ].tobytes(), "u1")
        what = None
        if np.isin(start, _TEXT).all():
            what = "text"
        elif right.mean() < _POSSIBLE:
            what = f"{1 - right.mean():.0%} of its rows are impossible"
        if what:
            hint = "rename it to the suffix of its format, or export it again"
            raise InputError(f"is not a .splat: {what}", hint=hint)
        super().__init__(path, size // _ROW.itemsize)

    def raw(self, rows: int, start: int) -> Iterator[Raw]:
        every = np.memmap(self.path, _ROW, "r")
        for _, block in row_blocks(self.path, every, rows, start):
            raw = Raw.empty(len(block), 0)
            raw.means[:] = block["mean"]
            raw.set_linear(block["scale"], block["rgba"])
            raw.quats[:] = (block["quat"].astype(np.float32) - 128) / 128
            yield raw


def form_of(splats: Splats) -> Splats:
    """Return a scene as a .splat holds it: y down, and relative to an offset if it is far from the origin."""
    form = as_packed(splats)
    world = form.positions
    step = np.spacing(np.abs(world).max().astype(np.float32))
    far = np.abs(np.median(world, axis=0)).max() > FAR_FROM_ORIGIN
    if far or step > np.median(form.scales.min(axis=1)):
        return form
    return replace(form, means=world.astype(np.float32), offset=np.zeros(3))


def read_back(splats: Splats, read: Splats) -> Splats:
    """Return what was `read` of a file of the scene where the scene is, which the file cannot state."""
    form = form_of(splats)
    return restored(replace(read, offset=form.offset), form.axes)


def write(path: Path, splats: Splats, *, overwrite: bool = False) -> float:
    """Write a .splat, largest and most opaque first as its viewers expect; bands past 0 are dropped.

    It cannot state an `offset` or axes: see `form_of`. Return the largest change of a position by rounding.
    """
    form = form_of(splats)
    again = restored(form, form.axes)
    error = float(np.abs(again.positions - splats.positions).max())
    weight = form.scales.astype(float).prod(1) * form.opacities
    order = np.argsort(-weight, kind="stable")
    splats = form.take(order)
    rows = np.empty(len(splats), _ROW)
    rows["mean"] = splats.means
    rows["scale"] = splats.scales
    rows["rgba"][:, :3] = as_bytes(splats.colors * 255)
    rows["rgba"][:, 3] = as_bytes(splats.opacities * 255)
    rows["quat"] = as_bytes(unit_quats(splats.quats) * 128 + 128)
    with atomic_output(path, overwrite) as temporary:
        temporary.write_bytes(rows.tobytes())
    return error
