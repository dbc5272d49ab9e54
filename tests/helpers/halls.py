"""A closed hall under a hazy ceiling, as captures of interiors look from outside: a scene to stand in."""

import numpy as np

from g2ard.scene.splats import SH_C0, Splats
from reference.poses import joined, rectangle

SIZE = (36.0, 22.0, 6.5)
"""Length, width and height of the hall from the origin; z up."""


def hall(spacing: float = 0.09, plate: float = 0.5) -> Splats:
    """Return walls with pictures, a tiled floor, crates, columns and a translucent ceiling of plates."""
    rng = np.random.default_rng(5)
    x, y, z = SIZE
    parts = [painted(rectangle((0, 0, 0), (x, 0, 0), (0, y, 0), spacing, (0, 0, 1)), "tiles")]
    for corner, along, normal in (
        ((0, 0, 0), (x, 0, 0), (0, 1, 0)),
        ((0, y, 0), (x, 0, 0), (0, 1, 0)),
        ((0, 0, 0), (0, y, 0), (1, 0, 0)),
        ((x, 0, 0), (0, y, 0), (1, 0, 0)),
    ):
        parts.append(painted(rectangle(corner, along, (0, 0, z), spacing, normal), "pictures"))
    for _ in range(26):
        low = (*rng.uniform((2, 2), (x - 3, y - 3)), 0.0)
        parts.append(_block(low, rng.uniform(0.6, 1.6, 3), spacing / 1.5, rng.random(3)))
    for column in np.arange(6, x - 3, 6):
        parts += [
            _block((column, side, 0), (0.5, 0.5, z), spacing, (0.8, 0.8, 0.75))
            for side in (6, 15.5)
        ]
    ceiling = rectangle((0, 0, z), (x, 0, 0), (0, y, 0), plate, (0, 0, 1))
    haze = rng.uniform(0.8, 3, (len(ceiling), 1)) * ceiling.scales
    parts.append(
        Splats.create(
            ceiling.means + rng.normal(0, (0.1, 0.1, 0.3), (len(ceiling), 3)),
            quats=ceiling.quats,
            scales=haze,
            logit_opacities=rng.uniform(-2, 2, len(ceiling)),
            sh0=_sh0(np.full((len(ceiling), 3), 0.55) + rng.normal(0, 0.03, (len(ceiling), 1))),
        )
    )
    return joined(*parts)


def open_hall(spacing: float = 0.085) -> Splats:
    """Return a wide hall without a roof: a tiled floor of 60 by 40, walls with pictures and crates."""
    rng, (x, y, z) = np.random.default_rng(7), (60.0, 40.0, 5.0)
    parts = [painted(rectangle((0, 0, 0), (x, 0, 0), (0, y, 0), spacing, (0, 0, 1)), "tiles")]
    for corner, along, normal in (
        ((0, 0, 0), (x, 0, 0), (0, 1, 0)),
        ((0, y, 0), (x, 0, 0), (0, 1, 0)),
        ((0, 0, 0), (0, y, 0), (1, 0, 0)),
        ((x, 0, 0), (0, y, 0), (1, 0, 0)),
    ):
        parts.append(painted(rectangle(corner, along, (0, 0, z), spacing, normal), "pictures"))
    for _ in range(20):
        low = (*rng.uniform((2, 2), (x - 3, y - 3)), 0.0)
        parts.append(_block(low, rng.uniform(0.6, 1.6, 3), spacing / 1.5, rng.random(3)))
    return joined(*parts)


def _block(low, sides, spacing, colour) -> Splats:
    from reference.poses import box

    block = box(low, np.add(low, sides), spacing, floor=False)
    stripes = 0.25 * (np.floor(block.means.sum(axis=1) / 0.3) % 2)
    return _coloured(block, np.clip(np.asarray(colour) * (1 - stripes[:, None]), 0, 1))


def painted(part: Splats, what: str) -> Splats:
    """Return a part with the colours of tiles, or of pictures on a wall."""
    x, y, z = part.means.T
    if what == "tiles":
        shade = 0.45 + 0.25 * ((np.floor(x) + np.floor(y)) % 2)
        return _coloured(part, shade[:, None] * np.array([1.0, 0.9, 0.75]))
    along = x + y
    frame = (z > 1.2) & (z < 3.4) & (along % 4 > 1)
    inner = np.stack(
        [0.5 + 0.5 * np.sin(k * along + 2 * z + k * np.floor(along / 4)) for k in (1, 2, 3)], 1
    )
    return _coloured(part, np.where(frame[:, None], inner, 0.85))


def _coloured(part: Splats, colours) -> Splats:
    return Splats.create(
        part.means,
        quats=part.quats,
        scales=part.scales,
        logit_opacities=part.logit_opacities,
        sh0=_sh0(colours),
    )


def _sh0(colours):
    return ((np.asarray(colours) - 0.5) / SH_C0)[:, None]
