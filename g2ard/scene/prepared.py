"""Scenes in the form that kernels take: finite, contiguous, within float32's range, sorted once."""

from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import g2ard._core as _core
from g2ard.arrays import Float, Mask, Values
from g2ard.errors import InputError
from g2ard.scene.splats import Splats, unit_quats
from g2ard.system.cached import cached_property

_LIMITS = _core.defaults()["limits"]

MAX_OPACITY: float = _LIMITS["max_opacity"]
"""Renderers clip α here, so simplification makes no Gaussian more opaque."""

DRAWN_LOGITS: tuple[float, float] = _LIMITS["drawn_logits"]
"""Range of logits in which float32 represents the sigmoid."""

DRAWN_LOG_SCALES: tuple[float, float] = _LIMITS["drawn_log_scales"]
"""Range of log-scales in which float32 represents a projected covariance."""

LARGEST_SCALE = np.float32(np.exp(43))
"""Largest scale whose square fits float32; readers clamp to it too."""

_LEAST_LOGIT = np.float32(-_LIMITS["logit_of_opaque"])  # least logit; readers clamp to it too


class PreparedScene(Splats):
    """A scene whose arrays are in the form that kernels take; do not modify them.

    Its Morton order is computed on first use and shared by all stages that use the same object.
    """

    @cached_property
    def core(self) -> _core.Scene:
        """Arrays of the scene and their order in Rust."""
        return _core.Scene(self._arrays)

    def restore(self, order: NDArray[np.uint32], bounds: Float) -> None:
        """Restore `core.order` and `core.bounds` of the same scene."""
        vars(self)["core"] = _core.Scene(self._arrays, (order, bounds.tolist()))

    @property
    def _arrays(self) -> Splats:
        """A scene of the same arrays, for `core`: a reference to this one would be a cycle."""
        return Splats(**_list_values(self))


def as_prepared(splats: Splats) -> PreparedScene:
    """Return a prepared scene of the same arrays, which must be C-contiguous and finite.

    Quaternions are normalised.
    """
    if isinstance(splats, PreparedScene):
        return splats
    return PreparedScene(**_list_values(splats) | {"quats": unit_quats(splats.quats)})


def _list_values(splats: Splats) -> dict[str, Any]:
    return {f.name: getattr(splats, f.name) for f in fields(splats)}


def finite_rows_of(splats: Splats) -> tuple[PreparedScene, Mask | slice]:
    """Return the finite rows of a scene, prepared, and their mask."""
    scene = splats
    rows: Mask | slice = slice(None)
    if not _is_finite(splats):
        rows = splats.finite_rows()
        if not rows.any():
            raise InputError(f"none of the {len(splats)} rows is finite", parameter="splats")
        scene = splats.take(rows)
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
    scene = scene.with_sh_degree(_find_used_degree(scene))
    return as_prepared(scene), rows


def _is_finite(splats: Splats) -> bool:
    """Return whether a scene has rows and all are finite; infinite logits count as finite."""
    if not len(splats) or np.isnan(splats.logit_opacities).any():
        return False
    return all(
        map(_are_finite, (splats.means, splats.quats, splats.scales, splats.sh0, splats.shN))
    )


def with_some_opacity(scene: PreparedScene) -> PreparedScene:
    """Raise the α of an invisible scene so that every row has some weight in sums.

    Otherwise all rows would be dropped, or all have mass 0.
    """
    logits = scene.logit_opacities
    raised = np.where(
        np.isinf(logits),
        logits,
        np.maximum(logits, _LEAST_LOGIT),
    )
    return replace(scene, logit_opacities=raised)


def _are_finite(values: Values) -> bool:
    """Return whether all values are finite; tests the sum first, which is faster."""
    with np.errstate(over="ignore", invalid="ignore"):
        return bool(np.isfinite(values.sum()) or np.isfinite(values).all())


def _find_used_degree(scene: Splats) -> int:
    """Return the highest SH degree with a nonzero coefficient."""
    degree = scene.sh_degree
    while degree > 0:
        band = scene.shN[:, degree**2 - 1 :]
        if band[:1024].any() or band.any():
            break
        degree -= 1
    return degree
