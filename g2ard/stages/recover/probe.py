"""PSNR of a few views during recovery."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import numpy as np

from g2ard.rendering.metrics import psnr
from g2ard.rendering.renderer import Renderer
from g2ard.rendering.targets import Subset, Targets, mask_of, with_pixels
from g2ard.scene.cameras import rows_by_kind
from g2ard.scene.samples import evenly_spaced
from g2ard.scene.splats import Splats

_SCORED_VIEWS = 8
"""Views that are scored, of training and of each kind of validation views."""
_INVISIBLE_PSNR = 40.0
"""PSNR in dB above which differences are invisible, so that no validation view counts for more."""
_SCORING_TIME_SHARE = 0.01
"""Share of the time that scoring the views may take while progress is shown."""
_FIRST_SCORING_SHARE = 0.1
"""The same after the first score, because short runs would otherwise end before the second."""


class Probe:
    """PSNR of a few evenly spaced views, each at most `most`; views without a valid pixel are skipped."""

    def __init__(
        self, targets: Targets, background: tuple[float, float, float], most: float = math.inf
    ) -> None:
        targets = with_pixels(targets)
        self._views = evenly_spaced(len(targets.cameras), _SCORED_VIEWS)
        self._targets, self._background, self._most = targets, background, most
        self._next = 0.0
        self._latest = (float("nan"), 0)

    def all_of(self, splats: Splats) -> float:
        """Return the mean PSNR over the views."""
        renderer = Renderer(splats, background=self._background)
        return float(np.mean([self._score(renderer, view) for view in self._views]))

    def latest(self, splats: Callable[[], Splats], step: int, seconds: float) -> tuple[float, int]:
        """Return the mean PSNR and its step; the previous ones if scoring has used its share of the time.

        `splats` returns the current scene, after `step` steps and `seconds` of recovery.
        """
        if seconds >= self._next:
            began = time.monotonic()
            self._latest = self.all_of(splats()), step
            first = self._next == 0.0  # the starting score is outdated soon
            self._next = seconds + (time.monotonic() - began) / (
                _FIRST_SCORING_SHARE if first else _SCORING_TIME_SHARE
            )
        return self._latest

    def _score(self, renderer: Renderer, view: int) -> float:
        image = renderer.clipped(self._targets.cameras[view])
        score = psnr(image, self._targets[view], mask_of(self._targets, view))
        return float(np.minimum(self._most, score))  # not `min`, which drops NaN


def score_by_kind(
    targets: Targets, background: tuple[float, float, float]
) -> Callable[[Splats], dict[str, float]]:
    """Return a function that scores a scene: kind of view → mean PSNR of up to eight views of that kind, each
    at most 40 dB."""
    rows = rows_by_kind(targets.cameras.kinds)
    probes = {
        kind: Probe(Subset(targets, found), background, _INVISIBLE_PSNR) for kind, found in rows.items()
    }
    return lambda splats: {kind: probe.all_of(splats) for kind, probe in probes.items()}
