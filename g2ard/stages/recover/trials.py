"""Short trials that choose the multiplier of all rates."""

import math
import time
from collections.abc import Callable

MULTIPLIERS = (1 / 3, 3**-0.5, 1.0, 3**0.5)
"""Multipliers of all rates; trained scenes need 1 or less, lifts more."""

_EQUAL_GAIN_SHARE = 0.05
"""Share of the best gain within which other gains count as equal to it."""
_LEAST_MULTIPLIER = 0.01
"""Multiplier below which no smaller one is tried: they change nothing visible in 8 bits."""
_TRIAL_STEPS = (10, 60)
"""Fewest and most steps of a trial."""
_LIMITED_STEPS = 20
"""Most steps of a trial under a time limit."""
_SHORTEST_HORIZON = 100
"""Shortest horizon with trials, in steps."""
_TRIAL_DIVISOR = 50
"""Share of the horizon that one trial takes, as a divisor."""
_TRIAL_TIME_SHARE = 0.1
"""Share of a time limit for all trials, usually."""

_CALM_TRIAL_TIME_SHARE = 0.3
"""The same if rates are too large."""


class Trials:
    """Trials from one start; `scores` has the PSNR after each, by its multiplier.

    Args:
        run: runs a trial with a multiplier until a moment (monotonic seconds) and returns the PSNR; raises
            TimeoutError at that moment.
        start: PSNR before the trials.
        limit: time limit of the whole recovery, seconds; None is unlimited.
    """

    def __init__(
        self, run: Callable[[float, float], float], start: float, limit: float | None
    ) -> None:
        self.scores: dict[float, float] = {}
        self.start = start
        self._run = run
        if limit is None:
            self._limit = math.inf
        else:
            self._limit = limit
        self._began = time.monotonic()

    def search(self, guess: float) -> float:
        """Search `MULTIPLIERS` downwards from the one nearest to `guess`, then upwards.

        Nothing larger is tried once a smaller one has clearly beaten the guess. Earlier trials are forgotten.
        The largest multiplier whose gain is within 5 % of the best is chosen. Trials are too short to show
        the benefit of larger rates, and a long run decays its rates towards the end.

        >>> Trials(lambda m, end: -abs(m - 1), 0, None).search(0.2)
        1.0
        >>> near = {1 / 3: 32.0, 3**-0.5: 31.95}
        >>> round(Trials(lambda m, end: near.get(m, 30.0), 30, None).search(1 / 3), 3)
        0.577

        Smaller multipliers than the guess gain more here, so that 1.73 is not tried:

        >>> trials = Trials(lambda m, end: 31 - abs(m - 0.5), 30, None)
        >>> round(trials.search(1.0), 3), max(trials.scores)
        (0.577, 1.0)
        """
        self.scores.clear()
        seen: dict[int, float] = {}

        def good(i: int) -> bool:
            best = max(seen.values())
            return seen[i] >= best - _EQUAL_GAIN_SHARE * max(best - self.start, 0.0)

        at = min(range(len(MULTIPLIERS)), key=lambda i: abs(math.log(MULTIPLIERS[i] / guess)))
        for neighbours in (range(at, -1, -1), range(at + 1, len(MULTIPLIERS))):
            if seen and not good(at):
                break
            for i in neighbours:
                value = self._score(MULTIPLIERS[i], _TRIAL_TIME_SHARE)
                if math.isfinite(value):
                    seen[i] = value
                else:
                    seen[i] = -math.inf
                if not good(i):
                    break
        best = max(seen, key=lambda i: (seen[i], -i))
        if seen[best] > self.start:
            chosen = max(filter(good, seen))
        else:
            chosen = best
        return MULTIPLIERS[chosen]

    def calm(self) -> float:
        """Divide the least of `MULTIPLIERS` by three for as long as it worsens the start and dividing helps.

        >>> trials = Trials(lambda m, end: 50 - 9 * m, 49.5, None)
        >>> trials.search(0.2) > 0.3 > 0.06 > trials.calm()
        True
        """
        best = min(MULTIPLIERS)
        while self.worsens(best) and best > _LEAST_MULTIPLIER:
            if self._score(best / 3, _CALM_TRIAL_TIME_SHARE) <= self.scores[best]:
                break
            best /= 3
        return best

    def worsens(self, multiplier: float) -> bool:
        """Return whether the trial with this multiplier lost quality."""
        return self.scores[multiplier] < self.start

    def best(self, default: float) -> float:
        """Return the multiplier with the best score so far."""
        return max(self.scores, key=lambda m: self.scores[m], default=default)

    @property
    def seconds(self) -> float:
        """Time since the first trial began."""
        return time.monotonic() - self._began

    def _score(self, multiplier: float, share: float) -> float:
        self.scores[multiplier] = self._run(multiplier, self._began + share * self._limit)
        return self.scores[multiplier]


def count_trial_steps(horizon: int, limit: float | None) -> int:
    """Return the steps of one trial: 20 under a time limit, otherwise 10 to 60, a fiftieth of the horizon.

    0 means no trials, because they would take too large a part of a horizon below 100.

    >>> [count_trial_steps(horizon, None) for horizon in (50, 300, 1000, 6000)]
    [0, 10, 20, 60]
    """
    if limit is not None:
        return _LIMITED_STEPS
    if horizon < _SHORTEST_HORIZON:
        return 0
    fewest, most = _TRIAL_STEPS
    return min(most, max(fewest, horizon // _TRIAL_DIVISOR))
