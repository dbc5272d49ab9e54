"""Poses that a repeating scene makes look alike, and the photo's choice between them.

Features of a render at the found pose T are matched with other features of the same render. A match (u, u')
assigns to u the point X' that the render shows at u'. Where the scene repeats itself, many matches have about
the same displacement, and agree on one pose T', by PnP: the render at T' looks like the one at T. Windows of
a façade, columns, tiles and the sides of a round tower all give such poses.

Photo P and renders A, B at two such poses differ in few pixels, such as those of a door. There

λ = ½ + Σ D·(P − (A + B)/2) / Σ D²,  D = A − B,

is 1 if A explains the photo and 0 if B does. Its σ comes from the residuals where A and B agree.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from g2ard.rendering.renderer import Renderer
from g2ard.scene.cameras import Camera
from g2ard.stages.register.config import RegisterConfig
from g2ard.stages.register.grey import blurred
from g2ard.stages.register.matchers import Sift
from g2ard.stages.register.pose import Float
from g2ard.stages.register.solve import lifted, solve_pnp

_MOST_REPEATS = 12
"""Most repetitions that are looked for."""
_LEAST_SHIFT = 0.04
"""Least distance of matched features, as a share of the longer side."""
_LIKE = 0.3
"""Largest squared distance of matched descriptors of norm 1."""
_MOST_FEATURES = 700
"""About the most features that are matched."""
_MOST_MATCHES = 250
"""About the most matches that a repetition is solved from."""
_CELL = 0.05
"""Side of the cells of displacements, as a share of the longer side; 3 × 3 of them make a repetition."""
_LEAST_SUPPORT = 12, 0.05
"""Least matches that support a repetition, and as a share of the features."""
_AGREEING = 0.04
"""Largest difference in any channel at pixels where two renders agree."""
_DECISIVE = 3.0
"""σ of λ between two poses beyond which one is excluded."""
_MODEL_SIGMA = 0.08
"""σ of λ because a scene never renders as a photo looks."""


class Look(NamedTuple):
    """A render at the size of a photo: (H, W, 3) blurred colours, and the mask of opaque pixels."""

    image: Float
    mask: NDArray[np.bool_]


def look(renderer: Renderer, camera: Camera, config: RegisterConfig) -> Look:
    """Render a `Look`."""
    out = renderer.render(camera)
    return Look(softened(np.clip(out.image, 0, 1)), out.alpha >= config.min_alpha)


def softened(image: NDArray[np.float32]) -> Float:
    """Blur each channel of an (H, W, 3) image."""
    return np.stack([blurred(image[..., c].astype(np.float64)) for c in range(3)], 2)


def repeated_poses(renderer: Renderer, camera: Camera, sift: Sift, config: RegisterConfig) -> list[Float]:
    """Return the poses whose renders look like the one of `camera`, most supported first."""
    out = renderer.render(camera, median=True)
    places, descriptors = sift.features(np.clip(out.image, 0, 1))
    points, known = lifted(out, camera, places, config)
    step = 1 + int(known.sum()) // _MOST_FEATURES
    places, points = places[known][::step], points[known][::step]
    descriptors = descriptors[known][::step] / np.float32(512)
    least = max(_LEAST_SUPPORT[0], int(_LEAST_SUPPORT[1] * len(places)))
    if len(places) < least:
        return []
    side = max(camera.width, camera.height)
    squares = 2 - 2 * descriptors @ descriptors.T
    apart = np.hypot(*(np.subtract.outer(axis, axis) for axis in places.T))
    i, j = np.nonzero((squares < _LIKE) & (apart > _LEAST_SHIFT * side))
    cells = np.floor((places[j] - places[i]) / (_CELL * side)).astype(int)
    if not len(cells):
        return []
    cells -= cells.min(0) - 2
    found: list[Float] = []
    left = np.ones(len(i), bool)
    while left.any() and len(found) < _MOST_REPEATS:
        table = np.zeros(tuple(cells.max(0) + 2), int)
        np.add.at(table, tuple(cells[left].T), 1)
        near = np.sum([np.roll(table, shift, (0, 1)) for shift in np.ndindex(3, 3)], axis=0)
        centre = np.array(np.unravel_index(int(np.argmax(near)), near.shape)) - 1
        if near.max() < least:
            break
        one = np.flatnonzero(left & (np.abs(cells - centre).max(1) <= 1))
        left[one] = False
        one = one[:: 1 + len(one) // _MOST_MATCHES]
        answer = solve_pnp(camera, places[i[one]], points[j[one]], config)
        if answer is not None and answer[1].sum() >= _LEAST_SUPPORT[0]:
            found.append(answer[0])
    return found


def preference(photo: Float, mask: NDArray[np.bool_], a: Look, b: Look, config: RegisterConfig) -> float:
    """Return (λ − ½)/σ: above `DECISIVE`, the photo excludes b, below its negative it excludes a.

    Where a render shows nothing, it predicts the photo's mean colour. Gain and bias of each channel are those
    of the pixels where the renders agree.
    """
    usual = photo[mask].mean(0)
    both = mask & a.mask & b.mask
    agree = both & (np.abs(a.image - b.image).max(2) < _AGREEING)
    if agree.sum() < 0.02 * mask.sum():
        agree = both
    if not agree.any():
        return 0.0
    mean, seen = ((a.image + b.image) / 2)[agree], photo[agree]
    spread = np.maximum(((mean - mean.mean(0)) ** 2).mean(0), 1e-6)
    gain = np.clip(((mean - mean.mean(0)) * (seen - seen.mean(0))).mean(0) / spread, 0.1, 10)
    bias = seen.mean(0) - gain * mean.mean(0)
    noise = float(((seen - gain * mean - bias) ** 2).mean())
    first, second = (np.where(each.mask[..., None], gain * each.image + bias, usual) for each in (a, b))
    counts = mask & (a.mask | b.mask)
    D = (first - second)[counts]
    energy = float((D * D).sum())
    if energy < 1e-9:
        return 0.0
    share = float((D * (photo[counts] - (first + second)[counts] / 2)).sum()) / energy
    sigma = np.hypot(_MODEL_SIGMA, np.sqrt(3 * config.window**2 * noise / energy))
    return float(share / sigma)


def decisive(preference: float) -> bool:
    """Return whether a `preference` excludes the second pose."""
    return preference > _DECISIVE
