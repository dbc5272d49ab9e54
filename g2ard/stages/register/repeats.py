"""Poses that a repeating scene makes look alike, and the photo's choice between them.

Features of a render at the found pose T are matched with other features of the same render. A match (u, u')
says that the places X and X', which the render shows there, look alike. Common displacements X' − X give
poses T' = T·(I, X − X') moved along a façade, columns or tiles; matches with common displacements u' − u
give others by PnP, such as those around a round tower. T' counts if the render resembles itself where T'
shows X at u': the grey at u and u' is alike over much of the image. That needs no further render.

Photo P and renders A, B at two such poses differ in few pixels, such as those of a door. There

λ = ½ + Σ D·(P − (A + B)/2) / Σ D²,  D = A − B,

is 1 if A explains the photo and 0 if B does. Its variance is that of a model's inaccuracy, of the residuals
where A and B agree, and of the largest thing there that neither explains, since such a thing may also hide
or feign a difference: with energy U, a share of λ between 0 and √(U/ΣD²), of variance U/(12 ΣD²).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from g2ard.arrays import Float, Float32, Mask, Rows
from g2ard.io.images import resize
from g2ard.rendering.renderer import Rendered, Renderer
from g2ard.scene.cameras import Camera, within_frame
from g2ard.stages.register.config import RegisterConfig
from g2ard.stages.register.grey import band_passed, blurred, box_mean, grey_of, zncc
from g2ard.stages.register.matchers import Sift
from g2ard.stages.register.pose import pose_error
from g2ard.stages.register.solve import lifted, solve_pnp

_MOST_PAIRS = 50_000
"""About the most pairs of like features that are counted."""
_MOST_POINT_PEAKS = 96
"""Most common displacements of points that are tried."""
_MOST_PIXEL_PEAKS = 8
"""Most common displacements of pixels that are tried."""
_MOST_REPEATS = 6
"""Most poses that are returned."""
_LEAST_SHIFT = 0.04
"""Least distance of matched features, as a share of the longer side."""
_LIKE = 0.3
"""Largest squared distance of matched descriptors of norm 1."""
_MOST_FEATURES = 700
"""About the most features that are matched."""
_MOST_MATCHES = 250
"""About the most matches that a pose is solved from."""
_PIXEL_CELL = 0.05
"""Side of the cells of displacements of pixels, as a share of the longer side; they and their neighbours make
a repetition."""
_POINT_CELL = 0.02
"""The same of points, as a share of the depth."""
_LEAST_SUPPORT = 12
"""Least matches that support a repetition."""
_LEAST_SUPPORT_SHARE = 0.05
"""The same as a share of the features."""
_SELF_SIDE = 125
"""Longer side in pixels at which a render is compared with itself."""
_SELF_LIKE = 0.5
"""Least ZNCC of a render with itself as moved by a repetition."""
_LEAST_COMPARED = 0.15
"""Least share of its pixels that are compared."""
_AGREEING = 0.04
"""Largest difference in any channel at pixels where two renders agree, besides that by alignment."""
_MISALIGNED = 0.7
"""Largest error of their alignment, pixels."""
_LEAST_NOISE = 0.02
"""Least σ of a photo's colours."""
_DECISIVE = 3.0
"""σ of λ between two poses beyond which one is excluded."""
_MODEL_SIGMA = 0.08
"""σ of λ because a scene never renders as a photo looks."""
_THING = 8
"""Longer side of an image over that of the windows in which something unexplained is looked for."""


class Look(NamedTuple):
    """A render at the size of a photo: (H, W, 3) blurred colours, and the mask of opaque pixels."""

    image: Float
    mask: Mask


def look(renderer: Renderer, camera: Camera, config: RegisterConfig) -> Look:
    """Render a `Look`."""
    out = renderer.render(camera)
    return Look(
        softened(np.clip(out.image, 0, 1)),
        out.alpha >= config.min_alpha,
    )


def softened(image: Float32) -> Float:
    """Blur each channel of an (H, W, 3) image."""
    return np.stack([blurred(image[..., c].astype(np.float64)) for c in range(3)], 2)


def repeated_poses(
    renderer: Renderer,
    camera: Camera,
    sift: Sift,
    config: RegisterConfig,
) -> list[Float]:
    """Return at most `_MOST_REPEATS` poses whose renders look like the one of `camera`, most alike first."""
    out = renderer.render(camera, median=True)
    places, descriptors = sift.features(np.clip(out.image, 0, 1))
    points, known = lifted(out, camera, places, config)
    step = 1 + int(known.sum()) // _MOST_FEATURES
    places = places[known][::step]
    points = points[known][::step]
    descriptors = descriptors[known][::step] / np.float32(512)
    least = max(_LEAST_SUPPORT, int(_LEAST_SUPPORT_SHARE * len(places)))
    if len(places) < least:
        return []
    side = max(camera.width, camera.height)
    squares = 2 - 2 * descriptors @ descriptors.T  # of the descriptors' distances
    apart = np.hypot(*(np.subtract.outer(axis, axis) for axis in places.T))
    alike = squares < _LIKE
    alike &= apart > _LEAST_SHIFT * side
    i, j = np.nonzero(alike)
    stride = 1 + len(i) // _MOST_PAIRS
    i = i[::stride]
    j = j[::stride]
    depth = float(np.median(points @ camera.viewmat[2, :3] + camera.viewmat[2, 3]))
    offsets = points[j] - points[i]
    shifts = places[j] - places[i]
    poses: list[Float] = []
    for one in _find_common(offsets / (_POINT_CELL * depth), least, _MOST_POINT_PEAKS):
        back = np.eye(4)
        back[:3, 3] = -np.median(offsets[one], 0)
        poses.append(camera.viewmat @ back)
    for one in _find_common(shifts / (_PIXEL_CELL * side), least, _MOST_PIXEL_PEAKS):
        few = one[:: 1 + len(one) // _MOST_MATCHES]
        pixels = places[i[few]]
        answer = solve_pnp(camera, pixels, points[j[few]], config)
        if answer is not None and answer[1].sum() >= _LEAST_SUPPORT:
            poses.append(answer[0])
    resemblance = _Resemblance(out, camera, config)
    scored = sorted(((resemblance.of(pose), n) for n, pose in enumerate(poses)), reverse=True)
    found: list[Float] = []
    for likeness, n in scored:
        errors = [pose_error(poses[n], other) for other in found]
        is_new = all(away > _POINT_CELL * depth or turn > 1 for away, turn in errors)
        if likeness > 0 and is_new:
            found.append(poses[n])
    return found[:_MOST_REPEATS]


def _find_common(steps: Float, least: int, most: int) -> Iterator[Rows]:
    """Yield indices of the (M, D) displacements, in cells, around each of the `most` most common ones."""
    if len(steps) < least:
        return
    cells = np.floor(steps).astype(np.int64)
    cells -= cells.min(0)
    numbers = np.ravel_multi_index(tuple(cells.T), tuple(cells.max(0) + 1))
    _, kind = np.unique(numbers, return_inverse=True)
    left = np.ones(len(steps), bool)
    for _ in range(most):
        commonest = int(np.argmax(np.bincount(kind[left])))
        is_commonest = kind == commonest
        centre = np.median(steps[left & is_commonest], 0)
        near = left & (np.abs(steps - centre) <= 1).all(1)
        if near.sum() >= least:
            yield np.flatnonzero(near)
        left &= ~near & ~is_commonest
        if left.sum() < least:
            return


class _Resemblance:
    """Likeness of a render to itself seen from other poses, by moving its own pixels; ignores occlusion."""

    def __init__(
        self,
        out: Rendered,
        camera: Camera,
        config: RegisterConfig,
    ) -> None:
        share = min(1.0, _SELF_SIDE / max(camera.width, camera.height))
        width = round(camera.width * share)
        height = round(camera.height * share)
        grey = grey_of(np.clip(out.image, 0, 1))
        planes = np.dstack([grey, out.alpha >= config.min_alpha]).astype(np.float32)
        small = resize(planes, (width, height)).astype(np.float64)
        self._size = width, height
        self._grey = band_passed(small[..., 0])
        self._mask = small[..., 1] > 0.999
        self._scale = np.array([width / camera.width, height / camera.height])
        self._camera = camera
        v, u = np.nonzero(self._mask)
        at = (np.stack([u, v], 1) + 0.5) / self._scale  # in pixels of the camera
        column, row = at.astype(int).T
        depth = out.depth[row, column].astype(np.float64)
        (fx, _, cx), (_, fy, cy), _ = camera.K
        x = (at[:, 0] - cx) / fx
        y = (at[:, 1] - cy) / fy
        rays = np.stack([x, y, np.ones(len(at))], 1)
        self._seen = rays * depth[:, None]
        self._here = self._grey[v, u]

    def of(self, pose: Float) -> float:
        """Return the ZNCC times the square root of the share of pixels compared; 0 where it is too low."""
        motion = pose @ np.linalg.inv(self._camera.viewmat)
        moved = self._seen @ motion[:3, :3].T + motion[:3, 3]
        ahead = moved[:, 2] > 1e-3 * np.abs(self._seen[:, 2])
        depth = np.where(ahead, moved[:, 2], 1)
        K = self._camera.K
        pixels = moved[:, :2] / depth[:, None] * [K[0, 0], K[1, 1]] + K[:2, 2]
        pixels = np.clip(pixels * self._scale, -1, 1e6)
        column, row = np.floor(pixels).astype(int).T
        inside = ahead & within_frame(column, row, *self._size)
        inside[inside] = self._mask[row[inside], column[inside]]
        share = float(inside.sum()) / max(1, len(inside))
        if share < _LEAST_COMPARED:
            return 0.0
        there = self._grey[row[inside], column[inside]]
        likeness = zncc(self._here[inside], there, np.ones(len(there), bool))
        if likeness < _SELF_LIKE:
            return 0.0
        return likeness * float(np.sqrt(share))


def preference(
    photo: Float,
    mask: Mask,
    a: Look,
    b: Look,
    config: RegisterConfig,
) -> float:
    """Return (λ − ½)/σ: above `DECISIVE`, the photo excludes b, below its negative it excludes a.

    Where a render shows nothing, it predicts the photo's mean colour. Gain and bias of each channel are those
    of the pixels where the renders agree.
    """
    usual = photo[mask].mean(0)
    slopes = [np.hypot(*np.gradient(a.image[..., c])) for c in range(3)]
    allowed = _AGREEING + _MISALIGNED * np.max(slopes, axis=0)
    differ = np.abs(a.image - b.image).max(2) > allowed
    both = a.mask & b.mask
    agree = mask & both & ~differ
    if agree.sum() < 0.02 * mask.sum():
        agree = mask & both
    if not agree.any():
        return 0.0
    mean = ((a.image + b.image) / 2)[agree]
    seen = photo[agree]
    gain, bias = _fit_light(mean, seen)
    residual = np.zeros(mask.shape)
    residual[agree] = ((seen - gain * mean - bias) ** 2).sum(1)
    variance = float(residual[agree].mean()) / 3
    noise = max(variance, _LEAST_NOISE**2)
    side = max(1, max(mask.shape) // _THING)
    sums = side * side * box_mean(residual, min(side, *mask.shape))
    thing = float(sums.max() - np.median(sums))
    first, second = (np.where(x.mask[..., None], gain * x.image + bias, usual) for x in (a, b))
    counts = mask & np.where(both, differ, a.mask | b.mask)
    difference = (first - second)[counts]
    energy = float((difference * difference).sum())
    if energy < 1e-9:
        return 0.0
    unexplained = photo[counts] - (first + second)[counts] / 2
    share = float((difference * unexplained).sum()) / energy  # λ − ½
    error = 3 * config.window**2 * noise + thing / 12
    sigma = np.sqrt(_MODEL_SIGMA**2 + error / energy)
    return float(share / sigma)


def _fit_light(rendered: Float, photo: Float) -> tuple[Float, Float]:
    """Return the (3,) gain and bias with which (M, 3) rendered colours are nearest to a photo's."""
    centre = rendered.mean(0)
    offsets = rendered - centre
    spread = np.maximum((offsets**2).mean(0), 1e-6)
    covariance = (offsets * (photo - photo.mean(0))).mean(0)
    gain = np.clip(covariance / spread, 0.1, 10)
    return gain, photo.mean(0) - gain * centre


def decisive(preference: float) -> bool:
    """Return whether a `preference` excludes the second pose."""
    return preference > _DECISIVE
