"""Views of a run for training and for scoring."""

from __future__ import annotations

from dataclasses import dataclass, replace

from g2ard.io.types import ViewSet
from g2ard.scene.cameras import Cameras


@dataclass(frozen=True, eq=False)
class RunViews:
    """Views of a run.

    Args:
        train: views for training, of the usual and other kinds.
        test: usual views for scoring.
        apart: views of other kinds; None if there are none.
        pool: the whole generated pool, written beside the result.
        full: the usual views for scoring at their own size, if a requested size shrank them.
        unseen: share of the sampled matter that no view of the pool sees.
    """

    train: ViewSet
    test: Cameras
    apart: Cameras | None = None
    pool: ViewSet | None = None
    unseen: float | None = None
    full: Cameras | None = None

    def resized(self, longest: int) -> RunViews:
        """Shrink all views for training and scoring."""
        apart = self.apart and self.apart.resized(longest)
        return replace(self, train=self.train.resized(longest), test=self.test.resized(longest), apart=apart)
