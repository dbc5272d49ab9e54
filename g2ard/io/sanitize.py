"""Cleaning of scenes after reading: drop non-finite rows, clamp extreme values."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from g2ard.arrays import Float, Float32, Mask, Values
from g2ard.config.choices import RenderModel
from g2ard.errors import InputError
from g2ard.io.types import Note, Noted
from g2ard.progress import plural
from g2ard.scene.splats import DRAWN_LOGIT, SH_C0, Splats

BLOCK = 8192
"""Rows per block: 2 MB for 60 float32 columns, which fits into the cache."""

LOGIT_LIMIT = 16.0
"""Limit of logits: sigmoid(16) = 1 − 1.1e-7 is above the rasteriser's clip at 0.99 and within an 8-bit step
of 1, and −log(1 − α) is still accurate in float32."""

LOG_SCALE_LIMIT = 43.0
"""Limit of log-scales: exp(43)² = 2.2e37 and exp(−43)² = 4.5e-38 are still normal float32."""


_Up = tuple[float, float, float] | None


@dataclass
class Raw:
    """A scene as stored in files: log-scales and logits, in writable C-contiguous float32 arrays."""

    means: Float32
    quats: Float32
    log_scales: Float32
    logit_opacities: Float32
    sh0: Float32
    shN: Float32

    @classmethod
    def empty(cls, count: int, rest: int) -> Raw:
        """Allocate `count` Gaussians with `rest` coefficients past band 0."""

        def room(*shape: int) -> Float32:
            return np.empty((count, *shape), np.float32)

        return cls(
            means=room(3),
            quats=room(4),
            log_scales=room(3),
            logit_opacities=room(),
            sh0=room(1, 3),
            shN=room(rest, 3),
        )

    def take(self, rows: slice) -> Raw:
        """Return a view of some rows."""
        return Raw(*(array[rows] for array in vars(self).values()))

    def fill(self, arrays: Iterable[Values]) -> None:
        """Copy the arrays of a scene in the order of these, from the first row and coefficient on."""
        for own, values in zip(vars(self).values(), arrays, strict=True):
            own[tuple(map(slice, values.shape))] = values

    def set_linear(self, scales: Values, rgba: Values) -> None:
        """Store linear scales, and bytes of colours and opacity; rows of negative scales become NaN."""
        shown = rgba / 255
        self.sh0[:, 0] = (shown[:, :3] - 0.5) / SH_C0
        with np.errstate(divide="ignore", invalid="ignore"):
            self.log_scales[:] = np.log(scales.astype(float))
            self.logit_opacities[:] = logits_of(shown[:, 3])

    def activated(
        self,
        render_model: RenderModel,
        offset: Float,
        axis: _Up = None,
    ) -> Splats:
        """Return the scene, after `Tally.clean` has exponentiated `log_scales` in place."""
        means, quats, scales, logits, sh0, shN = vars(self).values()
        return Splats(
            means,
            quats,
            scales,
            logits,
            sh0,
            shN,
            offset,
            render_model,
            axis,
        )


def cleaned(
    raw: Raw,
    notes: list[Note] | None = None,
    render_model: RenderModel = "classic",
) -> Noted:
    """Check, clamp and activate a scene, whose arrays become those of the result.

    Rows with NaN or meaningless infinities are dropped. Logits (|x| > 16) and log-scales (|x| > 43) are
    clamped, and quaternions of length zero become the identity. Notes count all changes, and tell if the
    whole scene is invisible.
    """
    tally = Tally()
    keep = tally.clean(raw)
    notes = [*(notes or ()), *tally.notes()]
    splats = raw.activated(render_model, np.zeros(3))
    if tally.dropped:
        splats = splats.take(keep)
    return splats, tuple(notes)


@dataclass
class Tally:
    """Counts over the blocks of a file of Gaussians or points: of rows, and of values that readers change.

    Points also count as `black`, or as `bright` beyond the range of colours.
    """

    item: str = "Gaussian"
    rows: int = 0
    dropped: int = 0
    first: int = -1
    noise: int = 0
    logits: int = 0
    scales: int = 0
    quats: int = 0
    black: int = 0
    bright: int = 0
    brightest: float = -LOGIT_LIMIT

    def clear(self) -> None:
        """Forget all rows."""
        vars(self).update(vars(Tally(self.item)))

    def counts(self) -> list[float]:
        """Return all counts, for `join`."""
        return [getattr(self, field.name) for field in fields(self)[1:]]

    def _count(self, good: Mask) -> None:
        """Count rows, given an (n,) mask of those that are finite."""
        lost = int(np.count_nonzero(~good))
        if lost and not self.dropped:
            self.first = self.rows + int(np.argmin(good))
        self.dropped += lost
        self.rows += len(good)

    def keep(self, positions: Values, colors: Values, noise: Mask) -> Mask:
        """Return an (n,) mask of the finite points that are not noise, and count all."""
        good = _finite_rows(positions) & _finite_rows(colors)
        self._count(good)
        self.noise += int(np.count_nonzero(good & noise))
        good &= ~noise
        return good

    def join(self, counts: Iterable[float]) -> None:
        """Add the counts of rows that follow."""
        *whole, brightest = counts
        other = Tally(self.item, *map(int, whole))
        other.brightest = brightest
        if other.dropped and not self.dropped:
            self.first = self.rows + other.first
        for name in ("rows", "dropped", "noise", "logits", "scales", "quats", "black", "bright"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        self.brightest = max(self.brightest, other.brightest)

    def clean(self, raw: Raw) -> Mask:
        """Clamp and activate rows in place, making `log_scales` linear; return an (N,) mask to keep."""
        keep = np.ones(len(raw.means), bool)
        for start in range(0, len(keep), BLOCK):
            rows = slice(start, start + BLOCK)
            keep[rows] = self._clean(raw.take(rows))
        return keep

    def _clean(self, raw: Raw) -> Mask:
        logits = raw.logit_opacities
        scales = raw.log_scales
        quats = raw.quats
        huge = np.isnan(scales) | (scales == np.inf)  # a scale of −∞ is 0, and clamped
        good: Mask = ~np.isnan(logits) & ~huge.any(1)
        for values in (raw.means, quats, raw.sh0, raw.shN):
            good &= _finite_rows(values)

        beyond = np.abs(logits) > LOGIT_LIMIT
        self.logits += int(np.count_nonzero(beyond & good))
        np.clip(logits, -LOGIT_LIMIT, LOGIT_LIMIT, out=logits)
        beyond = np.abs(scales) > LOG_SCALE_LIMIT
        self.scales += int(np.count_nonzero(beyond[good]))
        np.clip(scales, -LOG_SCALE_LIMIT, LOG_SCALE_LIMIT, out=scales)
        scales[:] = np.exp(scales, dtype=float)
        zero = good & ~quats.any(1)
        if zero.any():
            self.quats += int(np.count_nonzero(zero))
            quats[zero] = (1, 0, 0, 0)
        self._count(good)
        self.brightest = float(np.max(logits, where=good, initial=self.brightest))
        return good

    def add(self, scene: Splats) -> None:
        """Count the Gaussians of a clean scene."""
        self.rows += len(scene)
        self.brightest = float(np.max(scene.logit_opacities, initial=self.brightest))

    def notes(self, path: Path | None = None) -> list[Note]:
        """Return notes on all rows; raise an `InputError` if none remains."""
        points = self.item == "point"
        left = self.rows - self.dropped
        if not self.rows:
            raise InputError(f"has no {self.item}s", path=path)
        if not left:
            hint = None
            if not points:
                hint = "use an earlier checkpoint of the training"
            text = f"none of its {plural(self.rows, self.item)} is finite"
            raise InputError(text, path=path, hint=hint)
        if self.noise == left:
            text = f"all of its {plural(self.noise, 'point')} are marked as noise or invalid, or at 0 0 0"
            raise InputError(text, path=path)
        changes = {
            "dropped_rows": (
                self.dropped,
                f"non-finite {self.item}",
                f"dropped (the first is row {self.first})",
            ),
            "noise": (
                self.noise,
                "point",
                "dropped that the file marks as noise or invalid, or stores at 0 0 0",
            ),
            "clamped_logits": (
                self.logits,
                "opacity logit",
                f"beyond ±{LOGIT_LIMIT:g} clamped",
            ),
            "clamped_scales": (
                self.scales,
                "log-scale",
                f"beyond ±{LOG_SCALE_LIMIT:g} clamped",
            ),
            "zero_quats": (
                self.quats,
                "quaternion",
                "of length zero made the identity",
            ),
        }
        notes = []
        for code, (count, what, then) in changes.items():
            if count:
                notes.append(Note(code, count, f"{plural(count, what)} {then}"))
        if self.brightest < DRAWN_LOGIT and not points:
            text = "the scene is invisible: every opacity is below 1/255"
            notes.append(Note("invisible", left, text))
        return notes


def logits_of(alphas: Values) -> Values:
    """Return the logits of opacities; ±∞ for 1 and 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        logits: Values = np.log(alphas) - np.log1p(-alphas)
    return logits


def _finite_rows(values: Values) -> Mask:
    finite = np.isfinite(values)
    if finite.all():
        return np.ones(len(values), bool)
    return np.all(finite.reshape(len(values), -1), axis=1)
