"""Reader and writer for standard 3DGS .ply files, in the layout of INRIA's trainer."""

import re
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.lib.recfunctions import structured_to_unstructured

import g2ard.io.plyfiles as plyfiles
from g2ard.arrays import Float, Float32, Values
from g2ard.config.choices import PlyLayout, RenderModel
from g2ard.errors import InputError, require
from g2ard.io.judge import Reading, choose_white, full_scales, judge_storage, note_coarse, spacing
from g2ard.io.packing import rounding
from g2ard.io.sanitize import BLOCK, LOG_SCALE_LIMIT, Raw
from g2ard.io.stream import RawStream, SceneStream
from g2ard.io.types import Note
from g2ard.progress import plural, some
from g2ard.scene.splats import SH_C0, Splats, far_middle, unit_quats
from g2ard.scene.transform import as_stored

_MEANS = ["x", "y", "z"]
_DC = ["f_dc_0", "f_dc_1", "f_dc_2"]
_SCALES = ["scale_0", "scale_1", "scale_2"]
_QUATS = ["rot_0", "rot_1", "rot_2", "rot_3"]
_REQUIRED_PROPERTIES = [*_MEANS, *_DC, "opacity", *_SCALES, *_QUATS]
_NORMALS = ["nx", "ny", "nz"]
_FILTER = "filter_3d"
_FILTERED = "the 3D filter of Mip-Splatting is applied to scales and opacities"
_FLAT = "2DGS scene read as flat Gaussians; renders differ where surfaces are seen at a slant"
_TIME = re.compile(
    r"t|time\w*|\w*_t|trbf\w*|motion\w*|omega\w*|rot_r_?\d|vel\w*|v[xyz]|(start|end)_time|dur\w*"
)
_DEFORMS = ("deformation.pth", "../../deform")
"""Names of properties of scenes that move, and of networks beside a scene that move it."""

_JUDGED = 4096  # rows that tell how values are stored
_FLAT_LOG_RATIO = np.log(np.float32(1e-3))
"""Logarithm of the thickness of 2D Gaussians over their shorter scale."""


class Stream(RawStream):
    """3DGS .ply of any SH degree, property order, scalar type and byte order, or ascii.

    Also read: RGB instead of `f_dc`; one or two scales; names with the prefix `scalar_` of CloudCompare; the
    3D filter of Mip-Splatting, as wider Gaussians. float64 positions that float32 cannot represent are
    recentred; the shift is stored in `offset`. Text files and those with leading lists are read whole.
    """

    def __init__(self, path: Path) -> None:
        header = plyfiles.read_header(path)
        groups = plyfiles.groups_of(header)
        names = plyfiles.scene_names(header.properties(groups[-1]))
        mode = plyfiles.render_model_of(header.comments)
        self._rgb: tuple[str, ...] | None = None
        if names.keys().isdisjoint(_DC):
            choices = (rgb for rgb in plyfiles.COLOR_NAMES if names.keys() >= set(rgb))
            self._rgb = next(choices, None)
        if "scale" in names and "scale_0" not in names:
            names["scale_0"] = names.pop("scale")
        flat = mode == "2dgs" or ("scale_1" in names and "scale_2" not in names)
        self._scales = _SCALES
        if flat:
            self._scales = _SCALES[:2]
        elif "scale_0" in names and names.keys().isdisjoint(_SCALES[1:]):
            self._scales = _SCALES[:1]
        self._quats = _QUATS
        if len(self._scales) == 1 and names.keys().isdisjoint(_QUATS):
            self._quats = []
        needed = [
            *_MEANS,
            *(self._rgb or _DC),
            "opacity",
            *self._scales,
            *self._quats,
        ]
        plyfiles.require(list(names), needed, "a 3DGS scene")
        rest = [name for name in names if re.fullmatch(r"f_rest_\d{1,3}", name)]
        rest.sort(key=_rest_number)
        stored, kept = _bands(rest)
        rows = _joined(plyfiles.read_element(path, header, *groups))
        self._names = names
        self._path = path
        self._rows = rows
        shift = np.zeros(3)
        if rows.dtype[names["x"]].itemsize == 8:
            sample = plyfiles.spread_rows(rows)
            shift = far_middle(np.stack([sample[names[name]] for name in _MEANS], axis=1))
        offset = plyfiles.offset_of(header) + shift
        moving = [name for name in names if _TIME.fullmatch(name)]
        moving += [name for name in _DEFORMS if (path.absolute().parent / name).exists()]
        unused = [name for name in names if name not in needed]
        notes = [*_frames(header), *_ignored(unused, rest, stored, kept)]
        if moving:
            text = f"the scene moves in time ({some(moving)}); all times are read as one"
            notes.append(Note("moving", len(moving), text))
        count = len(rows)
        if flat and count:
            notes.append(Note("flat_gaussians", count, _FLAT))
        if _FILTER in names and count:
            notes.append(Note("mip_filter", count, _FILTERED))
        model: RenderModel = "classic"
        if mode == "antialiased" and not flat:
            model = mode
        super().__init__(
            path,
            count,
            kept,
            offset,
            tuple(notes),
            model,
        )
        self.up = plyfiles.up_of(header.comments)
        self.restore(plyfiles.axes_of(header))
        self._shift = shift
        self._flat = flat
        self._rest = rest
        self._stored = stored
        self._kept = kept
        self._read, self._white = self._judged()
        self.notes += self._read.notes

    def positions(self, rows: int, start: int = 0) -> Iterator[Float32]:
        for _, block in plyfiles.row_blocks(self.path, self._rows, rows, start):
            with np.errstate(over="ignore", invalid="ignore"):
                means = self._means(block)
            yield self.in_axes(means)

    def raw(self, rows: int, start: int) -> Iterator[Raw]:
        for _, block in plyfiles.row_blocks(self.path, self._rows, rows, start):
            raw = Raw.empty(len(block), self._kept)
            with np.errstate(over="ignore", invalid="ignore"):  # beyond float32: inf, and dropped
                for first in range(0, len(block), BLOCK):
                    part = slice(first, first + BLOCK)
                    self._decode(block[part], raw.take(part))
            yield raw

    def _columns(self, block: Values, names: Sequence[str]) -> Values:
        return structured_to_unstructured(block[[self._names[name] for name in names]])

    def _means(self, block: Values) -> Float32:
        means = self._columns(block, _MEANS)
        if self._shift.any():
            means = means - self._shift
        return np.asarray(means, np.float32)

    def _judged(self) -> tuple[Reading, float]:
        """Return how values are stored, and the number that means white in RGB."""
        rows = plyfiles.spread_rows(self._rows, _JUDGED)
        scales = self._columns(rows, self._scales)
        base = self._columns(rows, self._rgb or _DC)
        opacities = rows[self._names["opacity"]]
        wide = 0.0
        with np.errstate(over="ignore", invalid="ignore"):
            if len(rows):
                wide = float(2 * np.exp(np.median(scales)))
        means = self._columns(rows, _MEANS)
        self.notes += note_coarse(means, wide)
        white = 1.0
        if self._rgb is not None:
            white = choose_white(base, full_scales(base.dtype))
            base = np.zeros((0, 3))
        apart = spacing(means, self.count)
        reading = judge_storage(scales, opacities, base, logs=True, apart=apart)
        return reading, white

    def _decode(self, block: Values, raw: Raw) -> None:
        raw.means[:] = self._means(block)
        if self._rgb is None:
            raw.sh0[:, 0] = self._read.sh0(self._columns(block, _DC))
        else:
            rgb = self._columns(block, self._rgb) / self._white
            raw.sh0[:, 0] = (rgb - 0.5) / SH_C0
        raw.log_scales[:, : len(self._scales)] = self._columns(block, self._scales)
        if self._flat:
            raw.log_scales[:, 2] = raw.log_scales[:, :2].min(axis=1) + _FLAT_LOG_RATIO
        elif len(self._scales) == 1:
            raw.log_scales[:, 1:] = raw.log_scales[:, :1]
        if self._quats:
            quats = self._columns(block, self._quats)
        else:
            quats = np.array([[1.0, 0, 0, 0]])
        if quats.dtype == np.uint8:  # of bytes, 128 is 0
            quats = quats - 128.0
        raw.quats[:] = quats
        raw.logit_opacities[:] = self._read.opacity_logits(block[self._names["opacity"]])
        if _FILTER in self._names:
            _widen(raw, np.asarray(block[self._names[_FILTER]], float))
        if self._rest:  # channel-major: all of red's coefficients, then green's, then blue's
            bands = self._columns(block, self._rest).reshape(-1, 3, self._stored)
            for channel in range(3):  # three times as fast as a transposed copy
                raw.shN[:, :, channel] = bands[:, channel, : self._kept]


def _joined(groups: list[Values]) -> Values:
    """Return groups of rows as one, with zeros for harmonics past their degrees; the last has the most."""
    if len(groups) == 1:
        return groups[0]
    rows = np.zeros(sum(map(len, groups)), groups[-1].dtype)
    at = 0
    most = _count_bands(rows)
    for group in groups:
        own = _count_bands(group)
        here = rows[at : at + len(group)]
        for name in group.dtype.names or ():
            target = name
            if name.startswith("f_rest_"):  # harmonics are stored channel after channel
                channel, k = divmod(_rest_number(name), own)
                target = f"f_rest_{channel * most + k}"
            here[target] = group[name]
        at += len(group)
    return rows


def _count_bands(rows: Values) -> int:
    """Return the number of coefficients past band 0 per channel."""
    names = rows.dtype.names or ()
    return sum(name.startswith("f_rest_") for name in names) // 3


def _rest_number(name: str) -> int:
    return int(name.removeprefix("f_rest_"))


def _widen(raw: Raw, size: Float) -> None:
    """Apply the 3D filter of Mip-Splatting of (n,) sizes f: σ² + f², and α·√(Πσ² / Π(σ² + f²))."""
    before = 2 * raw.log_scales.astype(float)
    with np.errstate(divide="ignore"):
        after = np.logaddexp(before, 2 * np.log(np.abs(size))[:, None])
    fading = 0.5 * (before - after).sum(axis=1)
    logits = raw.logit_opacities.astype(float)
    lit = -np.logaddexp(0, -logits)
    dark = -np.logaddexp(0, logits)  # logarithms of α and 1 − α
    with np.errstate(divide="ignore"):
        faded = np.logaddexp(dark, lit + np.log(-np.expm1(fading)))
    raw.log_scales[:] = after / 2
    raw.logit_opacities[:] = lit + fading - faded


def _frames(header: plyfiles.PlyHeader) -> list[Note]:
    """Return a note on elements with changes of the Gaussians over time."""
    count = header.counts.get("vertex")
    groups = plyfiles.groups_of(header)
    if count == 1:
        return []
    others = [name for name in header.counts if name not in groups]
    moving = [name for name in others if header.counts[name] == count]
    if not moving:
        return []
    what = plural(len(moving), "further element")
    text = f"animated scene: frame 0 is read, {what} ({some(moving)}) ignored"
    return [Note("ignored_frames", len(moving), text)]


def _bands(rest: list[str]) -> tuple[int, int]:
    """Return the numbers of stored and of kept coefficients past band 0 per channel."""
    count = len(rest)
    numbers = list(map(_rest_number, rest))
    if numbers != list(range(count)) or count not in (0, 9, 24, 45, 72):
        raise InputError(f"expected f_rest_0 to f_rest_n with 0, 9, 24 or 45 of them, got {count}")
    return count // 3, min(count // 3, 15)


def _ignored(
    unused: list[str],
    rest: list[str],
    stored: int,
    kept: int,
) -> list[Note]:
    known = {*_REQUIRED_PROPERTIES, *_NORMALS, *rest, _FILTER}
    extra = [name for name in unused if name not in known]
    notes = []
    if extra:
        what = plural(len(extra), "extra property", "extra properties")
        text = f"{what} ignored ({some(extra, 4)})"
        notes.append(Note("ignored_properties", len(extra), text))
    if stored > kept:
        notes.append(Note("ignored_bands", 1, "spherical harmonics past degree 3 ignored"))
    return notes


def write(
    path: Path,
    scene: Splats | SceneStream,
    *,
    overwrite: bool = False,
    normals: bool = False,
    layout: PlyLayout | None = None,
) -> float:
    """Write a binary little-endian 3DGS .ply: x y z, f_dc, f_rest, opacity, scale, rot.

    A non-zero `offset`, other axes than y down and an antialiased render model are stored in comments, which
    `Stream` restores.
    `normals` adds zero nx ny nz after x y z. The layout "inria" is that of INRIA's trainer, for programs that
    go by position: normals, and SH degree 3 padded with zeros, 248 bytes per Gaussian. A stream is written
    block by block.

    Returns:
        The largest change of a position by rounding.
    """
    require("layout", repr(layout), layout in (None, "inria"), "'inria' or None")
    degree = scene.sh_degree
    if layout == "inria":
        normals = True
        degree = 3
    error = 0.0
    if isinstance(scene, Splats):
        error = rounding(scene, scene.narrowed())
        frame = as_stored(scene)
        count = len(frame)
        parts = iter([frame])
    else:
        frame = as_stored(scene.placed(Raw.empty(0, 0)))
        count = scene.count
        parts = map(as_stored, scene.blocks(BLOCK))
    if not count:
        raise InputError("not written: the scene has no Gaussians", path=path)
    names = list(_MEANS)
    if normals:
        names += _NORMALS
    names += _DC
    coefficients = 3 * ((degree + 1) ** 2 - 1)
    names += [f"f_rest_{k}" for k in range(coefficients)]
    names += ["opacity", *_SCALES, *_QUATS]
    blocks = _blocks((part.with_sh_degree(degree) for part in parts), names, normals)
    comments = plyfiles.comments_of(frame)
    if layout == "inria":
        comments = comments[1:]  # those that carry values: importers by position may count lines
    types = dict.fromkeys(names, "<f4")
    plyfiles.write_rows(path, types, count, blocks, overwrite, comments)
    return error


def _taken_apart(splats: Splats) -> Iterator[Splats]:
    """Yield a scene in blocks."""
    return (splats.take(slice(at, at + BLOCK)) for at in range(0, len(splats), BLOCK))


def _blocks(
    parts: Iterable[Splats],
    names: list[str],
    normals: bool,
) -> Iterator[Float32]:
    first = 0
    for block in chain.from_iterable(map(_taken_apart, parts)):
        n = len(block)
        with np.errstate(divide="ignore", invalid="ignore"):
            logs = np.clip(np.log(block.scales, dtype=float), -LOG_SCALE_LIMIT, LOG_SCALE_LIMIT)
        columns = [block.means]
        if normals:
            columns.append(np.zeros((n, 3)))
        columns += [
            block.sh0[:, 0],
            block.shN.transpose(0, 2, 1).reshape(n, -1),
            block.logit_opacities[:, None],
            logs,
            unit_quats(block.quats),
        ]
        rows = np.concatenate(
            columns,
            axis=1,
            dtype="<f4",
            casting="same_kind",
        )
        finite = np.isfinite(rows)
        if not finite.all():
            row, column = np.argwhere(~finite)[0]
            text = f"not written: {names[column]!r} of Gaussian {first + row} is not finite"
            raise InputError(text)
        yield rows
        first += n
