"""Skies behind small scenes, as trainers make them, and a sign with lines that are legible from near."""

import numpy as np

from g2ard.scene.reproducible import fibonacci
from g2ard.scene.splats import SH_C0, Splats
from reference.poses import box, discs, joined, rectangle


def under_sky(scene: Splats, share: float, distance: float, lowest: float = -1.0) -> Splats:
    """Return a scene under a sphere of discs that touch each other, with coarse clouds.

    Args:
        share: share of all rows that are sky.
        distance: radius, in radii of the scene.
        lowest: height of the unit sphere where the sky begins.
    """
    means = scene.means.astype(np.float64)
    middle = np.median(means, axis=0)
    radius = distance * float(np.quantile(np.linalg.norm(means - middle, axis=1), 0.98))
    count = round(len(scene) * share / (1 - share))
    ways = fibonacci(count, lowest)
    clouds = 0.6 + 0.25 * np.sin(6 * ways[:, :1]) * np.cos(5 * ways[:, 1:2])
    sky = discs(
        middle + radius * ways, -ways, 0.6 * radius * np.sqrt(2 * np.pi * (1 - lowest) / count)
    )
    return joined(scene, coloured(sky, clouds * np.array([0.8, 0.9, 1.0])))


def courtyard(spacing: float = 0.07) -> Splats:
    """Return a paved yard of 8 by 8 with a house of painted boards and a bench; z is up."""
    ground = rectangle((-4, -4, 0), (8, 0, 0), (0, 8, 0), spacing, (0, 0, 1))
    paving = 0.35 + 0.3 * (
        (np.floor(ground.means[:, :1] / 0.5) + np.floor(ground.means[:, 1:2] / 0.5)) % 2
    )
    house, bench = (
        box((-3, 1, 0), (1, 3.5, 2.4), spacing),
        box((1.5, -2, 0), (3, -1.5, 0.5), spacing),
    )
    boards = 0.3 + 0.5 * (np.floor(house.means[:, 2:] / 0.3) % 2)
    return joined(
        coloured(ground, paving * np.array([1.0, 0.95, 0.85])),
        coloured(house, boards * np.array([1.0, 0.5, 0.4])),
        coloured(bench, np.full((len(bench), 3), (0.3, 0.45, 0.7))),
    )


def sign(spacing: float = 0.012) -> Splats:
    """Return a sign of 1.2 by 0.9 with lines 3 spacings high, on a paved ground of 8 by 8; z is up.

    The lines are dashes of random lengths, dark on white.
    """
    ground = rectangle((-4, -4, 0), (8, 0, 0), (0, 8, 0), 0.1, (0, 0, 1))
    paving = 0.4 + 0.2 * ((np.floor(ground.means[:, :1]) + np.floor(ground.means[:, 1:2])) % 2)
    board = rectangle((-0.6, 0, 1), (1.2, 0, 0), (0, 0, 0.9), spacing, (0, -1, 0))
    line = np.floor(board.means[:, 2] / (3 * spacing)).astype(int)
    dash = np.floor(board.means[:, 0] / (2 * spacing)).astype(int)
    inked = np.random.default_rng(0).random((line.max() + 1, np.ptp(dash) + 1)) < 0.6
    dark = (line % 2 == 0) & inked[line, dash - dash.min()]
    post = box((-0.04, 0.02, 0), (0.04, 0.1, 1.9), 0.04)
    return joined(
        coloured(ground, np.repeat(paving, 3, axis=1)),
        coloured(board, np.where(dark[:, None], 0.1, 0.9) * np.ones(3)),
        coloured(post, np.full((len(post), 3), 0.4)),
    )


def coloured(part: Splats, colours: np.ndarray) -> Splats:
    """Return a part with these (N, 3) colours in [0, 1]."""
    sh0 = ((np.asarray(colours) - 0.5) / SH_C0).astype(np.float32)[:, None]
    return Splats.create(
        part.means,
        quats=part.quats,
        scales=part.scales,
        logit_opacities=part.logit_opacities,
        sh0=sh0,
    )
