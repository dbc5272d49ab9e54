"""Collection of candidate poses until enough are good."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from g2ard.poses.sight import Poses

_PATIENCE = 12
"""Candidates judged per requested pose, at most."""

_TOLERABLE = 0.5
"""Least score of a usable pose; poses with a score of 1 are good."""


def gather(
    count: int,
    propose: Callable[[int, int], Poses],
    judge: Callable[[Poses], NDArray[np.float64]],
    tell: Callable[[int, int], None],
) -> Poses:
    """Return the first `count` good poses of an endless even sequence, topped up with usable ones.

    Args:
        count: number of poses requested.
        propose: returns the candidates from one index of the sequence to another.
        judge: returns (P,) scores; a score of at least 1 is good.
        tell: called with the number of good poses so far.

    Returns:
        At most `count` poses, in the order of the sequence.
    """
    parts, scores = [propose(0, 0)], [np.zeros(0)]
    asked = 0
    while (good := int((np.concatenate(scores) >= 1).sum())) < count and asked < _PATIENCE * count:
        more = min(max(count - good, 16), _PATIENCE * count - asked)
        parts.append(propose(asked, asked + more))
        scores.append(judge(parts[-1]))
        asked += more
        tell(min(good, count - 1), count)
    tell(count, count)
    score = np.minimum(np.concatenate(scores), 1.0)
    best = np.argsort(-score, kind="stable")[:count]
    return Poses.joined(parts).take(np.sort(best[score[best] >= _TOLERABLE]))
