"""Coordinate frame and initial camera for the viewer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from g2ard.arrays import Float
from g2ard.config.checks import checks_arguments
from g2ard.config.choices import BLACK, Axes, Colour
from g2ard.errors import InputError
from g2ard.jobs.framing import Fields, choose_fields
from g2ard.jobs.inputs import GivenViews, Numbers, load_views
from g2ard.jobs.view_checks import sample_opaque_points, take_or_find_views
from g2ard.poses import best_views
from g2ard.poses.site import Site
from g2ard.scene.cameras import Camera, Cameras
from g2ard.scene.samples import take_evenly
from g2ard.scene.splats import Splats
from g2ard.scene.transform import change_of_axes, quaternion_of, transform, unit_up, up_in
from g2ard.stages.recover.anchors import measure_prior
from g2ard.viewer.page import Start, write_page

_SAMPLE = 100_000
"""Gaussians used to estimate the up direction, or to recognise a lift."""

_TO_VIEWER = np.diag([-1.0, -1.0, 1.0])
"""Rotation that the viewer applies to scenes: by 180° about z."""

_LEVEL_SPREAD_RATIO = 0.1
"""Ratio of the spread of the views' x axes along and across a direction, below which it is up."""

_ONE_WAY_SPREAD = 1e-3
"""Second eigenvalue of the same spread below which all views face one way: 2° of their x axes."""

_UPRIGHT_MEAN = 0.8
"""Length of the mean of the photos' up directions, above which it is up."""


@dataclass(frozen=True, eq=False)
class ViewerFrame:
    """Frame for the viewer, x right, y down, z ahead: p = rotation · (world − origin).

    Args:
        rotation: (3, 3), rotates up to −y.
        origin: (3,) world, the median of the opaque Gaussians.
        start: initial camera; None if there is no suitable pose.
        name: name of the view used as initial camera.
    """

    rotation: Float
    origin: Float
    start: Start | None = None
    name: str | None = None

    @property
    def up(self) -> Float:
        """Up direction, (3,) unit vector in world coordinates."""
        return -self.rotation[1]

    def of(self, splats: Splats) -> Splats:
        """Transform a scene to this frame, without offset."""
        turn = np.eye(4)
        turn[:3, :3] = self.rotation
        return transform(
            replace(splats.recentred(self.origin), offset=np.zeros(3), axes="RDF"), turn
        )

    def write_page(
        self, path: Path, labels: Sequence[str], scenes: Sequence[Splats], **options: Any
    ) -> tuple[int, tuple[int, ...]]:
        """Write a page of scenes that opens at the initial camera, see `g2ard.viewer.page.write_page`."""
        turned = [(label, self.of(scene)) for label, scene in zip(labels, scenes, strict=True)]
        return write_page(path, turned, start=self.start, **options)

    def place(self, offset: Float, axes: Axes = "RDF") -> tuple[list[float], list[float]]:
        """Return quaternion x y z w and translation that put the files of a scene with this offset and these
        axes where `of` and the viewer put it."""
        turn = _TO_VIEWER @ self.rotation
        w, *xyz = quaternion_of(turn @ change_of_axes("RDF", axes)).tolist()
        return [*xyz, w], (turn @ (offset - self.origin)).tolist()

    def world(self, point: Numbers) -> Float:
        """Return world coordinates of a point in the viewer's axes."""
        back: Float = self.rotation.T @ _TO_VIEWER @ np.asarray(point) + self.origin
        return back

    def start_at(self, view: Camera, points: Float, fields: Fields | None = None) -> Start:
        """Convert a view for the viewer, without roll; it orbits the median depth of the points in view.

        Without `fields`, all of the view fits into the window.
        """
        held = points[view.holds(points)]
        if not len(held):
            held = self.origin[None]
        ahead = view.viewmat[2, :3]
        depth = float(np.median(np.abs((held - view.position) @ ahead)))
        to_viewer = _TO_VIEWER @ self.rotation

        def there(point: Float) -> tuple[float, float, float]:
            x, y, z = (float(v) for v in to_viewer @ (point - self.origin))
            return x, y, z

        return Start(
            there(view.position),
            there(view.position + depth * ahead),
            fields or choose_fields(view),
        )


def choose_frame(scene: Splats, given: GivenViews, start: str | None = None) -> ViewerFrame:
    """Choose a frame and an initial camera, from views that are given or found beside the scene, if any.

    Args:
        scene: the scene, or the left one of two.
        given: the views, and the up direction; None takes it from the views, or estimates it.
        start: name of the initial view; None takes the one that shows most.
    """
    found, _ = take_or_find_views(given, scene)
    cameras = None if found is None else load_views(found, "all", None, given.say)
    try:
        return place_frame(scene, cameras, given.up, start=start)
    except InputError as error:
        if start is not None or cameras is not None:
            raise
        given.say(f"no pose to start at: {error}")
        return ViewerFrame(_rotate_upright(up_of(scene, given.up)), _find_middle(scene))


def place_frame(
    scene: Splats, cameras: Cameras | None, up: Numbers | None = None, *, start: str | None = None
) -> ViewerFrame:
    """Choose a frame and an initial camera, from given cameras if there are any, like `choose_frame`.

    A view that was named is shown whole, others as near as their subject allows. Of photos, only what was
    photographed is shown.
    """
    up = read_stated_up(scene) if up is None else up
    axis = find_shared_up(cameras) if up is None and cameras is not None else None
    axis = up_of(scene, up) if axis is None else axis
    best = (
        best_views(scene, cameras=cameras, axis=axis)
        if cameras is None or start is None
        else cameras
    )
    if start and start not in best.names:
        raise InputError(
            f"no view {start!r} among {', '.join(best.names[:4])}, …", parameter="start"
        )
    view = best[best.names.index(start) if start else 0]
    stand = ViewerFrame(_rotate_upright(axis), _find_middle(scene))
    points = sample_opaque_points(scene)
    photos = cameras if cameras is not None and any(cameras.image_paths) else None
    fields = choose_fields(view, subject=None if start else points, scene=scene, cameras=photos)
    return replace(stand, start=stand.start_at(view, points, fields), name=view.name)


def choose_level_views(
    scene: Splats, count: int, cameras: Cameras, size: tuple[int, int] = (800, 600)
) -> Cameras:
    """Return the placed views that show a scene best, upright as other cameras are."""
    return best_views(scene, count, size=size, axis=find_shared_up(cameras))


def choose_backdrop(
    given: Colour | None, scenes: Sequence[Splats], *, of_points: bool = False
) -> Colour | None:
    """Return the colour behind scenes on a page: the given one, or black, on which scenes are trained.

    None, a soft gradient, is behind lifts of point clouds and what was made `of_points`, which have gaps.
    """
    if given is not None or of_points:
        return given
    samples = (take_evenly(scene, _SAMPLE, floor=True) for scene in scenes)
    return None if any(measure_prior(sample).is_lift for sample in samples) else BLACK


def find_shared_up(cameras: Cameras) -> Float | None:
    """Return the up direction that views share, or that of photos which all face one way; otherwise None."""
    across = cameras.viewmats[:, 0, :3]
    up = -cameras.viewmats[:, 1, :3].mean(axis=0)
    values, vectors = np.linalg.eigh(across.T @ across / len(cameras))
    if values[0] <= _LEVEL_SPREAD_RATIO * values[1] and values[1] > _ONE_WAY_SPREAD:
        axis: Float = vectors[:, 0]
        above = up - cameras.forwards.mean(axis=0) / 2  # most cameras look down, some straight down
        return axis if axis @ above >= 0 else -axis
    return unit_up(up) if any(cameras.image_paths) and np.linalg.norm(up) > _UPRIGHT_MEAN else None


def read_stated_up(scene: Splats) -> tuple[float, float, float] | None:
    """Return the (3,) up direction that a scene's file or, of a scan, its axes state."""
    return scene.up if scene.up is not None or scene.axes == "RDF" else up_in(scene.axes)


@checks_arguments
def up_of(scene: Splats, up: Numbers | None = None) -> Float:
    """Return a scene's up direction.

    Args:
        scene: the scene.
        up: (3,) the direction, if it is known. None means the one that the scene's file states, or else
            estimates it from floors and surfaces, with −y as a fallback.

    Returns:
        (3,) float64 unit vector in world coordinates, for `Camera.facing` and `look_at`.

    Raises:
        InputError: an `up` that is not three finite numbers, or zero.

    >>> floor = np.stack(np.meshgrid(np.arange(20), [0], np.arange(20)), -1).reshape(-1, 3)
    >>> flat = np.full((400, 3), [0.5, 0.05, 0.5])
    >>> np.abs(up_of(Splats.create(floor, scales=flat, logit_opacities=np.full(400, 4)))).round(3).tolist()
    [0.0, 1.0, 0.0]
    """
    up = read_stated_up(scene) if up is None else up
    if up is not None:
        return unit_up(up)
    try:
        return Site.of(scene, None, _SAMPLE).vertical.axis
    except InputError:  # nothing visible
        return np.array([0.0, -1.0, 0.0])


def _rotate_upright(up: Float) -> Float:
    """Return the smallest rotation (3, 3) from `up` to −y: I + K + K²/(1 + c).

    K is the cross product matrix of up × −y, c the cosine.
    """
    down = np.array([0.0, -1.0, 0.0])
    (x, y, z) = np.cross(up, down)
    c = float(up @ down)
    if c < -1 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + k + k @ k / (1 + c)


def _find_middle(scene: Splats) -> Float:
    return np.median(sample_opaque_points(scene), axis=0)
