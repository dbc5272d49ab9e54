"""Reader and writer for standard 3DGS .ply files, in the layout of INRIA's trainer."""

import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.recfunctions import structured_to_unstructured
from numpy.typing import NDArray

from g2ard.config.choices import PlyLayout, RenderModel
from g2ard.errors import InputError, require
from g2ard.io import plyfiles
from g2ard.io.packing import rounding
from g2ard.io.sanitize import BLOCK, LOG_SCALE_LIMIT, Raw
from g2ard.io.stream import RawStream, SceneStream
from g2ard.io.types import Note
from g2ard.progress import plural
from g2ard.scene.splats import Splats, far_middle, unit_quats

_MEANS = ["x", "y", "z"]
_DC = ["f_dc_0", "f_dc_1", "f_dc_2"]
_SCALES = ["scale_0", "scale_1", "scale_2"]
_QUATS = ["rot_0", "rot_1", "rot_2", "rot_3"]
_REQUIRED_PROPERTIES = [*_MEANS, *_DC, "opacity", *_SCALES, *_QUATS]
_NORMALS = ["nx", "ny", "nz"]
_FLAT_LOG_RATIO = np.log(np.float32(1e-3))
"""Logarithm of the thickness of 2D Gaussians over their shorter scale."""


class Stream(RawStream):
    """3DGS .ply of any SH degree, property order, scalar type and byte order, or ascii.

    float64 positions that float32 cannot represent are recentred; the shift is stored in `offset`. Text files
    and those with leading lists are read whole.
    """

    def __init__(self, path: Path) -> None:
        header = plyfiles.read_header(path)
        properties = header.properties("vertex")
        mode = plyfiles.render_model_of(header.comments)
        flat = mode == "2dgs" or ("scale_1" in properties and "scale_2" not in properties)
        needed = [name for name in _REQUIRED_PROPERTIES if not flat or name != "scale_2"]
        plyfiles.require(path, properties, needed, "a 3DGS scene")
        rest = sorted((p for p in properties if re.fullmatch(r"f_rest_\d{1,3}", p)), key=lambda p: int(p[7:]))
        stored, kept = _bands(path, rest)
        (rows,) = plyfiles.read_element(path, header, "vertex")
        shift = np.zeros(3)
        if rows.dtype["x"].itemsize == 8:
            sample = plyfiles.spread_rows(rows)
            shift = far_middle(np.stack([sample[name] for name in _MEANS], axis=1))
        offset = plyfiles.offset_of(path, header) + shift
        notes = _ignored(properties, rest, stored, kept)
        if flat:
            text = "2DGS scene read as flat Gaussians; renders differ where surfaces are seen at a slant"
            notes.append(Note("flat_gaussians", len(rows), text))
        model: RenderModel = "antialiased" if mode == "antialiased" and not flat else "classic"
        super().__init__(path, len(rows), kept, offset, tuple(notes), model)
        self._rows, self._shift, self._flat = rows, shift, flat
        self._rest, self._stored, self._kept = rest, stored, kept

    def positions(self, rows: int) -> Iterator[NDArray[np.float32]]:
        for _, block in plyfiles.row_blocks(self.path, self._rows, rows):
            with np.errstate(over="ignore", invalid="ignore"):
                means = _means(block, self._shift)
            yield means

    def raw(self, rows: int, start: int) -> Iterator[Raw]:
        for _, block in plyfiles.row_blocks(self.path, self._rows, rows, start):
            raw = Raw.empty(len(block), self._kept)
            with np.errstate(over="ignore", invalid="ignore"):  # beyond float32: inf, and dropped
                for first in range(0, len(block), BLOCK):
                    part = slice(first, first + BLOCK)
                    self._decode(block[part], raw.take(part))
            yield raw

    def _decode(self, block: NDArray[Any], raw: Raw) -> None:
        raw.means[:] = _means(block, self._shift)
        raw.sh0[:, 0] = structured_to_unstructured(block[_DC])
        if self._flat:
            raw.log_scales[:, :2] = structured_to_unstructured(block[_SCALES[:2]])
            raw.log_scales[:, 2] = raw.log_scales[:, :2].min(axis=1) + _FLAT_LOG_RATIO
        else:
            raw.log_scales[:] = structured_to_unstructured(block[_SCALES])
        raw.quats[:] = structured_to_unstructured(block[_QUATS])
        raw.logit_opacities[:] = block["opacity"]
        if self._rest:  # channel-major: all of red's coefficients, then green's, then blue's
            bands = structured_to_unstructured(block[self._rest]).reshape(-1, 3, self._stored)
            for channel in range(3):  # three times as fast as a transposed copy
                raw.shN[:, :, channel] = bands[:, channel, : self._kept]


def _bands(path: Path, rest: list[str]) -> tuple[int, int]:
    """Return the numbers of stored and of kept coefficients past band 0 per channel."""
    if [int(p[7:]) for p in rest] != list(range(len(rest))) or len(rest) not in (0, 9, 24, 45, 72):
        raise InputError(
            f"expected f_rest_0 to f_rest_n with 0, 9, 24 or 45 of them, got {len(rest)}", path=path
        )
    return len(rest) // 3, min(len(rest) // 3, 15)


def _ignored(properties: list[str], rest: list[str], stored: int, kept: int) -> list[Note]:
    extra = [p for p in properties if p not in _REQUIRED_PROPERTIES and p not in _NORMALS and p not in rest]
    notes = []
    if extra:
        names = ", ".join(extra[:4]) + (", …" if len(extra) > 4 else "")
        text = f"{plural(len(extra), 'extra property', 'extra properties')} ignored ({names})"
        notes.append(Note("ignored_properties", len(extra), text))
    if stored > kept:
        notes.append(Note("ignored_bands", 1, "spherical harmonics past degree 3 ignored"))
    return notes


def _means(block: NDArray[Any], shift: NDArray[np.float64]) -> NDArray[np.float32]:
    means = structured_to_unstructured(block[_MEANS])
    return np.asarray(means - shift if shift.any() else means, np.float32)


def write(
    path: Path,
    scene: Splats | SceneStream,
    *,
    overwrite: bool = False,
    normals: bool = False,
    layout: PlyLayout | None = None,
) -> float:
    """Write a binary little-endian 3DGS .ply: x y z, f_dc, f_rest, opacity, scale, rot.

    A non-zero `offset` and an antialiased render model are stored in comments, which `Stream` restores.
    `normals` adds zero nx ny nz after x y z. The layout "inria" is that of INRIA's trainer, for programs that
    go by position: normals, and SH degree 3 padded with zeros, 248 bytes per Gaussian. A stream is written
    block by block.

    Returns:
        The largest change of a position by rounding.
    """
    require("layout", repr(layout), layout in (None, "inria"), "'inria' or None")
    normals, degree = normals or layout == "inria", 3 if layout == "inria" else scene.sh_degree
    error = 0.0
    if isinstance(scene, Splats):
        given, scene = scene, scene.narrowed()
        count, parts, error = len(scene), iter([scene]), rounding(given, scene)
    else:
        count, parts = scene.count, scene.blocks(BLOCK)
    if not count:
        raise InputError("not written: the scene has no Gaussians", path=path)
    names = [*_MEANS, *(_NORMALS if normals else []), *_DC]
    names += [f"f_rest_{k}" for k in range(3 * ((degree + 1) ** 2 - 1))]
    names += ["opacity", *_SCALES, *_QUATS]
    blocks = _blocks(path, (part.with_sh_degree(degree) for part in parts), names, normals)
    comments = plyfiles.comments_of(scene.offset, scene.render_model)
    if layout == "inria":
        comments = comments[1:]  # those that carry values: importers by position may count lines
    plyfiles.write_rows(path, dict.fromkeys(names, "<f4"), count, blocks, overwrite, comments)
    return error


def _blocks(
    path: Path, parts: Iterable[Splats], names: list[str], normals: bool
) -> Iterator[NDArray[np.float32]]:
    first = 0
    for block in (part.take(slice(at, at + BLOCK)) for part in parts for at in range(0, len(part), BLOCK)):
        n = len(block)
        with np.errstate(divide="ignore", invalid="ignore"):
            logs = np.clip(np.log(block.scales, dtype=np.float64), -LOG_SCALE_LIMIT, LOG_SCALE_LIMIT)
        columns = [
            block.means,
            np.zeros((n, 3 if normals else 0)),
            block.sh0[:, 0],
            block.shN.transpose(0, 2, 1).reshape(n, -1),
            block.logit_opacities[:, None],
            logs,
            unit_quats(block.quats),
        ]
        rows = np.concatenate(columns, axis=1, dtype="<f4", casting="same_kind")
        finite = np.isfinite(rows)
        if not finite.all():
            row, column = np.argwhere(~finite)[0]
            text = f"not written: {names[column]!r} of Gaussian {first + row} is not finite"
            raise InputError(text, path=path)
        yield rows
        first += n
