"""View selection without shortcuts: dense float64 depths, the objective as written, greedy by trying all."""

import numpy as np

from reference.rotations import rotations


def median_depth(splats, viewmat, K, pixels):
    """Return the (n,) depths at which transmittance falls below one half in pixels (n, 2); 0 if it does not.

    Every Gaussian is evaluated at every pixel.
    """
    means = splats.means.astype(np.float64) + splats.offset
    camera = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    order = np.argsort(camera[:, 2], kind="stable")
    order = order[camera[order, 2] > 0.01]
    light, depth = np.ones(len(pixels)), np.zeros(len(pixels))
    width, height = 2 * K[0, 2], 2 * K[1, 2]  # the tests' principal points are centred
    for i in order:
        x, y, z = camera[i]
        u = np.clip(x / z, -0.65 * width / K[0, 0], 0.65 * width / K[0, 0])
        v = np.clip(y / z, -0.65 * height / K[1, 1], 0.65 * height / K[1, 1])
        J = (
            np.array([[K[0, 0] / z, 0, -K[0, 0] * u / z], [0, K[1, 1] / z, -K[1, 1] * v / z]])
            @ viewmat[:3, :3]
        )
        R = rotations(splats.quats[i].astype(np.float64))
        cov = J @ R @ np.diag(splats.scales[i].astype(np.float64) ** 2) @ R.T @ J.T + 0.3 * np.eye(
            2
        )
        dx, dy = (pixels - [K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]]).T
        (a, b), (_, c) = np.linalg.inv(cov)
        power = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
        alpha = np.minimum(float(splats.opacities[i]) * np.exp(-power), 0.99)
        alpha[alpha < 1 / 255] = 0
        before = light.copy()
        light *= 1 - alpha
        depth[(before >= 0.5) & (light < 0.5)] = z
    return depth


def anchors(count=32):
    k = np.arange(count)
    z = 1 - (2 * k + 1) / count
    turn = 2 * np.pi * ((k * (np.sqrt(5) - 1) / 2) % 1)
    across = np.sqrt(1 - z * z)
    return np.stack([across * np.cos(turn), across * np.sin(turn), z], 1)


def objective(
    chosen,
    surface,
    seen,
    positions,
    *,
    directional,
    kappa=20.0,
    alpha=2.0,
    offset=1.0,
    directions=32,
    epsilon=1e-9,
):
    """F(S) as equation 2 has it; `seen[v]` lists cells, `positions` are in the surface's coordinates."""
    m = len(surface.centers)
    if directional:
        a = anchors(directions)
        raw = np.exp(kappa * np.abs(surface.normals @ a.T))
        target = raw / raw.sum(1, keepdims=True)
    else:
        target = np.ones((m, 1))
    evidence = np.zeros_like(target)
    for v in chosen:
        for j in seen[v]:
            if not directional:
                evidence[j, 0] += 1
                continue
            d = positions[v] - surface.centers[j]
            d = d / np.linalg.norm(d)
            confidence = surface.confidence[j]
            incidence = (1 - confidence) + confidence * abs(d @ surface.normals[j])
            phi = np.where(a @ d - 1 > -3 / kappa, np.exp(kappa * (a @ d)), 0)
            evidence[j] += incidence * phi / phi.sum()
    x = offset + evidence / (target + epsilon)
    u = np.log(x) if alpha == 1 else x ** (1 - alpha) / (1 - alpha)
    return float((surface.weights[:, None] * target * u).sum())


def greedy(k, surface, seen, positions, **options):
    """Views and gains, the best of all tried at every step; of equals the first."""
    chosen, gains = [], []
    value = objective([], surface, seen, positions, **options)
    for _ in range(k):
        rest = [v for v in range(len(seen)) if v not in chosen]
        tried = [objective([*chosen, v], surface, seen, positions, **options) - value for v in rest]
        best = int(np.argmax(np.round(tried, 14)))
        chosen.append(rest[best])
        gains.append(tried[best])
        value += tried[best]
    return chosen, gains


def represent(k, alike, wanted, shares):
    """Farthest first while a pose is over two bandwidths away, then facility location; each times share^¼."""
    worth = shares**0.25
    away = np.sqrt(-np.log(np.maximum(alike, np.finfo(float).tiny)))
    chosen = [
        int(
            np.argmax(
                [
                    worth[v] / sum(wanted[u] * away[u, v] for u in range(len(alike)))
                    for v in range(len(alike))
                ]
            )
        )
    ]
    while len(chosen) < k:
        reach = away[:, chosen].min(1)
        if reach.max() > 2:
            chosen.append(int(np.argmax(np.where(reach > 2, worth * reach, -1))))
            continue
        now = wanted @ alike[:, chosen].max(1)
        tried = [
            -1 if v in chosen else worth[v] * (wanted @ alike[:, [*chosen, v]].max(1) - now)
            for v in range(len(alike))
        ]
        chosen.append(int(np.argmax(np.round(tried, 14))))
    return chosen


def brightest(received, before, k):
    """Greedy maximisation of Σ log(1 + before + Σ received) by trying all; return views and gains."""
    received, total = received.astype(np.float64), before.astype(np.float64).copy()
    views, gains = [], []
    for _ in range(min(k, len(received))):
        added = [
            -np.inf if v in views else np.log((1 + total + r) / (1 + total)).sum()
            for v, r in enumerate(received)
        ]
        views.append(int(np.argmax(added)))
        gains.append(added[views[-1]])
        total += received[views[-1]]
    return views, gains
