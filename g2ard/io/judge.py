"""Meaning of stored numbers, judged by most of them: a few strays decide nothing."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from g2ard.arrays import Float, Values
from g2ard.io.sanitize import Raw, logits_of
from g2ard.io.types import Note, Notes
from g2ard.progress import plural
from g2ard.scene.splats import SH_C0

_BULK = 0.98  # share of the values that decides, in samples of more than fifty

_FULL = (255.0, 1023.0, 4095.0, 65535.0)  # white in 8, 10, 12 and 16 bits
HDR = 1.5  # brightest value of float colours of which 1 is white
_FILLED = 0.25  # part of stated limits that intensities fill
_FEWEST = 16  # Gaussians that suffice to judge how they are stored
_OUTSIDE = 0.1  # amount by which opacities leave [0, 1] that tells logits

_ROUNDING = 1e-3  # amount by which opacities leave [0, 1] that is clamped without a note

_WIDE = 4.0  # scale over the distance of neighbours beyond which equal scales are doubted
_LARGEST_LOGIT = 20.0  # whole numbers up to here may be logits


def full_scales(kind: np.dtype[Any]) -> tuple[float, ...]:
    """Return the values, ascending, that colours stored as a type may have at full brightness.

    >>> full_scales(np.dtype("u1")), full_scales(np.dtype("i2")), full_scales(np.dtype("f8"))
    ((255.0,), (255.0, 1023.0, 4095.0, 32767.0), (1.0, 255.0, 1023.0, 4095.0, 65535.0))
    """
    if kind.kind == "f":
        return (1.0, *_FULL)
    most = float(np.iinfo(kind).max)
    return (*(full for full in _FULL if full < most), most)


def bulk_range(values: Values) -> tuple[float, float]:
    """Return the range of most of the finite values; (0, 0) without any."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return 0.0, 0.0
    low = np.quantile(finite, 1 - _BULK, method="lower")
    high = np.quantile(finite, _BULK, method="higher")
    return float(low), float(high)


def choose_white(colors: Values, scales: Sequence[float]) -> float:
    """Return the smallest of the scales that holds most of the (n, 3) colours that are not black.

    >>> stray = np.array([[200.0, 9, 0]] * 500 + [[65535.0, 65535, 65535]])
    >>> choose_white(stray, full_scales(np.dtype("u2")))
    255.0
    """
    brightest = colors.max(axis=1, initial=0)
    top = bulk_range(brightest[brightest > 0])[1]
    fits = (full for full in scales if 0 < top <= full * (HDR if full == 1 else 1.001))
    return next(fits, scales[-1])


_FINE = 0.25  # part of the distance of points by which float32 may round them


@np.errstate(over="ignore", invalid="ignore")
def note_coarse(positions: Values, apart: float) -> Notes:
    """Return a note if float32 rounded (n, 3) positions by much of the distance `apart` between them."""
    if not len(positions) or not np.array_equal(positions, positions.astype(np.float32)):
        return ()
    farthest = np.abs(positions).max(axis=0)
    step = float(np.spacing(farthest.astype(np.float32)).max())
    if not step > _FINE * apart > 0:
        return ()
    text = (
        f"coordinates are rounded to steps of {step:g} by float32, which is coarse for points {apart:.2g} "
        "apart; export them as float64 (.las, .laz, .e57), or with a shift (CloudCompare's Global Shift)"
    )
    return (Note("coarse_positions", len(positions), text),)


def spacing(positions: Values, count: int) -> float:
    """Return the usual distance of `count` neighbours along the two longer sides of most (n, 3) positions."""
    sides = [high - low for low, high in map(bulk_range, positions.T)]
    longer = sorted(sides)[1:]
    return math.sqrt(math.prod(longer) / max(1, count))


def unpack_colors(packed: Values) -> list[Float]:
    """Return red, green and blue of PCL's colours, 0xRRGGBB in 32-bit integers or in floats of these bits."""
    bits = np.ascontiguousarray(packed).view("<u4")
    return [(bits >> shift & 255).astype(float) for shift in (16, 8, 0)]


def choose_shades(values: Values, limits: tuple[float, float] | None = None) -> tuple[float, float]:
    """Return the intensities that mean black and white: stated limits, if most values fill a part of them."""
    low, high = bulk_range(values)
    if limits:
        least, most = limits
        inside = least <= low and high <= most
        if inside and high - low >= _FILLED * (most - least):
            return limits
    return low, high


def has_contrast(values: Values) -> bool:
    """Return whether colours (n, 3) are not all black, or intensities (n, 1) vary."""
    finite = values[np.isfinite(values).all(axis=1)]
    if not finite.size:
        return False
    if values.shape[1] == 3:
        return bool(finite.any())
    return bool(np.ptp(finite) > 0)


@dataclass(frozen=True)
class Reading:
    """Interpretation of a scene's numbers.

    Args:
        log_scales: whether scales are logarithms.
        opaque: the number that means opaque; None if opacities are logits.
        white: the number that means white; None if base colours are coefficients of band 0.
    """

    log_scales: bool
    opaque: float | None
    white: float | None
    notes: Notes

    def opacity_logits(self, values: Values) -> Values:
        """Return logits; opacities past [0, 1] are clamped."""
        if self.opaque is None:
            return values
        return logits_of(np.clip(values.astype(float) / self.opaque, 0, 1))

    def sh0(self, values: Values) -> Values:
        """Return coefficients of band 0."""
        if self.white is None:
            return values
        return (values / self.white - 0.5) / SH_C0


@np.errstate(invalid="ignore")  # signalling NaNs
def judge_storage(
    scales: Values,
    opacities: Values,
    base: Values,
    *,
    logs: bool,
    apart: float = math.inf,
) -> Reading:
    """Judge how a scene's scales (n, k), opacities (n,) and base colours (n, 3) are stored.

    Args:
        logs: whether the format defines scales as logarithms and opacities as logits, otherwise as linear.
            The definition holds, and doubts are noted, unless the numbers make no sense in it.
        apart: usual distance of neighbours, which equal scales do not exceed by much.
    """
    count = len(opacities)
    small, large = bulk_range(scales)
    faint, solid = bulk_range(opacities)
    enough = count >= _FEWEST
    told = []
    opaque = None if logs else 1.0
    notes = []
    if faint >= 0 and solid > 0 and _are_whole(opacities):
        opaque = 1.0
        if solid > 1:
            opaque = choose_white(opacities[:, None], full_scales(opacities.dtype))
        if opaque > 1:
            text = f"opacities are whole numbers, taken as 0 to {opaque:g}"
            notes.append(Note("opacities", count, text))
    elif logs:
        varying = faint < solid or solid == 1
        if enough and 0 <= faint <= solid <= 1 and varying:
            told.append(f"opacities ({faint:.3g} to {solid:.3g}) look activated, not logits")
    elif faint < -_OUTSIDE or solid > 1 + _OUTSIDE:
        opaque = None
        notes.append(Note("opacities", count, "opacities leave [0, 1], so all are taken as logits"))
    else:
        past = int(np.sum(np.abs(opacities - 0.5) > 0.5 + _ROUNDING))
        if past:
            text = f"{plural(past, 'opacity', 'opacities')} past [0, 1] clamped"
            notes.append(Note("opacities", past, text))
    log_scales = logs
    if not logs and small < 0:
        log_scales = True
        text = "scales are below 0, so all are taken as logarithms"
        notes.append(Note("log_scales", count, text))
    elif logs and enough and small > 0:
        unequal = small < large or math.exp(min(small, 1)) > _WIDE * apart
        if unequal and np.mean(scales, where=np.isfinite(scales)) < 1:
            told.insert(0, f"scales ({small:.3g} to {large:.3g}) look linear, not logarithms")
    dark, bright = bulk_range(base)
    full = None
    if dark >= 0 and bright > 1 and _are_whole(base):
        full = choose_white(base, full_scales(base.dtype))
        text = f"base colours are whole numbers, taken as 0 to {full:g}"
        notes.append(Note("base_colors", count, text))
    elif enough and 0 <= dark < bright - 0.5 and bright <= 1:
        told.append(f"base colours ({dark:.3g} to {bright:.3g}) look like RGB, not coefficients")
    if told:
        text = f"{' and '.join(told)}; they are read as the format defines them"
        notes.append(Note("activated", 1, text))
    return Reading(log_scales, opaque, full, tuple(notes))


def fill_linear(
    raw: Raw,
    scales: Values,
    opacities: Values,
    base: Values,
) -> list[Note]:
    """Fill in a scene of a format of linear scales and opacities, as they are judged; return notes."""
    read = judge_storage(scales, opacities, base, logs=False)
    with np.errstate(divide="ignore", invalid="ignore"):
        if read.log_scales:
            raw.log_scales[:] = scales
        else:
            raw.log_scales[:] = np.log(scales.astype(float))
        raw.logit_opacities[:] = read.opacity_logits(opacities)
        raw.sh0[:, 0] = read.sh0(base)
    return list(read.notes)


def _are_whole(values: Values) -> bool:
    """Return whether values are whole numbers of a larger range than coefficients and logits have."""
    if values.dtype.kind in "iu":
        return True
    _, high = bulk_range(values)
    if high <= _LARGEST_LOGIT:
        return False
    finite = values[np.isfinite(values)]
    return bool((finite == np.rint(finite)).all())
