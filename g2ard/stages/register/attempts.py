"""What is tried on one photo: poses from features, from direct alignment, and from both."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from g2ard.rendering.renderer import Renderer
from g2ard.scene.cameras import Camera, Cameras
from g2ard.scene.images import load_image, load_mask, resized
from g2ard.stages.register.align import Aligned, Level, align, inverse, level_of
from g2ard.stages.register.config import RegisterConfig
from g2ard.stages.register.grey import grey_of, local_zncc
from g2ard.stages.register.matchers import Matcher
from g2ard.stages.register.polish import Prior, polish
from g2ard.stages.register.pose import motion_between, moved
from g2ard.stages.register.solve import Solved, solve

Float = NDArray[np.float64]
_FINEST = 2
"""Levels of direct alignment that a pose from features still needs."""


@dataclass(frozen=True, eq=False)
class Photo:
    """A photo at the sizes that registration looks at.

    Args:
        camera: at `size`; its pose does not count.
        image: (H, W, 3) there.
        mask: (H, W) its pixels that count.
        pyramid: levels of direct alignment, coarse to fine.
        small: at the size of the pool's renders.
        whole: grey at the finest level, without a blur.
    """

    camera: Camera
    image: NDArray[np.float32]
    mask: NDArray[np.bool_]
    pyramid: list[tuple[Camera, Level]]
    small: tuple[Camera, Float]
    whole: Float


@dataclass(frozen=True)
class Start:
    """A pose to start from; `turned`, where it is not None, is what is begun with."""

    pose: Float
    name: str
    rank: int | None = None
    turned: Float | None = None

    @property
    def begins(self) -> Float:
        """(4, 4) camera_from_world."""
        return self.pose if self.turned is None else self.turned


@dataclass(frozen=True, eq=False)
class Candidate:
    """A pose found for a photo.

    Args:
        start: what it was found from.
        found: the pose, its light and covariance.
        zncc: median local ZNCC of render and photo there.
        solved: what matches said, None where direct alignment found it alone.
    """

    start: Start
    found: Aligned
    zncc: float
    solved: Solved | None = None


def loaded(photos: Cameras, index: int, config: RegisterConfig) -> Photo:
    """Read a photo, once, and shrink it to each size.

    Raises:
        InputError: it cannot be read.
    """
    sizes = config.levels()
    one = photos.take([index]).resized(max(config.size, sizes[-1]))
    image, mask = load_image(one, 0), load_mask(one, 0)
    everywhere = np.ones(image.shape[:2], bool) if mask is None else mask
    planes = np.stack([grey_of(image), everywhere], 2).astype(np.float32)
    levels: list[_Planes] = []
    for side in reversed(sizes):  # each from the one before: that is the quickest
        levels.insert(0, _shrunk(one, levels[0].planes if levels else planes, side))
    pyramid = [(level.camera, level_of(level.grey, level.mask)) for level in levels]
    small = _shrunk(one, levels[-1].planes, config.pool_size)
    return Photo(one[0], image, everywhere, pyramid, (small.camera, small.grey), levels[-1].grey)


@dataclass(frozen=True, eq=False)
class _Planes:
    """A photo shrunk: (H, W, 2) float32, its grey and the share of each pixel that counts."""

    camera: Camera
    planes: NDArray[np.float32]

    @property
    def grey(self) -> Float:
        return self.planes[..., 0].astype(np.float64)

    @property
    def mask(self) -> NDArray[np.bool_]:
        return np.ascontiguousarray(self.planes[..., 1] > 0.999)


def _shrunk(one: Cameras, planes: NDArray[np.float32], side: int) -> _Planes:
    camera = one.resized(side)[0]
    return _Planes(camera, resized(planes, (camera.width, camera.height)))


class Search:
    """Attempts at photos of one scene, and how many renders they took.

    Args:
        renderer: of the scene.
        config: see `RegisterConfig`.
        match: None is direct alignment alone.
    """

    def __init__(self, renderer: Renderer, config: RegisterConfig, match: Matcher | None) -> None:
        self.renderer, self.config, self.match = renderer, config, match
        self.renders = 0

    def by_alignment(self, start: Start, photo: Photo) -> Candidate | None:
        """Direct alignment, coarse to fine; None where the scene is out of the start's sight."""
        found = self._aligned(start.begins, photo, photo.pyramid)
        if found is not None and self.config.refine == "exact":
            found = self._polished(found, photo, None)
        return None if found is None else Candidate(start, found, self._likeness(found.viewmat, photo))

    def by_features(self, start: Start, photo: Photo) -> Candidate | None:
        """Matches and PnP, then what `refine` says; None where there is no matcher, or too few inliers."""
        solved = self.solved(start.begins, photo, self.config.passes)
        return None if solved is None else self._refined(start, solved, photo)

    def solved(self, pose: Float, photo: Photo, passes: int) -> Solved | None:
        """Matches and PnP alone; None likewise."""
        if self.match is None:
            return None
        found = solve(
            self.renderer, pose, photo.camera, photo.image, photo.mask, self.match, self.config, passes
        )
        self.renders += passes if found is None else found.passes
        return found if found is not None and found.inliers >= self.config.min_inliers else None

    def _refined(self, start: Start, solved: Solved, photo: Photo) -> Candidate:
        """Without refinement, the features' pose; with the photometric one, what alignment makes of it; and
        with both, the mean of the two weighted by their information: ξ = (Λ_f + Λ_p)⁻¹ Λ_p ξ_p, ξ_p from the
        first to the second; the exact one polishes that."""
        refine = self.config.refine
        near = self._aligned(solved.viewmat, photo, photo.pyramid[-_FINEST:])
        plain = Aligned(solved.viewmat, 1.0, 0.0, inverse(solved.information), 0.0, 0, solved.depth)
        if near is None:
            return Candidate(start, plain, self._likeness(solved.viewmat, photo), solved)
        found = near
        if refine != "photometric":
            found = replace(near, viewmat=solved.viewmat, covariance=plain.covariance, depth=solved.depth)
        if refine in ("auto", "exact") and near.covariance is not None:
            of_light = np.linalg.inv(near.covariance)
            both = inverse(solved.information + of_light)
            if both is not None:
                xi = motion_between(solved.viewmat, near.viewmat)
                found = replace(found, viewmat=moved(solved.viewmat, both @ of_light @ xi), covariance=both)
        if refine == "exact":
            found = self._polished(found, photo, Prior(solved.viewmat, solved.information))
        return Candidate(start, found, self._likeness(found.viewmat, photo), solved)

    def _polished(self, start: Aligned, photo: Photo, prior: Prior | None) -> Aligned:
        """By the exact gradient, at the finest level; the start where that fails."""
        found = polish(self.renderer, start, *photo.pyramid[-1], prior, self.config)
        self.renders += 1 if found is None else found.steps
        return start if found is None else found

    def _aligned(self, pose: Float, photo: Photo, levels: list[tuple[Camera, Level]]) -> Aligned | None:
        found = align(self.renderer, pose, levels, self.config)
        self.renders += 1 if found is None else found.steps
        return found

    def _likeness(self, viewmat: Float, photo: Photo) -> float:
        """Median local ZNCC at the finest level, without a blur."""
        camera, level = photo.pyramid[-1]
        out = self.renderer.render(replace(camera, viewmat=viewmat))
        self.renders += 1
        mask = level.mask & (out.alpha >= self.config.min_alpha)
        return local_zncc(grey_of(np.clip(out.image, 0, 1)), photo.whole, mask, self.config.window)
