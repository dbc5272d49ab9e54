"""NanoGS (arXiv 2603.16103), training-free pairwise merging, in NumPy.

Two changes give an exact count, which the original misses by one: the last pass stops at the budget, and the
opacity cut keeps at least as many Gaussians as the budget. "One shared standard-normal sample a component"
is implemented as one draw per member of a pair, shared by all pairs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import g2ard._core as _core
from g2ard.errors import InputError
from g2ard.scene.splats import Splats
from g2ard.scene.transform import rotation_matrices

__all__ = ["nanogs"]

_Floats = NDArray[np.float64]
_NEIGHBORS = 16
_EPSILON_VARIANCE, _EPSILON_MASS = 1e-8, 1e-12
_SAMPLES = np.random.default_rng(0).standard_normal((2, 3))
_CHUNK = 1 << 17


@dataclass(frozen=True, eq=False)
class _Rows:
    """Gaussians in float64: means, axes (columns) and variances along them, α, flat SH coefficients."""

    means: _Floats
    axes: _Floats
    variances: _Floats
    alpha: _Floats
    sh: _Floats

    def take(self, rows: NDArray[Any]) -> _Rows:
        return _Rows(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    def followed_by(self, other: _Rows) -> _Rows:
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return _Rows(*(np.concatenate(pair) for pair in pairs))

    @property
    def mass(self) -> _Floats:
        """The mass (2π)^1.5·α·volume."""
        return (2 * np.pi) ** 1.5 * self.alpha * np.sqrt(self.variances.prod(1)) + _EPSILON_MASS

    @property
    def covariances(self) -> _Floats:
        return np.einsum("nij,nj,nkj->nik", self.axes, self.variances, self.axes)


def nanogs(splats: Splats, budget: int) -> Splats:
    """Reduce a scene to exactly `budget` Gaussians by NanoGS's passes of disjoint pair merges.

    A pass takes edges of the 16-nearest-neighbour graph by ascending cost KL(pair ‖ merged) + ‖ΔSH‖².
    Unmerged rows come first in the result, in their order.

    >>> rng = np.random.default_rng(0)
    >>> scene = Splats.create(rng.normal(size=(200, 3)), scales=np.full((200, 3), 0.1))
    >>> len(nanogs(scene, 20))
    20
    """
    if not splats.finite_rows().all():
        raise InputError("splats: a row is not finite")
    rows = _rows(splats)
    rows = rows.take(_opaque(rows.alpha, budget))
    half = max(1, len(splats) // 2)
    while len(rows.means) > budget:
        i, j = _pairs(rows, min(half, len(rows.means) - budget))
        alone = np.ones(len(rows.means), bool)
        alone[i] = alone[j] = False
        rows = rows.take(alone).followed_by(_merged(rows.take(i), rows.take(j)))
    return _splats(rows, splats)


def _opaque(alpha: _Floats, budget: int) -> NDArray[np.intp]:
    """Return rows with at least min(0.1, median α), or the `budget` most opaque if that is more."""
    least = max(budget, int(np.count_nonzero(alpha >= min(0.1, float(np.median(alpha))))))
    return np.sort(np.argsort(-alpha, kind="stable")[:least])


def _pairs(rows: _Rows, most: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return at most `most` disjoint edges, chosen greedily by ascending cost."""
    n = len(rows.means)
    near = _core.knn(np.ascontiguousarray(rows.means), min(_NEIGHBORS, n - 1)).astype(np.int64)
    a = np.repeat(np.arange(n), near.shape[1])
    b = near.ravel()
    code = np.unique(np.minimum(a, b) * n + np.maximum(a, b))
    i, j = code // n, code % n
    mass, covariances = rows.mass, rows.covariances
    parts = [slice(s, s + _CHUNK) for s in range(0, len(code), _CHUNK)]
    cost = np.concatenate([_cost(rows, mass, covariances, i[part], j[part]) for part in parts])
    by_cost = np.argsort(cost, kind="stable")
    i, j = i[by_cost], j[by_cost]
    chosen = _greedy(i, j, n)[:most]
    return i[chosen], j[chosen]


def _greedy(i: NDArray[np.intp], j: NDArray[np.intp], n: int) -> NDArray[np.intp]:
    """Return the edges that a greedy walk in rank order takes, in that order.

    All edges that are the first remaining one at both ends can be taken at once.
    """
    left, taken = np.arange(len(i)), []
    while len(left):
        first = np.full(n, len(i))
        np.minimum.at(first, i[left], left)
        np.minimum.at(first, j[left], left)
        won = left[(first[i[left]] == left) & (first[j[left]] == left)]
        taken.append(won)
        free = np.ones(n, bool)
        free[i[won]] = free[j[won]] = False
        left = left[free[i[left]] & free[j[left]]]
    return np.sort(np.concatenate(taken))


def _cost(
    rows: _Rows, mass: _Floats, covariances: _Floats, i: NDArray[np.intp], j: NDArray[np.intp]
) -> _Floats:
    share = mass[i] / (mass[i] + mass[j])
    log_p = np.zeros(len(i))
    for k, own, weight in ((0, i, share), (1, j, 1 - share)):
        step = np.sqrt(rows.variances[own] + _EPSILON_VARIANCE) * _SAMPLES[k]
        x = rows.means[own] + np.einsum("nij,nj->ni", rows.axes[own], step)
        with np.errstate(divide="ignore"):  # a share of 0 has no weight
            logs = np.logaddexp(
                np.log(share) + _log_density(rows, i, x),
                np.log1p(-share) + _log_density(rows, j, x),
            )
        log_p += weight * logs
    between = rows.means[i] - rows.means[j]
    wide = share[:, None, None] * covariances[i] + (1 - share)[:, None, None] * covariances[j]
    wide += (share * (1 - share))[:, None, None] * between[:, :, None] * between[:, None, :]
    wide += _EPSILON_VARIANCE * np.eye(3)
    log_q = -0.5 * (3 * np.log(2 * np.pi) + np.linalg.slogdet(wide)[1] + 3)
    return log_p - log_q + ((rows.sh[i] - rows.sh[j]) ** 2).sum(1)


def _log_density(rows: _Rows, at: NDArray[np.intp], x: _Floats) -> _Floats:
    local = np.einsum("nij,ni->nj", rows.axes[at], x - rows.means[at])
    variances = rows.variances[at] + _EPSILON_VARIANCE
    return -0.5 * (3 * np.log(2 * np.pi) + (np.log(variances) + local**2 / variances).sum(1))


def _merged(a: _Rows, b: _Rows) -> _Rows:
    share = (a.mass / (a.mass + b.mass))[:, None]
    between = a.means - b.means
    covariances = share[..., None] * a.covariances + (1 - share)[..., None] * b.covariances
    covariances += (share * (1 - share))[..., None] * between[:, :, None] * between[:, None, :]
    variances, axes = np.linalg.eigh(covariances + _EPSILON_VARIANCE * np.eye(3))
    axes[np.linalg.det(axes) < 0, :, 0] *= -1
    return _Rows(
        share * a.means + (1 - share) * b.means,
        axes,
        np.maximum(variances, _EPSILON_VARIANCE),
        a.alpha + b.alpha - a.alpha * b.alpha,
        share * a.sh + (1 - share) * b.sh,
    )


def _rows(splats: Splats) -> _Rows:
    axes = rotation_matrices(splats.quats)
    sh = np.concatenate([splats.sh0, splats.shN], 1).astype(np.float64).reshape(len(splats), -1)
    alpha = splats.opacities.astype(np.float64)
    return _Rows(
        splats.means.astype(np.float64), axes, splats.scales.astype(np.float64) ** 2, alpha, sh
    )


def _splats(rows: _Rows, like: Splats) -> Splats:
    alpha = np.clip(rows.alpha, 1e-6, 1 - 1e-6)
    sh = rows.sh.reshape(len(rows.sh), -1, 3)
    return Splats.create(
        rows.means.astype(like.means.dtype),
        quats=_quats(rows.axes),
        scales=np.sqrt(rows.variances),
        logit_opacities=np.log(alpha / (1 - alpha)),
        sh0=sh[:, :1],
        shN=sh[:, 1:],
        offset=like.offset,
    )


def _quats(axes: _Floats) -> _Floats:
    """Return wxyz quaternions: the top eigenvector of Bar-Itzhack's symmetric matrix."""
    r = axes
    k = np.zeros((len(r), 4, 4))
    k[:, 0, 0] = r[:, 0, 0] + r[:, 1, 1] + r[:, 2, 2]
    for a, (b, c) in enumerate(((1, 2), (2, 0), (0, 1))):
        k[:, 0, a + 1] = k[:, a + 1, 0] = r[:, c, b] - r[:, b, c]
        k[:, a + 1, a + 1] = r[:, a, a] - r[:, b, b] - r[:, c, c]
        k[:, b + 1, c + 1] = k[:, c + 1, b + 1] = r[:, b, c] + r[:, c, b]
    return np.linalg.eigh(k)[1][:, :, 3]
