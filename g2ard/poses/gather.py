"""Asking for candidates until enough are good."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from g2ard.poses.sight import Poses

_PATIENCE = 12
"""Candidates judged per pose wanted, at most."""

_TOLERABLE = 0.5
"""Scores of 1 are good; below this one a pose is refused."""


def gather(
    count: int,
    propose: Callable[[int, int], Poses],
    judge: Callable[[Poses], NDArray[np.float64]],
    tell: Callable[[int, int], None],
) -> Poses:
    """The first `count` good poses of an endless even sequence; the best tolerable ones where it lacks good.

    Args:
        count: poses wanted.
        propose: candidates from one index of the sequence to another.
        judge: (P,) scores; at least 1 is good.
        tell: told of good poses so far.

    Returns:
        At most `count`, in the order of the sequence.
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
