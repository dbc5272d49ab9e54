"""Protection against steps that worsen a scene: scores, rollbacks, and blends of start and result."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from g2ard.arrays import Float, Mask, Values
from g2ard.rendering.renderer import arrays_of
from g2ard.scene.splats import ARRAYS, Splats

LOOKS = (0.1, 0.3, 0.5, 0.75)
"""Shares of the horizon at which the scene is scored."""

_HOPELESS_LOSSES = (5.0, 3.0, 1.0, 0.0)
"""Loss in dB against the start, at each of these shares, from which a run does not recover. Good runs dip by
up to 3.6 dB under full rates and are level again at half of the horizon; one that ended worse was 9 dB down
at a tenth of it."""

_BLENDS = (0.5, 0.25)
"""Weights of the result in blends with the start, tried if the result is worse than the start."""

_PRIOR_VIEWS = (2.0, 5.0, 10.0, 20.0)
"""Values of k in the shrinkage v/(v + k): views that must have touched a Gaussian to keep half its change."""
_TOLERATED_LOSS = 0.1
"""Loss in dB that is tolerated in a kind of validation views."""
_LEAST_GAIN = 0.05
"""Gain in dB below which a change is not worth keeping."""
_VALIDATION_FROM = 0.5
"""Share of the horizon from which validation views can stop a run."""

_VALIDATION_LOSS = 0.5
"""Loss in dB above which they do."""

_STATE = ("looked", "backed_off", "stopped", "best_score", "validation", "scores")
_BEST = "best."


@dataclass
class Guard:
    """The best scene so far, and decisions about the current one.

    Args:
        score: returns the score of a scene in dB; higher is better.
        best: the best scene, initially the start.
        before: score of the start.
        others: returns the score of a scene by kind of validation view; None without such views. The kind
            that loses most decides.
        harmful: returns the (N,) mask of Gaussians whose change made validation views worse, None if no view
            lost.
        active: whether to look for losses; without it the result is always kept.
    """

    score: Callable[[Splats], float]
    best: Splats
    before: float
    others: Callable[[Splats], dict[str, float]] | None = None
    harmful: Callable[[Splats], Mask | None] = lambda scene: None
    active: bool = True
    looked: int = 0
    backed_off: list[dict[str, float]] = field(default_factory=list)
    stopped: int | None = None
    validation: list[dict[str, Any]] = field(default_factory=list)
    scores: list[tuple[int, float]] = field(default_factory=list)
    best_score: float = field(init=False)

    def __post_init__(self) -> None:
        self.start = self.best
        self.best_score = self.before
        if self.others is not None:
            self.validation.append({"step": 0, "psnr": self.others(self.start)})

    def rescore(self) -> None:
        """Score the best scene again, after a change of the score."""
        if self.best is self.start:
            self.best_score = self.before
        else:
            self.best_score = self.score(self.best)

    def is_due(self, share: float) -> bool:
        """Return whether the scene should be scored at this share of the horizon."""
        return self.active and self.looked < len(LOOKS) and LOOKS[self.looked] <= share < 1

    def look(
        self,
        scene: Splats,
        share: float,
        step: int,
    ) -> Literal["on", "back", "stop"]:
        """Score a scene, and decide to go on, to go back to the best one with smaller steps, or to stop."""
        while self.is_due(share):
            self.looked += 1
        value = self.score(scene)
        self.scores.append((step, value))
        if value > self.best_score:
            self.best = scene
            self.best_score = value
        if not value < self.before - _HOPELESS_LOSSES[self.looked - 1] and math.isfinite(value):
            if self.others is not None and share >= _VALIDATION_FROM:
                self.validation.append({"step": step, "psnr": self.others(scene)})
                if self.lost > _VALIDATION_LOSS:
                    self.stopped = step
                    return "stop"
            return "on"
        if self.looked == len(LOOKS):
            self.stopped = step
            return "stop"
        self.backed_off.append({"step": step, "psnr": value})
        return "back"

    def measure_pace(self, step: int, value: float) -> float | None:
        """Return the gain in dB per 100 steps since the latest earlier look; None without one."""
        earlier = [look for look in self.scores if look[0] < step]
        if not earlier:
            return None
        before, score = earlier[-1]
        return 100 * (value - score) / (step - before)

    @property
    def lost(self) -> float:
        """Loss in dB against the start at the latest look, as the mean over the kinds of validation views.

        A kind that loses alone may be mended in the end, see `choose_by_validation`.
        """
        if not self.validation:
            return 0.0
        before = self.validation[0]["psnr"]
        now = self.validation[-1]["psnr"]
        return sum(before[kind] - now[kind] for kind in before) / len(before)

    def _find_least_gain(self, scores: dict[str, float]) -> float:
        """Return the least gain of a kind of validation view against the start."""
        before = self.validation[0]["psnr"]
        return min(scores[kind] - before[kind] for kind in before)

    def choose_by_validation(
        self, result: Splats, views: Float, step: int
    ) -> tuple[Splats, float | None]:
        """Decide how much of a result's changes to keep, by the validation views.

        Each Gaussian's change is multiplied by v/(v + k), where v `views` touched it (shrinkage towards the
        start). k rises from 0 while the mean over the kinds rises, training views being one of them. Then
        Gaussians that made validation views worse go back. If a kind still loses more than 0.1 dB against the
        start, the candidate is kept whose worst kind gains most: one of the shrinkages, the same share of
        every change, or the start.

        Returns:
            The scene and its k: 0 shrinks nothing, ∞ keeps the start, None the same share for all Gaussians.
        """
        if self.others is None:
            return result, 0.0
        best, scores, mean = self._judge(result)
        kept: float | None = 0.0
        self.validation.append({"step": step, "psnr": scores})
        for k in _PRIOR_VIEWS:
            other = self._judge(blend(self.start, result, views / (views + k)))
            if not other[2] > mean + _LEAST_GAIN:
                break
            kept = k
            (best, scores, mean) = other
        harmful = self.harmful(best)
        if harmful is not None:
            other = self._judge(blend(self.start, best, ~harmful))
            if other[2] > mean:
                best, scores, mean = other
        gain = mean - self._average(self.before, self.validation[0]["psnr"])
        if self._find_least_gain(scores) < -_TOLERATED_LOSS or not gain > _LEAST_GAIN:
            best, kept, scores = self._find_least_harm(result, views)
        if best is not result:
            self.validation.append({"step": step, "psnr": scores})
        return best, kept

    def _judge(self, scene: Splats) -> tuple[Splats, dict[str, float], float]:
        """Return a scene, its scores by kind of validation view, and their mean with the training views'."""
        assert self.others is not None
        scores = self.others(scene)
        return scene, scores, self._average(self.score(scene), scores)

    def _average(self, trained: float, scores: dict[str, float]) -> float:
        """Return the mean PSNR over training views, `trained`, and the kinds of validation views."""
        return (trained + sum(scores.values())) / (1 + len(scores))

    def _find_least_harm(
        self, result: Splats, views: Float
    ) -> tuple[Splats, float | None, dict[str, float]]:
        """Return the candidate whose worst kind of validation views gains most, its k and its scores."""
        assert self.others is not None
        best = self.start
        scores = self.validation[0]["psnr"]
        most = 0.0
        chosen: float | None = math.inf
        shares: list[tuple[float | None, Float | float]] = [
            *((k, views / (views + k)) for k in _PRIOR_VIEWS),
            *((None, share) for share in _BLENDS),
        ]
        for k, share in shares:
            part = blend(self.start, result, share)
            found = self.others(part)
            gain = self._find_least_gain(found)
            if gain > most:
                best = part
                chosen = k
                scores = found
                most = gain
        return best, chosen, scores

    def choose_by_training(self, result: Splats) -> tuple[Splats, float, float]:
        """Choose between the result, the best earlier scene, and blends of start and result.

        A result that is at least as good as all earlier scenes is kept. Otherwise the best earlier scene is
        returned if it beats the start, then the first blend that does, or the start itself.

        Returns:
            The scene, its score, and the weight of the last step's scene in it: 1, also for an earlier best
                scene; ½ or ¼ for a blend; 0 for the start.
        """
        value = self.score(result)
        if value >= self.best_score or not self.active:
            return result, value, 1.0
        if self.best is not self.start:
            return self.best, self.best_score, 1.0
        for share in _BLENDS:
            part = blend(self.start, result, share)
            value = self.score(part)
            if value > self.before:
                return part, value, share
        return self.start, self.before, 0.0

    def arrays(self) -> dict[str, Values]:
        """Return the best scene's arrays for a checkpoint; empty if it is the start."""
        if self.best is self.start:
            return {}
        return {f"{_BEST}{name}": getattr(self.best, name) for name in ARRAYS}

    def load(self, meta: dict[str, Any], arrays: dict[str, Any]) -> None:
        """Restore the state from `meta` and `arrays`, and remove the best scene's arrays from `arrays`."""
        for name in _STATE:
            setattr(self, name, meta[name])
        best_arrays = {name: arrays.pop(_BEST + name) for name in ARRAYS if _BEST + name in arrays}
        if best_arrays:
            self.best = replace(self.start, **best_arrays)
        else:
            self.best = self.start

    def meta(self) -> dict[str, Any]:
        """Return the state that a checkpoint stores besides the best scene."""
        return {name: getattr(self, name) for name in _STATE}


def blend(start: Splats, end: Splats, share: ArrayLike) -> Splats:
    """Blend two scenes of the same Gaussians, each attribute in the space it is optimised in.

    `share` is the weight of `end`, one for all or (N,).
    """
    end = end.narrowed()
    start = start.narrowed(end.offset)
    weight = np.broadcast_to(np.asarray(share, np.float32), (len(start),))
    mixed = []
    for row, (a, b) in enumerate(zip(arrays_of(start), arrays_of(end), strict=True)):
        if row == 1:  # q and −q are the same rotation: take the nearer one
            is_opposite = (a * b).sum(1, keepdims=True) < 0
            a = a * np.where(is_opposite, -1, 1)
        weights = weight.reshape(-1, *[1] * (a.ndim - 1))
        mixed.append((a + weights * (b - a)).astype(np.float32))
    means, quats, log_scales, logits, sh0, shN = mixed
    scales = np.exp(log_scales.astype(np.float64)).astype(np.float32)
    return Splats(
        means,
        quats,
        scales,
        logits,
        sh0,
        shN,
        end.offset,
        end.render_model,
        end.up,
        end.axes,
    )
