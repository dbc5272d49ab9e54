"""PSNR of a few views during recovery."""

import math
import time
from collections.abc import Callable

import numpy as np

import g2ard._core as _core
from g2ard.arrays import Float32, Mask
from g2ard.rendering.exposure import rendered
from g2ard.rendering.metrics import psnr
from g2ard.rendering.renderer import Renderer, arrays_of, centred, settings_for, view_of
from g2ard.rendering.targets import Exposed, Subset, Targets, mask_of, scored_in, with_pixels
from g2ard.scene.cameras import rows_by_kind
from g2ard.scene.samples import evenly_spaced
from g2ard.scene.splats import Splats
from g2ard.system.threads import in_threads

_SCORED_VIEWS = 8
"""Views that are scored, of training and of each kind of validation views."""
_INVISIBLE_PSNR = 40.0
"""PSNR in dB above which differences are invisible, so that no validation view counts for more."""
_INVISIBLE_MSE = 1e-4
"""Mean squared error at that PSNR."""
_LEAST_MSE = 1e-12
"""Least mean squared error, so that logarithms stay finite."""
_TOLERATED_LOSS = 1.0
"""Loss in dB up to which no Gaussian goes back for a view."""
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
        self._targets = targets
        self._background = background
        self._most = most
        self._next = 0.0
        self._latest = (float("nan"), 0)
        self._scored: tuple[Splats, float] | None = None

    @property
    def scored_in(self) -> str:
        """Number, kind and size of the views."""
        some = Subset(self._targets, self._views)
        return scored_in(Exposed(some) if isinstance(self._targets, Exposed) else some, "training")

    def fit_exposures(self) -> None:
        """Score after a fit of exposures from now on."""
        self._targets = Exposed(self._targets)
        self._scored = None

    def score(self, splats: Splats) -> float:
        """Return the mean PSNR over the views; that of the latest scene is known."""
        if self._scored is None or self._scored[0] is not splats:
            renderer = Renderer(splats, background=self._background)
            scores = in_threads(lambda view: self._score(renderer, view), self._views)
            self._scored = splats, float(np.mean(list(scores)))
        return self._scored[1]

    def score_latest(
        self, splats: Callable[[], Splats], step: int, seconds: float
    ) -> tuple[float, int]:
        """Return the mean PSNR and its step; the previous ones if scoring has used its share of the time.

        `splats` returns the current scene, after `step` steps and `seconds` of recovery.
        """
        if seconds >= self._next:
            began = time.monotonic()
            self._latest = self.score(splats()), step
            # the start is outdated soon
            share = _SCORING_TIME_SHARE if self._next else _FIRST_SCORING_SHARE
            self._next = seconds + (time.monotonic() - began) / share
        return self._latest

    def _score(self, renderer: Renderer, view: int) -> float:
        image = rendered(renderer, self._targets, view)
        score = psnr(image, self._targets[view], mask_of(self._targets, view))
        return float(np.minimum(self._most, score))  # not `min`, which drops NaN


def score_by_kind(
    targets: Targets, background: tuple[float, float, float]
) -> Callable[[Splats], dict[str, float]]:
    """Return a function that scores a scene: kind of view → mean PSNR of up to eight views of that kind, each
    at most 40 dB."""
    rows = rows_by_kind(targets.cameras.kinds)
    probes = {
        kind: Probe(Subset(targets, found), background, _INVISIBLE_PSNR)
        for kind, found in rows.items()
    }
    return lambda splats: {kind: probe.score(splats) for kind, probe in probes.items()}


def find_harmful_changes(
    start: Splats,
    result: Splats,
    validation: Targets,
    training: Targets,
    background: tuple[float, float, float],
) -> Mask | None:
    """Find the Gaussians whose change made views worse; None if no validation view lost more than 1 dB.

    With E the change of the squared error in each pixel, relative to the view's mean before, Σ αT·E over the
    pixels of a Gaussian is positive if views became worse where it is seen. It must be so over the validation
    views that lost, and over all of them together with as many training views: what few validation views say
    about a Gaussian is mostly chance.
    """
    held = _Comparison(start, result, validation, background)
    views = range(len(validation.cameras))
    losing = [lost > _TOLERATED_LOSS for lost in in_threads(held.lost, views)]
    if not any(losing):
        return None
    compared = Subset(training, evenly_spaced(len(training.cameras), len(views)))
    trained = _Comparison(start, result, compared, background)
    total, worse = np.zeros((2, len(result)))
    for light, loses in zip(in_threads(held.light, views), losing, strict=True):
        total += light
        worse += light * loses
    for light in in_threads(trained.light, range(len(compared.cameras))):
        total += light
    return (total > 0) & (worse > 0)


class _Comparison:
    """Squared errors of two scenes of the same Gaussians in some views, 0 where a view is masked."""

    def __init__(
        self,
        start: Splats,
        result: Splats,
        targets: Targets,
        background: tuple[float, float, float],
    ) -> None:
        self._renderers = [Renderer(scene, background=background) for scene in (start, result)]
        self._targets = targets
        scene, self._cameras = centred(result, targets.cameras)
        self._settings = settings_for(scene.means, None, antialiased=scene.antialiased)
        means, quats, scales, logits, sh0, _ = arrays_of(scene)
        colours = np.zeros_like(sh0), np.zeros((len(scene), 0, 3), np.float32)
        self._grey = (means, quats, scales, logits, *colours)

    def _errors(self, view: int) -> list[Float32]:
        camera = self._targets.cameras[view]
        target = self._targets[view]
        mask = mask_of(self._targets, view)
        errors = []
        for renderer in self._renderers:
            away = renderer.clipped(camera) - np.asarray(target, np.float32)
            errors.append(np.einsum("yxc,yxc->yx", away, away) / 3)
        if mask is None:
            return errors
        return [error * mask for error in errors]

    def lost(self, view: int) -> float:
        """Return a view's loss in dB."""
        before, after = (
            max(float(error.mean(dtype=np.float64)), _LEAST_MSE) for error in self._errors(view)
        )
        return 10 * math.log10(after / before)

    def light(self, view: int) -> Float32:
        """Return a view's (N,) Σ αT·E, with E the change of the error relative to the mean before."""
        before, after = self._errors(view)
        image = np.zeros((*before.shape, 3), np.float32)
        usual = max(float(before.mean(dtype=np.float64)), _INVISIBLE_MSE)
        image[..., 0] = (after - before) / (usual * before.size)
        seen = view_of(self._cameras, view, self._settings)
        rasterizer = _core.Rasterizer()
        rasterizer.forward(self._grey, seen, self._settings, [0.0, 0.0, 0.0], 0)
        light: Float32 = rasterizer.backward(self._grey, image)[4][:, 0, 0]
        return light  # the gradient of a colour is Σ αT·E
