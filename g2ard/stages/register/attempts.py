"""Attempts on one photo: starting poses, then features, direct alignment, or both."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from g2ard.arrays import Float, Float32, Mask
from g2ard.io.images import resize
from g2ard.io.photos import load_photo
from g2ard.progress import Progress, silent
from g2ard.rendering.renderer import Renderer
from g2ard.scene.cameras import Camera, Cameras
from g2ard.stages.register.align import Aligned, Level, align, inverse, level_of, zoomed
from g2ard.stages.register.config import RegisterConfig
from g2ard.stages.register.grey import band_passed, grey_of, local_zncc, shift_between
from g2ard.stages.register.matchers import Matcher, Sift, sift_or_none
from g2ard.stages.register.pose import motion_between, moved, pose_error, rotation_of
from g2ard.stages.register.repeats import decisive, look, preference, repeated_poses, softened
from g2ard.stages.register.solve import Solved, solve


def small_render(renderer: Renderer, camera: Camera, config: RegisterConfig) -> Float:
    """Render (H, W) band-passed grey, 0 where alpha is too low."""
    out = renderer.render(camera)
    grey = band_passed(grey_of(np.clip(out.image, 0, 1)))
    return np.where(out.alpha >= config.min_alpha, grey, 0.0)


def turned(
    viewmat: Float,
    render: Float,
    photo: Float,
    K: Float,
) -> tuple[Float, float, float]:
    """Rotate a pose by the shift s of its `small_render` onto the photo's band-passed grey, with K of both:
    ω = (−s_v/f_y, s_u/f_x, 0).

    Returns:
        The (4, 4) pose with the same centre, the likeness after the shift (`shift_between`), and |s|.
    """
    right, down, likeness = shift_between(render, photo)
    turn = np.eye(4)
    turn[:3, :3] = rotation_of([-down / K[1, 1], right / K[0, 0], 0])
    return turn @ viewmat, likeness, float(np.hypot(right, down))


class PoolRenders:
    """Renders of a pool's poses with a photo's intrinsics, cached per intrinsics."""

    def __init__(
        self,
        renderer: Renderer,
        pool: Cameras,
        config: RegisterConfig,
        progress: Progress = silent,
    ) -> None:
        self._renderer = renderer
        self.pool = pool
        self._config = config
        self._progress = progress
        self._kept: dict[bytes, list[Float]] = {}

    def ranked(self, camera: Camera, grey: Float) -> tuple[list[tuple[int, Float]], int]:
        """Return indices by decreasing similarity with the poses rotated onto the photo, and the new renders.

        `camera` and `grey` are the photo at `pool_size`. Ties go by index.
        """
        key = camera.K.tobytes() + bytes(str((camera.width, camera.height)), "ascii")
        renders = 0
        if key not in self._kept:
            renders = len(self.pool)
            drawn: list[Float] = []
            self._kept[key] = drawn
            for view in self.pool.viewmats:
                drawn.append(
                    small_render(self._renderer, replace(camera, viewmat=view), self._config)
                )
                self._progress("pool", len(drawn), renders)
        photo = band_passed(grey)
        poses = []
        likenesses = []
        for view, render in zip(self.pool.viewmats, self._kept[key], strict=True):
            pose, likeness, _ = turned(view, render, photo, camera.K)
            poses.append(pose)
            likenesses.append(-likeness)
        order = np.argsort(likenesses, kind="stable").tolist()
        return [(at, poses[at]) for at in order], renders


_REPEAT_ROUNDS = 3
"""Most moves to a pose that explains a photo better than those that look alike."""
_REPEATED_ITERATIONS = 4
"""Most iterations per level of their alignment."""
_LIKENESS_LOSS = 0.15
"""Loss of local ZNCC below which such poses count."""
_APART = 0.02, 1.0
"""Least distance, as a share of the depth, and least angle in degrees of two poses."""
_REFINING_LEVELS = 2
"""Finest levels of direct alignment that refine a pose from features, or of a repetition."""


@dataclass(frozen=True, eq=False)
class Photo:
    """A photo at the sizes that registration needs.

    Args:
        camera: camera at `size`; its pose is ignored.
        image: (H, W, 3) at `size`.
        mask: (H, W) valid pixels.
        pyramid: levels of direct alignment, coarse to fine.
        small: camera and grey image at the size of the pool's renders.
        whole: unblurred grey at the finest level.
    """

    camera: Camera
    image: Float32
    mask: Mask
    pyramid: list[tuple[Camera, Level]]
    small: tuple[Camera, Float]
    whole: Float


@dataclass(frozen=True)
class Start:
    """A starting pose and the initial estimate, both (4, 4) camera_from_world, and the pose's name and rank
    in the pool."""

    pose: Float
    begins: Float
    name: str
    rank: int | None = None


@dataclass(frozen=True, eq=False)
class Candidate:
    """A candidate pose of a photo.

    Args:
        start: its starting pose.
        found: the pose with gain, bias and covariance.
        zncc: median local ZNCC of render and photo.
        solved: result of feature matching; None for direct alignment alone.
    """

    start: Start
    found: Aligned
    zncc: float
    solved: Solved | None = None


def loaded(
    cameras: Cameras,
    index: int,
    config: RegisterConfig,
    background: Sequence[float],
) -> Photo:
    """Read a photo, composited over the background and grey outside of its mask, and shrink it to each size.

    Raises:
        InputError: it cannot be read.
    """
    sizes = config.levels()
    one = cameras.take([index]).resized(max(config.size, sizes[-1]))
    image, mask = load_photo(one, 0, background)
    if mask is None:
        mask = np.ones(image.shape[:2], bool)
    image[~mask] = 0.5
    planes = np.stack([grey_of(image), mask], 2).astype(np.float32)
    levels = [_shrink(one, planes, sizes[-1])]
    for side in reversed(sizes[:-1]):  # each level from the previous one, which is fastest
        levels.insert(0, _shrink(one, levels[0][1], side))
    pyramid = [
        (camera, level_of(_take_grey(planes), planes[..., 1] > 0.999)) for camera, planes in levels
    ]
    _, finest = levels[-1]
    camera, small = _shrink(one, finest, config.pool_size)
    return Photo(
        camera=one[0],
        image=image,
        mask=mask,
        pyramid=pyramid,
        small=(camera, _take_grey(small)),
        whole=_take_grey(finest),
    )


def _shrink(one: Cameras, planes: Float32, side: int) -> tuple[Camera, Float32]:
    """Shrink (H, W, 2) planes, grey and the valid share of each pixel, to a longer side."""
    camera = one.resized(side)[0]
    return camera, resize(planes, (camera.width, camera.height))


def _take_grey(planes: Float32) -> Float:
    return planes[..., 0].astype(np.float64)


def _are_apart(a: Aligned, b: Aligned) -> bool:
    distance, angle = pose_error(a.viewmat, b.viewmat)
    return distance > _APART[0] * b.depth or angle > _APART[1]


class Search:
    """Attempts on photos of one scene, with a count of renders.

    Args:
        match: a matcher; None means direct alignment only.
    """

    def __init__(
        self,
        renderer: Renderer,
        config: RegisterConfig,
        match: Matcher | None,
    ) -> None:
        self.renderer = renderer
        self.config = config
        self.match = match
        self.renders = 0
        self._sift = (
            match if isinstance(match, Sift) else sift_or_none(config.ratio, config.features)
        )

    def by_alignment(self, start: Start, photo: Photo) -> Candidate | None:
        """Align directly, coarse to fine; return None if the start does not see the scene."""
        aligned = self._aligned(start.begins, photo.pyramid)
        if aligned is None:
            return None
        return Candidate(start, aligned, self._likeness(aligned, photo))

    def by_features(self, start: Start, photo: Photo) -> Candidate | None:
        """Match, solve PnP and refine; return None without a matcher or with too few inliers."""
        solved = self.by_matches(start.begins, photo, self.config.passes)
        if solved is None:
            return None
        return self._refined(start, solved, photo)

    def by_matches(
        self,
        pose: Float,
        photo: Photo,
        passes: int,
    ) -> Solved | None:
        """Match a photo with up to `passes` renders, the first from `pose`, and solve PnP.

        None without a matcher or with fewer than `min_inliers` inliers.
        """
        if self.match is None:
            return None
        solved = solve(
            self.renderer,
            pose,
            photo.camera,
            photo.image,
            photo.mask,
            self.match,
            self.config,
            passes,
        )
        self.renders += passes if solved is None else solved.passes
        if solved is not None and solved.inliers >= self.config.min_inliers:
            return solved
        return None

    def against_repeats(self, best: Candidate, photo: Photo) -> tuple[Candidate, list[Float]]:
        """Compare a pose with those at which the scene looks alike.

        Returns the candidate that explains the photo best, and the poses that the photo does not exclude.
        """
        alike: list[Float] = []
        for _ in range(_REPEAT_ROUNDS):
            best, alike, moved_on = self._best_of_repeats(best, photo)
            if not moved_on:
                break
        return best, alike

    def _best_of_repeats(
        self, best: Candidate, photo: Photo
    ) -> tuple[Candidate, list[Float], bool]:
        config = self.config
        if self._sift is None:
            return best, [], False
        camera, level = photo.pyramid[-1]
        here = zoomed(camera, best.found.zoom, best.found.viewmat)
        self.renders += 1
        poses = repeated_poses(self.renderer, here, self._sift, config)
        if not poses:
            return best, [], False
        if best.solved:
            focal_sigma = best.solved.focal_sigma
        else:
            focal_sigma = config.focal_sigma
        quick = replace(config, iterations=min(config.iterations, _REPEATED_ITERATIONS))
        aligned = [best]
        for pose in poses:
            found = self._aligned(
                pose, photo.pyramid[-_REFINING_LEVELS:], best.found.zoom, focal_sigma, quick
            )
            if found is None:
                continue
            candidate = Candidate(best.start, found, self._likeness(found, photo))
            fresh = all(_are_apart(found, other.found) for other in aligned)
            if fresh and candidate.zncc >= best.zncc - _LIKENESS_LOSS:
                aligned.append(candidate)
        if len(aligned) < 2:
            return best, [], False
        image = softened(resize(photo.image, (camera.width, camera.height)))
        looks = [
            look(self.renderer, zoomed(camera, c.found.zoom, c.found.viewmat), config)
            for c in aligned
        ]
        self.renders += len(looks)

        def compared(a: int, b: int) -> float:
            return preference(
                image,
                level.mask,
                looks[a],
                looks[b],
                config,
            )

        first = 0
        for other in range(1, len(aligned)):
            if compared(first, other) < 0:
                first = other
        alike = [
            c.found.viewmat
            for k, c in enumerate(aligned)
            if k != first and not decisive(compared(first, k))
        ]
        if first == 0:
            return best, alike, False
        chosen = aligned[first]
        refined = self.by_features(replace(best.start, begins=chosen.found.viewmat), photo)
        if refined is not None and not _are_apart(refined.found, chosen.found):
            chosen = refined
        return chosen, alike, True

    def _refined(self, start: Start, solved: Solved, photo: Photo) -> Candidate:
        """Refine a pose from features as `refine` says.

        "none" keeps it. "photometric" aligns from it. "auto" takes the mean of both weighted by their
        information: ξ = (Λ_f + Λ_p)⁻¹ (Λ_p ξ_p − Λ_0 ξ_0), with ξ_p the motion from the first to the second,
        Λ_0 and ξ_0 the prior of the focal length, which Λ_p has too.
        """
        refine = self.config.refine
        focal_sigma = solved.focal_sigma
        near = self._aligned(
            solved.viewmat, photo.pyramid[-_REFINING_LEVELS:], solved.zoom, focal_sigma
        )
        prior = np.zeros((7, 7))
        prior[6, 6] = focal_sigma**-2
        plain = Aligned(
            solved.viewmat,
            1.0,
            0.0,
            inverse(solved.information + prior),
            0.0,
            0,
            solved.depth,
            solved.zoom,
        )
        if near is None:
            return Candidate(start, plain, self._likeness(plain, photo), solved)
        refined = near
        if refine != "photometric":
            refined = replace(
                near,
                viewmat=solved.viewmat,
                covariance=plain.covariance,
                depth=solved.depth,
                zoom=solved.zoom,
            )
        if refine == "auto" and near.covariance is not None:
            of_light = inverse(near.covariance)
            if of_light is None:
                both = None
            else:
                both = inverse(solved.information + of_light)
            if of_light is not None and both is not None:
                xi = [
                    *motion_between(solved.viewmat, near.viewmat),
                    np.log(near.zoom / solved.zoom),
                ]
                step = both @ (of_light @ xi + np.log(solved.zoom) * prior[6])
                refined = replace(
                    refined,
                    viewmat=moved(solved.viewmat, step[:6]),
                    covariance=both,
                    zoom=solved.zoom * float(np.exp(step[6])),
                )
        return Candidate(start, refined, self._likeness(refined, photo), solved)

    def _aligned(
        self,
        pose: Float,
        levels: list[tuple[Camera, Level]],
        zoom: float = 1.0,
        focal_sigma: float | None = None,
        config: RegisterConfig | None = None,
    ) -> Aligned | None:
        aligned = align(
            self.renderer,
            pose,
            levels,
            config or self.config,
            zoom,
            focal_sigma,
        )
        self.renders += 1 if aligned is None else aligned.steps
        return aligned

    def _likeness(self, found: Aligned, photo: Photo) -> float:
        """Return the median local ZNCC at the finest level, unblurred."""
        camera, level = photo.pyramid[-1]
        out = self.renderer.render(zoomed(camera, found.zoom, found.viewmat))
        self.renders += 1
        mask = level.mask & (out.alpha >= self.config.min_alpha)
        return local_zncc(
            grey_of(np.clip(out.image, 0, 1)),
            photo.whole,
            mask,
            self.config.window,
        )
