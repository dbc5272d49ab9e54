"""Pinhole cameras with OpenCV axes (x right, y down, z forward), and their photos."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from g2ard.arrays import Float, Int, Mask, Values
from g2ard.config.checks import check_direction, check_fields, check_vector
from g2ard.errors import InputError, require
from g2ard.progress import plural
from g2ard.scene.lenses import PhotoLens, pinhole_matrix
from g2ard.scene.samples import evenly_spaced
from g2ard.system.keys import UNKEYED, key_of, keyed
from g2ard.system.shown import Shown

USUAL = "usual"
"""Kind of views that state none: given views, and the poses that suit the scene."""

ZOOM = "zoom"
"""Kind of views of enlarged parts."""

LARGEST_IMAGE = 160_000_000
"""Maximum pixels of an image or view; a decoded pixel takes 12 bytes."""
_TOO_LARGE = "has {width:,}×{height:,} pixels; the limit is {limit:,}"

_LARGEST_CAMERA_VALUE = 1e12
"""Largest value of poses and intrinsics; larger ones are damaged data and overflow when squared."""

_POSE_SLACK = 1e-3  # deviation of a pose from a rigid transform that counts as rounding
_MEDIAN_VIEWS = 16  # views used for medians over all views

_ARRAY_SHAPES = {"viewmats": (4, 4), "Ks": (3, 3), "widths": (), "heights": (), "distortions": (5,)}
"""Arrays of `Cameras` and their shapes per view."""
_TUPLE_FIELDS = ("names", "image_paths", "mask_paths", "kinds", "lenses")


def check_image(width: int, height: int, **fields: Any) -> None:
    """Raise an `InputError` with `fields` for an image of more than `LARGEST_IMAGE` pixels."""
    if width * height > LARGEST_IMAGE:
        raise InputError(
            _TOO_LARGE.format(width=width, height=height, limit=LARGEST_IMAGE), **fields
        )


@dataclass(frozen=True, eq=False)
class Camera(Shown):
    """One view.

    Args:
        viewmat: (4, 4) float64, camera_from_world, rigid; see `look_at`.
        K: (3, 3) float64 pinhole intrinsics in pixels; pixel centres at +0.5.
        width: pixels.
        height: pixels.
        name: name of the photo or pose.
        image_path: the photo, or None.
        mask_path: mask of its valid pixels; None if all are.
        distortion: (5,) float64, OpenCV k1 k2 p1 p2 k3 of the photo.
        kind: kind of view, see `Cameras`.
        lens: lens of a photo that the view is resampled from, see `Cameras`.

    Types are checked here, shapes and values by `Cameras`.

    >>> camera = Camera.facing([0, -2, 0], [0, 0, 0], width=32, height=24, fov=50)
    >>> camera.position.tolist(), camera.holds([[0, 0, 0], [0, -3, 0]]).tolist()
    ([0.0, -2.0, 0.0], [True, False])
    """

    viewmat: Float
    K: Float
    width: int
    height: int
    name: str = "view"
    image_path: Path | None = None
    mask_path: Path | None = None
    distortion: Float = field(default_factory=lambda: np.zeros(5))
    kind: str = USUAL
    lens: PhotoLens | None = None

    def __post_init__(self) -> None:
        check_fields(self)

    def __repr__(self) -> str:
        x, y, z = self.position
        return f"Camera({self.name!r}, {self.width} × {self.height}, at {x:.4g}, {y:.4g}, {z:.4g})"

    @classmethod
    def facing(
        cls,
        position: ArrayLike,
        target: ArrayLike,
        *,
        width: int = 800,
        height: int = 600,
        fov: float = 50.0,
        up: ArrayLike = (0.0, 0.0, 1.0),
        name: str = "view",
    ) -> Camera:
        """Create a view from `position` to `target`.

        Args:
            position: (3,) the camera's centre, world coordinates.
            target: (3,) the point in the image's centre.
            width: pixels.
            height: pixels.
            fov: horizontal field of view, degrees.
            up: (3,) direction of the image's top. Most trained scenes have y down, so up is (0, -1, 0);
                `g2ard.up_of` estimates it.
            name: a name, unique among the views of one `Cameras`.

        Raises:
            InputError: position and target coincide, or the field of view is not between 0 and 180°.

        >>> upright = Camera.facing([0, 0, -4], [0, 0, 0], up=[0, -1, 0])
        >>> bool((upright.viewmat[1] == (0, 1, 0, 0)).all())  # the image's y is the world's
        True
        """
        require("fov", fov, 0 < fov < 180, "degrees between 0 and 180")
        focal = width / 2 / np.tan(np.radians(fov) / 2)
        K = pinhole_matrix(focal, focal, width / 2, height / 2)
        return cls(look_at(position, target, up), K, width, height, name)

    @property
    def position(self) -> Float:
        """Centre of the camera in world coordinates, (3,)."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    def holds(self, points: ArrayLike) -> Mask:
        """Return which of the (N, 3) world points lie within the image, as (N,) bool, ignoring occlusion."""
        return self.outward(points) <= 1

    def outward(self, points: ArrayLike) -> Float:
        """Return how far from the middle of the image (N, 3) world points lie: 1 at its edge, inf behind."""
        away = np.asarray(points, np.float64) - self.position
        x, y, z = self.viewmat[:3, :3] @ away.T
        front = z > 0
        ahead = np.where(front, z, 1.0)
        (fx, _, cx), (_, fy, cy), _ = self.K
        u = fx * x / ahead + cx
        v = fy * y / ahead + cy
        across = np.abs(2 * u / self.width - 1)
        down = np.abs(2 * v / self.height - 1)
        return np.where(front, np.maximum(across, down), np.inf)


@dataclass(frozen=True, eq=False)
class Cameras(Shown):
    """C views.

    Args:
        viewmats: (C, 4, 4) float64, camera_from_world, rigid.
        Ks: (C, 3, 3) float64 pinhole intrinsics in pixels; pixel centres at +0.5.
        widths: (C,) int64 pixels.
        heights: (C,) int64 pixels.
        names: C unique names of photos or poses.
        image_paths: C paths of photos or None.
        mask_paths: C paths of masks or None.
        distortions: (C, 5) float64, OpenCV k1 k2 p1 p2 k3 of the *photo*; `g2ard.io.photos` undistorts on
            loading, to these Ks. Zero for a pinhole photo.
        source: the file or folder that lists the views, for messages; None for views created in memory.
        kinds: C kinds of views, such as "near" or "anywhere"; () for "usual" ones. Simplification uses usual
            views alone, as does the number of recovery steps. Validation and reports score each kind apart.
        lenses: C lenses of fisheye photos, panoramas and the like, which the views are resampled from on
            loading, or None; () for none.

    Raises:
        InputError: mismatched shapes, a pose that is not finite or not rigid, an empty image, or one of more
            than 160 million pixels.
    """

    viewmats: Float
    Ks: Float
    widths: Int
    heights: Int
    names: tuple[str, ...]
    # targets key the photos
    image_paths: tuple[Path | None, ...] = field(default=(), metadata=UNKEYED)
    distortions: Float = field(default_factory=lambda: np.zeros((0, 5)))
    mask_paths: tuple[Path | None, ...] = field(default=(), metadata=UNKEYED)
    source: Path | None = field(default=None, metadata=UNKEYED)
    kinds: tuple[str, ...] = ()
    lenses: tuple[PhotoLens | None, ...] = ()

    def __post_init__(self) -> None:
        n = len(self.viewmats)
        for name in _TUPLE_FIELDS:
            if name != "names" and not getattr(self, name):
                usual = USUAL if name == "kinds" else None
                object.__setattr__(self, name, (usual,) * n)
        if not len(self.distortions):
            object.__setattr__(self, "distortions", np.zeros((n, 5)))
        for name, shape in _ARRAY_SHAPES.items():
            got = getattr(self, name).shape
            expected = (n, *shape)
            require(name, got, got == expected, f"shape {expected}")
        for name in _TUPLE_FIELDS:
            count = len(getattr(self, name))
            require(name, count, count == n, str(n))
        if len(set(self.names)) < n:
            twice = next(name for name in self.names if self.names.count(name) > 1)
            raise InputError(
                f"{twice!r} is given twice; every view needs its own name", parameter="names"
            )
        self._check_views()

    def _check_views(self) -> None:
        """Raise an `InputError` for the first view with a fault."""
        with np.errstate(all="ignore"):  # from values that are rejected
            squares = (self.viewmats[:, :3, :3] ** 2).sum((1, 2))
            scales = np.sqrt(squares / 3)  # 1 in a rigid transform
            faults = self._faults(scales)
        wrong = np.array(list(faults.values()))  # (faults, C)
        if not wrong.any():
            return
        i = int(wrong.any(0).argmax())
        message = list(faults)[int(wrong[:, i].argmax())].format(
            scale=scales[i],
            width=int(self.widths[i]),
            height=int(self.heights[i]),
            limit=LARGEST_IMAGE,
        )
        raise InputError(f"({self.names[i]}) {message}", index=i, item="view")

    def _faults(self, scales: Float) -> dict[str, Mask]:
        """Return the (C,) mask of each fault, the most basic first; keys are templates of messages."""
        n = len(self)
        values = np.hstack(
            [
                self.viewmats.reshape(n, 16),
                self.Ks.reshape(n, 9),
                self.distortions,
            ]
        )
        largest = np.abs(values).max(1)
        last_row = np.abs(self.viewmats[:, 3] - (0, 0, 0, 1)).max(1)
        rotations = self.viewmats[:, :3, :3]
        square = rotations @ rotations.transpose(0, 2, 1)  # the unit matrix times s²
        unit = scales**2
        skew = np.abs(square - unit[:, None, None] * np.eye(3)).max((1, 2))
        skews = skew > 2 * _POSE_SLACK * unit
        skews |= ~(scales > 0)
        pixels = self.widths.astype(np.float64) * self.heights
        focals = self.Ks[:, [0, 1], [0, 1]]
        beyond = f"has a pose or intrinsics above {_LARGEST_CAMERA_VALUE:.0e}"
        pose = "has a pose that {}; expected a rotation and a translation".format
        return {
            "has a pose or intrinsics that are not finite": ~np.isfinite(largest),
            beyond: largest > _LARGEST_CAMERA_VALUE,
            pose("has another last row than 0 0 0 1"): last_row > _POSE_SLACK,
            pose("skews"): skews,
            pose("scales by {scale:.4g}"): np.abs(scales - 1) > _POSE_SLACK,
            pose("mirrors"): np.linalg.det(rotations) < 0,
            "has an empty image, {width}×{height}": np.minimum(self.widths, self.heights) < 1,
            _TOO_LARGE: pixels > LARGEST_IMAGE,
            "has a focal length that is not positive": (focals <= 0).any(1),
        }

    @property
    def pixels(self) -> Int:
        """(C,) number of pixels."""
        return self.widths * self.heights

    @property
    def sides(self) -> Int:
        """(C,) longer side in pixels."""
        return np.maximum(self.widths, self.heights)

    def __repr__(self) -> str:
        return f"Cameras({plural(len(self), 'view')})"

    def __len__(self) -> int:
        return len(self.viewmats)

    def __getitem__(self, index: int) -> Camera:
        """Return one view; use `take` for several."""
        i = range(len(self))[index]
        return Camera(
            self.viewmats[i],
            self.Ks[i],
            int(self.widths[i]),
            int(self.heights[i]),
            self.names[i],
            self.image_paths[i],
            self.mask_paths[i],
            self.distortions[i],
            self.kinds[i],
            self.lenses[i],
        )

    def __iter__(self) -> Iterator[Camera]:
        return (self[i] for i in range(len(self)))

    @classmethod
    def of(cls, views: Iterable[Camera]) -> Cameras:
        """Combine single views.

        >>> pair = [Camera.facing([0, y, 0], [0, 0, 0], name=str(y)) for y in (-2, -3)]
        >>> Cameras.of(pair)[1].name, len(Cameras.of(pair))
        ('-3', 2)
        """
        listed = list(views)
        return cls.from_lists(
            [v.viewmat for v in listed],
            [v.K for v in listed],
            [(v.width, v.height) for v in listed],
            [v.name for v in listed],
            [v.image_path for v in listed],
            [v.distortion for v in listed],
            [v.mask_path for v in listed],
            [v.kind for v in listed],
            [v.lens for v in listed],
        )

    @property
    def positions(self) -> Float:
        """Camera centres in world coordinates, (C, 3)."""
        rotations = self.viewmats[:, :3, :3]
        return -np.einsum("cji,cj->ci", rotations, self.viewmats[:, :3, 3])

    @property
    def forwards(self) -> Float:
        """Unit viewing directions in world coordinates, (C, 3)."""
        return self.viewmats[:, 2, :3]

    @property
    def extent(self) -> float:
        """1.1 × the largest distance of a camera from their mean, scene units (3DGS's `cameras_extent`).

        It is 0 if all cameras are in one place, or there are none.
        """
        if not len(self):
            return 0.0
        positions = self.positions
        offsets = positions - positions.mean(0)
        away = np.linalg.norm(offsets, axis=1).max()
        rounding = 1e-9 * np.abs(positions).max()
        if away > rounding:
            return 1.1 * float(away)
        return 0.0

    def take(self, index: ArrayLike) -> Cameras:
        """Return the views that `index` selects (a mask or indices), in its order."""
        index = np.asarray(index)
        if index.dtype == bool:
            rows = np.flatnonzero(index)
        else:
            rows = index.astype(int).reshape(-1)
        fields: dict[str, Any] = {name: getattr(self, name)[rows] for name in _ARRAY_SHAPES}
        for name in _TUPLE_FIELDS:
            values = getattr(self, name)
            fields[name] = tuple(values[row] for row in rows)
        return replace(self, **fields)

    def usual(self) -> Cameras:
        """Return the views of the usual kind; all views if there are no others."""
        rows = rows_by_kind(self.kinds).get(USUAL, range(len(self)))
        return self.take(rows)

    def fingerprint(self) -> str:
        """Return a hash of the views without their photos and masks."""
        return key_of(keyed(self))

    def resized(self, longest: int | None) -> Cameras:
        """Return the views with their longer side shrunk to at most `longest` pixels (None keeps them)."""
        if longest is None:
            return self
        return self._by(np.minimum(1.0, longest / self.sides))

    def fitted(self, longest: int | None) -> Cameras:
        """Return the views at a requested longer side; photos only shrink, and None keeps all."""
        if longest is None:
            return self
        factor = longest / self.sides
        pictured = [path is not None for path in self.image_paths]
        return self._by(np.where(pictured, np.minimum(1.0, factor), factor))

    def scaled(self, longest: int) -> Cameras:
        """Return the views with a longer side of `longest` pixels, also if they are smaller."""
        return self._by(longest / self.sides)

    def sized(self, width: int, height: int) -> Cameras:
        """Return the views at exactly this size, each with all that it shows."""
        check_image(width, height, parameter="size")
        across = width / self.widths
        down = height / self.heights
        Ks = self.Ks.copy()
        Ks[:, 0, 2] *= across
        Ks[:, 1, 2] *= down
        Ks[:, (0, 1), (0, 1)] *= np.minimum(across, down)[:, None]
        n = len(self)
        return replace(
            self,
            Ks=Ks,
            widths=np.full(n, width),
            heights=np.full(n, height),
        )

    def _by(self, factor: Float) -> Cameras:
        """Return the views with a factor on the size of each."""
        widths = np.rint(self.widths * factor)
        widths = np.maximum(1, widths).astype(np.int64)
        heights = np.rint(self.heights * factor)
        heights = np.maximum(1, heights).astype(np.int64)
        Ks = self.Ks.copy()
        Ks[:, 0] *= (widths / self.widths)[:, None]
        Ks[:, 1] *= (heights / self.heights)[:, None]
        return replace(
            self,
            Ks=Ks,
            widths=widths,
            heights=heights,
        )

    @property
    def size_text(self) -> str:
        """Image size of the views for messages, such as 800×600 px; a range of longer sides if they differ.

        >>> Cameras.of([Camera.facing([0, -2, 0], [0, 0, 0], width=64, height=48)]).size_text
        '64×48 px'
        """
        sizes = {(int(w), int(h)) for w, h in zip(self.widths, self.heights, strict=True)}
        if not sizes:
            return ""
        if len(sizes) == 1:
            width, height = sizes.pop()
            return f"{width}×{height} px"
        shortest = int(self.sides.min())
        longest = int(self.sides.max())
        if shortest < longest:
            return f"{shortest}–{longest} px"
        return f"{longest} px"

    def cropped(self, low: ArrayLike, high: ArrayLike) -> Cameras:
        """Return the parts of the views from pixel `low` up to `high`, each (C, 2) or (2,), x before y.

        >>> K = [[50, 0, 32], [0, 50, 32], [0, 0, 1]]
        >>> one = Cameras.from_lists([look_at([3, 0, 0], [0, 0, 0])], [K], [(64, 64)], "a")
        >>> part = one.cropped([16, 24], [48, 40])
        >>> part.widths.tolist(), part.heights.tolist(), part.Ks[0, :2, 2].tolist()
        ([32], [16], [16.0, 8.0])
        """
        corner = np.broadcast_to(np.asarray(low, np.int64), (len(self), 2))
        widths, heights = (np.asarray(high, np.int64) - corner).T
        Ks = self.Ks.copy()
        Ks[:, :2, 2] -= corner
        return replace(self, Ks=Ks, widths=widths, heights=heights)

    def facing(self, points: ArrayLike) -> Mask:
        """Return which views contain any of the points within their image.

        Args:
            points: (N, 3) world coordinates.

        Returns:
            (C,) bool.

        >>> K = [[50, 0, 32], [0, 50, 32], [0, 0, 1]]
        >>> eyes = [look_at([3, 0, 0], [0, 0, 0]), look_at([3, 0, 0], [6, 0, 0])]
        >>> Cameras.from_lists(eyes, [K] * 2, [(64, 64)] * 2, "ab").facing([[0, 0, 0]]).tolist()
        [True, False]
        """
        world = np.asarray(points, np.float64)
        few = world[:: max(1, len(world) // 1024)]  # usually enough
        return np.array([view.holds(few).any() or view.holds(world).any() for view in self], bool)

    def usual_share(self, points: ArrayLike) -> float:
        """Return the share of (N, 3) world points in a view, as the median over at most 16 views."""
        shares = [
            self[view].holds(points).mean() for view in evenly_spaced(len(self), _MEDIAN_VIEWS)
        ]
        return float(np.median(shares))

    def recentred(self, offset: ArrayLike) -> Cameras:
        """Return the views in coordinates relative to the world point `offset` (see `Splats.offset`)."""
        shift = np.asarray(offset, np.float64)
        viewmats = self.viewmats.copy()
        viewmats[:, :3, 3] += viewmats[:, :3, :3] @ shift
        return replace(self, viewmats=viewmats)

    @classmethod
    def from_lists(
        cls,
        viewmats: Sequence[Any],
        Ks: Sequence[Any],
        sizes: Sequence[tuple[int, int]],
        names: Sequence[str],
        image_paths: Sequence[Path | None] = (),
        distortions: Sequence[Any] = (),
        mask_paths: Sequence[Path | None] = (),
        kinds: Sequence[str] = (),
        lenses: Sequence[PhotoLens | None] = (),
    ) -> Cameras:
        """Stack per-view lists; `sizes` holds (width, height)."""
        n = len(viewmats)
        for i, (width, height) in enumerate(sizes):  # check before converting to int64
            check_image(int(width), int(height), index=i, item="view")
        return cls(
            viewmats=np.asarray(viewmats, np.float64).reshape(n, 4, 4),
            Ks=np.asarray(Ks, np.float64).reshape(n, 3, 3),
            widths=np.asarray([w for w, _ in sizes], np.int64),
            heights=np.asarray([h for _, h in sizes], np.int64),
            names=tuple(names),
            image_paths=tuple(image_paths),
            distortions=np.asarray(distortions, np.float64).reshape(-1, 5),
            mask_paths=tuple(mask_paths),
            kinds=tuple(kinds),
            lenses=tuple(lenses),
        )


def within_frame(u: Values, v: Values, width: int, height: int) -> Mask:
    """Return whether points of the image plane, in pixels, lie within an image of this size."""
    inside: Mask = u >= 0
    inside &= u < width
    inside &= v >= 0
    inside &= v < height
    return inside


def rows_by_kind(kinds: Sequence[str]) -> dict[str, list[int]]:
    """Return the indices of the views of each kind: usual ones first, others in order of appearance.

    >>> rows_by_kind(["near", "usual", "near"])
    {'usual': [1], 'near': [0, 2]}
    """
    rows: dict[str, list[int]] = {USUAL: []}
    for row, kind in enumerate(kinds):
        rows.setdefault(kind, []).append(row)
    return {kind: members for kind, members in rows.items() if members}


def look_at(position: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> Float:
    """Return camera_from_world of a camera at `position` facing `target`, image top towards `up`.

    Args:
        position: (3,) the camera's centre, world coordinates.
        target: (3,) a point it faces.
        up: (3,) a direction of any nonzero length; if the camera faces along it, the roll is arbitrary.

    Returns:
        (4, 4) float64, rigid; OpenCV axes: x right, y down, z forward.

    Raises:
        InputError: position and target coincide.

    >>> look_at([0, 0, -2], [0, 0, 0], up=[0, -1, 0]).tolist()[2]
    [0.0, 0.0, 1.0, 2.0]
    """
    check_vector("position", position)
    check_vector("target", target)
    check_direction("up", up)
    eye = np.asarray(position, np.float64)
    top = np.asarray(up, np.float64)
    forward = np.asarray(target, np.float64) - eye
    length = np.linalg.norm(forward)
    if not length > 0:
        raise InputError("coincides with the position", parameter="target")
    z = forward / length
    x = np.cross(z, top)
    if np.linalg.norm(x) < 1e-9 * np.linalg.norm(top):  # facing along `up`: any right axis works
        x = np.cross(z, np.roll(top, 1))
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    view = np.eye(4)
    view[:3, :3] = rotation
    view[:3, 3] = -rotation @ eye
    return view


def unseeing(cameras: Cameras, what: str) -> str:
    """Return the error message for views that do not see `what`.

    >>> unseeing(Cameras.of([Camera.facing([0, -2, 0], [0, 0, 0])]), "the scene").partition(" (")[0]
    'none of 1 view sees the scene; the views and the scene must use the same coordinates'
    """
    return (
        f"none of {plural(len(cameras), 'view')} sees {what}; the views and the scene must use the same "
        "coordinates (see `g2ard info`; `g2ard convert --transform` moves a scene)"
    )
