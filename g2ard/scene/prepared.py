"""Scenes as the kernels take them: finite, contiguous, cut to what float32 can follow, put in order once."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard import _core
from g2ard.errors import InputError
from g2ard.scene.splats import Splats

_LIMITS = _core.defaults()["limits"]

MAX_OPACITY: float = _LIMITS["max_opacity"]
"""Renderers clip α here, so simplification makes no Gaussian more opaque."""

DRAWN_LOGITS: tuple[float, float] = _LIMITS["drawn_logits"]
"""Where float32 can follow the sigmoid."""

DRAWN_LOG_SCALES: tuple[float, float] = _LIMITS["drawn_log_scales"]
"""Natural logarithms of the scales between which float32 can follow a projected covariance."""

LARGEST_SCALE = np.float32(np.exp(43))
"""A scale whose square is a float32; files' readers clamp to it too."""

_FAINTEST = np.float32(-_LIMITS["logit_of_opaque"])
"""A logit; files' readers clamp to it too."""


class PreparedScene(Splats):
    """A scene whose arrays are as the kernels take them; do not change them while it is in use.

    Its order is found when first asked for, and shared by all stages that are given the same object.
    """

    @cached_property
    def core(self) -> _core.Scene:
        """The scene's arrays and their order."""
        return _core.Scene(self)

    def restore(self, order: NDArray[np.uint32], bounds: NDArray[np.float64]) -> None:
        """Take what `core.order` and `core.bounds` were found to be of the same scene before.

        Raises:
            InputError: not each row once.
        """
        vars(self)["core"] = _core.Scene(self, (order, bounds.tolist()))


def as_prepared(splats: Splats) -> PreparedScene:
    """The same object where it is prepared, else one of its arrays, which must be C-contiguous and finite."""
    if isinstance(splats, PreparedScene):
        return splats
    return PreparedScene(**{f.name: getattr(splats, f.name) for f in fields(splats)})


def finite_rows_of(splats: Splats) -> tuple[PreparedScene, NDArray[np.bool_] | slice]:
    """The finite rows of a scene, prepared, and which they are.

    Raises:
        InputError: no row is finite.
    """
    arrays = (splats.means, splats.quats, splats.scales, splats.sh0, splats.shN)
    everything = all(_all_finite(a) for a in arrays) and not np.isnan(splats.logit_opacities).any()
    finite = np.ones(len(splats), bool) if everything else splats.finite_rows()
    if not finite.any():
        raise InputError(f"none of {len(splats)} rows is finite", parameter="splats")
    scene = splats if everything else splats.take(finite)
    kind = np.float64 if scene.means.dtype == np.float64 else np.float32
    scales = np.ascontiguousarray(scene.scales, np.float32)
    if scales.max() > LARGEST_SCALE:
        scales = np.minimum(scales, LARGEST_SCALE)
    scene = replace(
        scene,
        means=np.ascontiguousarray(scene.means, kind),
        quats=np.ascontiguousarray(scene.quats, np.float32),
        scales=scales,
        logit_opacities=np.ascontiguousarray(scene.logit_opacities, np.float32),
        sh0=np.ascontiguousarray(scene.sh0, np.float32),
        shN=np.ascontiguousarray(scene.shN, np.float32),
    )
    scene = scene.with_sh_degree(_used_degree(scene))
    return as_prepared(scene), slice(None) if everything else finite


def with_some_opacity(scene: PreparedScene) -> PreparedScene:
    """A scene of which nothing shows, with an α that leaves every row some weight in sums.

    Dropping the transparent would leave nothing, and a mass of 0 no reason to keep one place over another.
    """
    logits = scene.logit_opacities
    return replace(scene, logit_opacities=np.where(np.isinf(logits), logits, np.maximum(logits, _FAINTEST)))


def _all_finite(values: NDArray[Any]) -> bool:
    """A sum is finite only if all its terms are; where it overflows they are tested one by one."""
    with np.errstate(over="ignore", invalid="ignore"):
        return bool(np.isfinite(values.sum()) or np.isfinite(values).all())


def _used_degree(scene: Splats) -> int:
    """The highest SH degree that any Gaussian has a coefficient of."""
    degree = scene.sh_degree
    while degree > 0:
        band = scene.shN[:, degree**2 - 1 :]
        if band[:1024].any() or band.any():
            break
        degree -= 1
    return degree
