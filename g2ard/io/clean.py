"""The one gate every scene passes on its way in: non-finite rows go, infinities that mean something stay."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.errors import InputError
from g2ard.io.types import Note, Scene
from g2ard.progress import plural
from g2ard.splats import DRAWN_LOGIT, Splats

__all__ = ["BLOCK", "LOGIT_LIMIT", "LOG_SCALE_LIMIT", "Raw", "cleaned"]

BLOCK = 8192
"""Rows handled at a time: 60 float32 columns of them are 2 MB and stay in the cache."""

LOGIT_LIMIT = 16.0
"""Logits past this are clamped to it: sigmoid(16) = 1 − 1.1e-7, far past the 0.99 at which a rasteriser clips
and far within an 8-bit step of 1, while −log(1 − α) is still exact enough in float32."""

LOG_SCALE_LIMIT = 43.0
"""exp(43)² = 2.2e37 and exp(−43)² = 4.5e-38 are the last squares that are normal float32."""


@dataclass
class Raw:
    """A scene as files store it: logarithmic scales, logits; every array float32, C-contiguous, writable."""

    means: NDArray[np.float32]
    quats: NDArray[np.float32]
    log_scales: NDArray[np.float32]
    logit_opacities: NDArray[np.float32]
    sh0: NDArray[np.float32]
    shN: NDArray[np.float32]
    offset: NDArray[np.float64]

    @classmethod
    def empty(cls, count: int, rest: int) -> Raw:
        """Room for `count` Gaussians with `rest` higher-band coefficients each."""

        def room(*shape: int) -> NDArray[np.float32]:
            return np.empty((count, *shape), np.float32)

        return cls(room(3), room(4), room(3), room(), room(1, 3), room(rest, 3), np.zeros(3))


def cleaned(path: Path, raw: Raw, notes: list[Note] | None = None) -> Scene:
    """Check, clamp and activate what a reader found. `raw` is consumed: its arrays become the scene's.

    Rows with a NaN, or with an infinity where none has a meaning, are dropped and counted. Infinite or
    extreme logits (|x| > 16) and log-scales (|x| > 43) are clamped, quaternions of length zero become
    the identity; both counted. A scene of which nothing shows is noted.

    Raises:
        InputError: no row is left.
    """
    notes = list(notes or ())
    count = len(raw.means)
    if count == 0:
        raise InputError(f"{path}: holds no Gaussians")
    keep = np.ones(count, bool)
    tally: dict[str, int] = {"logits": 0, "scales": 0, "quats": 0}
    for start in range(0, count, BLOCK):
        _clean_block(raw, slice(start, start + BLOCK), keep, tally)
    dropped = count - int(np.count_nonzero(keep))
    if dropped == count:
        raise InputError(
            f"{path}: none of its {plural(count, 'Gaussian')} is finite; take an earlier state of it"
        )
    if dropped:
        first = int(np.argmin(keep))
        text = f"{plural(dropped, 'non-finite Gaussian')} dropped (the first is row {first})"
        notes.append(Note("dropped_rows", dropped, text))
    for key, code, what, then in (
        ("logits", "clamped_logits", "opacity logit", f"beyond ±{LOGIT_LIMIT:g} clamped"),
        ("scales", "clamped_scales", "log-scale", f"beyond ±{LOG_SCALE_LIMIT:g} clamped"),
        ("quats", "zero_quats", "quaternion", "of length zero made the identity"),
    ):
        if tally[key]:
            notes.append(Note(code, tally[key], f"{plural(tally[key], what)} {then}"))
    if np.max(raw.logit_opacities, where=keep, initial=-np.inf) < DRAWN_LOGIT:
        notes.append(Note("invisible", count - dropped, "nothing of it shows: every α is below 1/255"))
    splats = Splats(
        raw.means, raw.quats, raw.log_scales, raw.logit_opacities, raw.sh0, raw.shN, raw.offset
    )  # `log_scales` were exponentiated in place
    return Scene(splats.take(keep) if dropped else splats, tuple(notes))


def _clean_block(raw: Raw, rows: slice, keep: NDArray[np.bool_], tally: dict[str, int]) -> None:
    logits, scales, quats = raw.logit_opacities[rows], raw.log_scales[rows], raw.quats[rows]
    good = ~np.isnan(logits) & ~(np.isnan(scales) | (scales == np.inf)).any(1)
    for values in (raw.means[rows], quats, raw.sh0[rows], raw.shN[rows]):
        good &= _finite_rows(values)
    keep[rows] = good

    tally["logits"] += int(np.count_nonzero(good & (np.abs(logits) > LOGIT_LIMIT)))
    np.clip(logits, -LOGIT_LIMIT, LOGIT_LIMIT, out=logits)
    tally["scales"] += int(np.count_nonzero(good[:, None] & (np.abs(scales) > LOG_SCALE_LIMIT)))
    np.clip(scales, -LOG_SCALE_LIMIT, LOG_SCALE_LIMIT, out=scales)
    scales[:] = np.exp(scales, dtype=np.float64)
    zero = good & ~quats.any(1)
    if zero.any():
        tally["quats"] += int(np.count_nonzero(zero))
        quats[zero] = (1, 0, 0, 0)


def _finite_rows(values: NDArray[Any]) -> NDArray[np.bool_]:
    flat = values.reshape(len(values), -1)
    finite = np.isfinite(flat)
    return np.ones(len(flat), bool) if finite.all() else finite.all(1)
