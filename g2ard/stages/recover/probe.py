"""PSNR of a few views during recovery, and the rate multiplier that short trials choose."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from g2ard.rendering.metrics import psnr
from g2ard.scene.splats import Splats
from g2ard.scene.splits import rows_by_kind
from g2ard.scene.targets import Subset, Targets, mask_of

if TYPE_CHECKING:
    from g2ard.rendering.renderer import Renderer

MULTIPLIERS = (1 / 3, 3**-0.5, 1.0, 3**0.5)
"""Multipliers of all rates; trained scenes need 1 or less, lifts more."""

_TIE = 0.04
"""Share of the best gain within which other gains count as equal to it."""
_CALMEST = 0.01
"""Multiplier below which no smaller one is tried: they change nothing visible in 8 bits."""
_VIEWS = 8
"""Views that are scored, of training and of each kind of validation views."""
_SHARE = 0.01
"""Share of the time that scoring the views may take while progress is shown."""
_FIRST_SHARE = 0.1
"""The same after the first score, because short runs would otherwise end before the second."""
_FEWEST, _MOST, _PART = 10, 60, 50
"""Steps of a trial: the least, the most, and the divisor of the horizon between them."""
_SHORTEST_HORIZON = 100
"""Steps of the shortest horizon with trials; in a shorter one they would take too large a part."""


def trial_steps(horizon: int) -> int:
    """Return the steps of one trial: a fiftieth of the horizon, from 10 to 60; 0 if trials do not pay.

    >>> trial_steps(50), trial_steps(300), trial_steps(1000), trial_steps(6000)
    (0, 10, 20, 60)
    """
    return 0 if horizon < _SHORTEST_HORIZON else min(_MOST, max(_FEWEST, horizon // _PART))


def search_multiplier(
    score: Callable[[float], float], guess: float, start: float
) -> tuple[float, dict[float, float]]:
    """Search `MULTIPLIERS` both ways from the one nearest to `guess`; return the best and all scores.

    The largest multiplier whose gain is within 4 % of the best is chosen. Trials are too short to show the
    benefit of larger rates, and a long run decays its rates towards the end.

    Args:
        score: returns the PSNR after a trial with a multiplier.
        guess: multiplier to begin at.
        start: PSNR before the trial.

    >>> search_multiplier(lambda m: -abs(m - 1), 0.2, start=0)[0]
    1.0
    >>> round(search_multiplier(lambda m: {1 / 3: 32.0, 3**-0.5: 31.95}.get(m, 30.0), 1 / 3, start=30)[0], 3)
    0.577
    """
    seen: dict[int, float] = {}

    def good(i: int) -> bool:
        best = max(seen.values())
        return seen[i] >= best - _TIE * max(best - start, 0.0)

    at = min(range(len(MULTIPLIERS)), key=lambda i: abs(math.log(MULTIPLIERS[i] / guess)))
    for neighbours in (range(at, -1, -1), range(at + 1, len(MULTIPLIERS))):
        for i in neighbours:
            value = score(MULTIPLIERS[i])
            seen[i] = value if math.isfinite(value) else -math.inf
            if not good(i):
                break
    best = max(seen, key=lambda i: (seen[i], -i))
    chosen = max(filter(good, seen)) if seen[best] > start else best
    return MULTIPLIERS[chosen], {MULTIPLIERS[i]: value for i, value in sorted(seen.items())}


def calm(
    score: Callable[[float], float], best: float, seen: dict[float, float], start: float
) -> tuple[float, dict[float, float]]:
    """Divide the best multiplier by three for as long as it worsens the start and dividing helps.

    >>> calm(lambda m: 50 - 9 * m, 1 / 3, {1 / 3: 47.0}, start=49.5)[0] < 0.06
    True
    """
    seen = dict(seen)
    while seen[best] < start and best > _CALMEST:
        seen[best / 3] = score(best / 3)
        if seen[best / 3] <= seen[best]:
            break
        best /= 3
    return best, seen


class Probe:
    """PSNR of a few evenly spaced views."""

    def __init__(self, targets: Targets, background: tuple[float, float, float]) -> None:
        count = len(targets.cameras)
        sample = np.linspace(0, count - 1, min(count, _VIEWS)).round().astype(int)
        self._views = [int(view) for view in np.unique(sample)]
        self._targets, self._background = targets, background
        self._next = 0.0
        self._latest = (float("nan"), 0)

    def all_of(self, splats: Splats) -> float:
        """Return the mean PSNR over the views."""
        from g2ard.rendering.renderer import Renderer

        renderer = Renderer(splats, background=self._background)
        return float(np.mean([self._score(renderer, view) for view in self._views]))

    def latest(self, splats: Callable[[], Splats], step: int, seconds: float) -> tuple[float, int]:
        """Return the mean PSNR and its step; the previous ones if scoring has used its share of the time.

        Args:
            splats: returns the current scene.
            step: number of steps taken.
            seconds: time since recovery began.
        """
        if seconds >= self._next:
            began = time.monotonic()
            self._latest = self.all_of(splats()), step
            first = self._next == 0.0  # the starting score is outdated soon
            self._next = seconds + (time.monotonic() - began) / (_FIRST_SHARE if first else _SHARE)
        return self._latest

    def _score(self, renderer: Renderer, view: int) -> float:
        image = renderer.clipped(self._targets.cameras[view])
        return psnr(image, self._targets[view], mask_of(self._targets, view))


def score_by_kind(
    targets: Targets, background: tuple[float, float, float]
) -> Callable[[Splats], dict[str, float]]:
    """Return a function that scores a scene: kind of view → mean PSNR of up to eight views of that kind."""
    rows = rows_by_kind(targets.cameras.names)
    probes = {kind: Probe(Subset(targets, found), background) for kind, found in rows.items()}
    return lambda splats: {kind: probe.all_of(splats) for kind, probe in probes.items()}
