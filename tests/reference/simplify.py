"""Simplification, naively: float64, one group at a time, sets and loops."""

import numpy as np

from reference.rotations import rotations

C0 = 0.28209479177387814


def covariance(splats, i):
    R, s = rotations(splats.quats[i]), splats.scales[i].astype(np.float64)
    return R @ np.diag(s * s) @ R.T


def footprint(scales):
    return np.prod(np.sort(np.asarray(scales, np.float64))[1:])


def optical_mass(splats, i):
    """−log(1 − α)·A with α at most 0.99."""
    alpha = min(0.99, 1 / (1 + np.exp(-float(splats.logit_opacities[i]))))
    return -np.log1p(-alpha) * footprint(splats.scales[i])


def merge(splats, rows):
    """(mean, covariance, α, sh (K, 3), mass) of one group."""
    m = np.array([optical_mass(splats, i) for i in rows])
    w = m / m.sum()
    x = splats.means[rows].astype(np.float64)
    mean = w @ x
    cov = sum(
        w[k] * (covariance(splats, i) + np.outer(x[k] - mean, x[k] - mean))
        for k, i in enumerate(rows)
    )
    values = np.linalg.eigvalsh(cov)
    area = np.sqrt(max(values[2], 0) * max(values[1], 0))
    alpha = min(0.99, 1 - np.exp(-m.sum() / area))
    sh = np.concatenate([splats.sh0[rows], splats.shN[rows]], 1).astype(np.float64)
    return mean, cov, alpha, np.einsum("i,ikc->kc", w, sh), m.sum()


def color(splats):
    """(N, 3), clamped to what an image can show."""
    return np.clip(0.5 + C0 * splats.sh0[:, 0].astype(np.float64), 0, 1)


def affine_energy(points, colors, own):
    """(1/n) Σ‖c − ĉ‖² over the first `own` points, ĉ by least squares on [1, x] over all of them."""
    if len(points) < 2:
        return 0.0
    design = np.c_[np.ones(len(points)), points - points.mean(0)]
    fit, *_ = np.linalg.lstsq(design, colors, rcond=1e-9)
    return float(((colors - design @ fit)[:own] ** 2).sum() / own)


def disc(count=4000):
    """Points that divide the unit disc into equal areas; the kernel makes do with 16."""
    i = np.arange(count)
    r, angle = np.sqrt((i + 0.5) / count), i * np.pi * (3 - np.sqrt(5))
    return np.stack([r * np.cos(angle), r * np.sin(angle)], 1)


def coverage(splats, rows, support=3.0):
    """Share of the members' footprint area that their merged Gaussian covers."""
    mean, cov, *_ = merge(splats, rows)
    values, axes = np.linalg.eigh(cov)
    normal, plane = axes[:, 0], axes[:, :0:-1]
    areas = np.array([footprint(splats.scales[i]) for i in rows])
    covs = [covariance(splats, i) for i in rows]
    extent = np.sqrt(
        sum(a * (normal @ c @ normal) for a, c in zip(areas, covs, strict=True)) / areas.sum()
    )
    covered = 0.0
    for i, c in zip(rows, covs, strict=True):
        offset = splats.means[i].astype(np.float64) - mean
        if abs(normal @ offset) > support * extent:
            continue
        root = np.linalg.cholesky(plane.T @ c @ plane)
        points = plane.T @ offset + support * disc() @ root.T
        inside = (points**2 / (support**2 * values[:0:-1])).sum(1) <= 1
        covered += np.linalg.det(root) * inside.mean()
    return covered / areas.sum()


def priority(splats, protected, weight=10.0):
    mass = np.array([optical_mass(splats, i) for i in range(len(splats))])
    return mass * (1 + weight * protected)


def surface_depths(splats):
    """Return Σ α exp(−½ dᵀ Σ⁻¹ d) of each Gaussian and its 24 nearest, across its shortest axis."""
    means = splats.means.astype(np.float64)
    covs = np.array([covariance(splats, i) for i in range(len(splats))])
    alphas = np.minimum(0.99, 1 / (1 + np.exp(-splats.logit_opacities.astype(np.float64))))
    out = alphas.copy()
    for i, cov in enumerate(covs):
        plane = np.linalg.eigh(cov)[1][:, 1:]
        for j in np.argsort(np.linalg.norm(means - means[i], axis=1), kind="stable")[:25]:
            if j != i:
                d = plane.T @ (means[i] - means[j])
                out[i] += alphas[j] * np.exp(
                    -0.5 * d @ np.linalg.solve(plane.T @ covs[j] @ plane, d)
                )
    return out


def rendered_area(cov, e2):
    """√tr adj(Σ + e²I): adj has the products of pairs of eigenvalues."""
    a, b, c = np.linalg.eigvalsh(cov + e2 * np.eye(3))
    return np.sqrt(a * b + b * c + a * c)


def merge_as_rendered(splats, rows, e2, growth):
    """(mean, covariance, α, sh (K, 3)) with mass α·A as rendered conserved; past α = 0.99 the two longer
    axes take it, up to `growth` times the area."""
    alphas = np.minimum(0.99, 1 / (1 + np.exp(-splats.logit_opacities[rows].astype(np.float64))))
    covs = [covariance(splats, i) for i in rows]
    m = alphas * [rendered_area(cov, e2) for cov in covs]
    w = m / m.sum()
    x = splats.means[rows].astype(np.float64)
    mean = w @ x
    cov = sum(w[k] * (covs[k] + np.outer(x[k] - mean, x[k] - mean)) for k in range(len(rows)))
    sh = np.concatenate([splats.sh0[rows], splats.shN[rows]], 1).astype(np.float64)
    alpha = m.sum() / rendered_area(cov, e2)
    values, axes = np.linalg.eigh(cov)
    grown = values * [1, *2 * [np.clip(alpha / 0.99, 1, growth)]]
    return mean, (axes * grown) @ axes.T, min(0.99, alpha), np.einsum("i,ikc->kc", w, sh)
