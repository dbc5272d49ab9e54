"""Targets of recovery and evaluation: photos, or a teacher's renders of the same views."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2ard.arrays import Float, Float32, Mask, Values
from g2ard.config.checks import checks_arguments
from g2ard.config.choices import BLACK, Colour
from g2ard.errors import InputError, require
from g2ard.io.paths import file_identity
from g2ard.io.photos import load_mask, load_photo
from g2ard.progress import Progress, plural, silent
from g2ard.rendering.renderer import RasterSettings, Renderer
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats
from g2ard.system.cached import cached_property
from g2ard.system.keys import key_of
from g2ard.system.shown import Shown
from g2ard.system.spill import Spill
from g2ard.system.threads import in_threads

RENDERS = "the dense scene"
"""Name of targets that are not photos."""
CACHE_BYTES = 2_000_000_000
"""Bytes of targets kept in memory; further ones are in a temporary file, see `Spill`."""


class Targets(Protocol):
    """One (H, W, 3) float32 image in [0, 1] per view of `cameras`."""

    cameras: Cameras

    def __getitem__(self, view: int) -> Float32: ...


def mask_of(targets: Targets, view: int) -> Mask | None:
    """Return the (H, W) mask of a target's valid pixels, or None if all are valid."""
    masks = getattr(targets, "mask", None)
    return None if masks is None else masks(view)


def alpha_of(targets: Targets, view: int) -> Float32 | None:
    """Return the (H, W) alpha of a photo that was composited, or None."""
    alphas = getattr(targets, "alpha", None)
    return None if alphas is None else alphas(view)


def against_of(targets: Targets, view: int) -> str | None:
    """Return the kind of a view's target, "photo" or "teacher", or None if unknown."""
    says: Callable[[int], str | None] | None = getattr(targets, "against", None)
    return None if says is None else says(view)


def kinds_of(targets: Targets) -> str:
    said = [against_of(targets, view) for view in range(len(targets.cameras))]
    return kinds_told(said.count("photo"), said.count("teacher"))


def kinds_told(pictured: int, renders: int) -> str:
    """Describe the kinds of targets, with counts if there are both.

    >>> kinds_told(7, 9), kinds_told(7, 0)
    ('7 photos and 9 renders of the dense scene', 'photos')
    """
    if pictured and renders:
        return f"{plural(pictured, 'photo')} and {plural(renders, 'render')} of the dense scene"
    return "photos" if pictured else RENDERS


def scored_in(targets: Targets, split: str = "") -> str:
    """Describe the views of a score: their number, split, kind of target and size.

    >>> from g2ard.scene.cameras import Camera
    >>> views = Cameras.of([Camera.facing([0, -3, 0], [0, 0, 0], width=64, height=48)])
    >>> scored_in(Photos(views, [np.zeros((48, 64, 3), np.uint8)]), "test")
    '1 test photo, 64×48 px'
    """
    count = len(targets.cameras)
    kinds = kinds_of(targets)
    if kinds == "photos":
        noun = "photo"
        against = ""
    else:
        noun = "view"
        against = f" against {kinds}"
    name = f"{split} {noun}".strip()
    exposed = ", exposure fitted" * isinstance(targets, Exposed)
    return f"{plural(count, name)}{against}, {targets.cameras.size_text}{exposed}"


def fingerprint_of(targets: Targets) -> str:
    """Return hashes of the views, their kinds and the source of their images, for checkpoints."""
    return f"{_identify_source(targets)} {targets.cameras.fingerprint()}"


def _identify_source(targets: Targets) -> str:
    """Return the identity of the images' sources, or a hash of the images if their class is the user's."""
    own = type(targets).__module__.startswith("g2ard.")
    return str(targets.source) if own else _hash_content(targets)  # type: ignore[attr-defined]


def _hash_content(targets: Targets) -> str:
    views = range(len(targets.cameras))
    return key_of([key_of([np.asarray(targets[view]), mask_of(targets, view)]) for view in views])


def checked_targets(targets: Targets, parameter: str = "targets") -> Targets:
    """Return targets whose images are (H, W, 3) float32 in [0, 1].

    Images of other classes are converted on access, see `as_image`.

    Raises:
        InputError: no cameras, or on access an image that does not fit its view.
    """
    if isinstance(targets, Cached | _Chosen):
        return targets
    if not isinstance(getattr(targets, "cameras", None), Cameras) or not hasattr(
        targets, "__getitem__"
    ):
        raise InputError(
            f"expected cameras with an image each, got a value of type {type(targets).__name__}",
            parameter=parameter,
            hint="pass g2ard.Photos(cameras, images), or g2ard.TeacherRenders(scene, cameras)",
        )
    return _Converted(targets, parameter)


def as_image(
    image: Any,
    cameras: Cameras,
    view: int,
    parameter: str,
) -> NDArray[np.uint8 | np.float32]:
    """Return an image of a view, (H, W, 3) or (H, W, 4) in uint8 or float32, without a copy if possible.

    Args:
        image: a numpy array or torch tensor: uint8 from 0 to 255, or floats from 0 to 1.
        parameter: the argument that the image comes from, for errors.

    Raises:
        InputError: another shape than the view's, type or range.
    """
    if hasattr(image, "detach"):
        image = image.detach().cpu().numpy()
    array = np.asarray(image)
    height = int(cameras.heights[view])
    width = int(cameras.widths[view])
    hint = None
    if array.shape not in (
        (height, width, 3),
        (height, width, 4),
    ):
        wrong = f"expected shape ({height}, {width}, 3), got {array.shape}"
        if array.shape[1:] == (height, width):
            hint = "move the channels to the end"
        elif array.ndim == 3:
            hint = (
                "scale the images to the size of their cameras, or the cameras with cameras.resized"
            )
    elif array.dtype == np.uint8:
        return array
    elif array.dtype.kind != "f":
        wrong = f"expected uint8, or floats from 0 to 1, got {array.dtype}"
    else:
        least = float(array.min())
        most = float(array.max())
        if least >= -_ROUNDING and most <= 1 + _ROUNDING:
            inside = least >= 0 and most <= 1
            return np.asarray(array if inside else array.clip(0, 1), np.float32)
        wrong = f"expected floats from 0 to 1, got {least:g} to {most:g}"
        if most > _BYTE_LIKE:
            hint = "divide by 255, or pass uint8"
    raise InputError(
        f"({cameras.names[view]}): {wrong}", parameter=parameter, index=view, item="view", hint=hint
    )


def fill(targets: Targets, progress: Progress, views: Sequence[int] | None = None) -> None:
    """Render what memory will hold of some views, all by default; photos are read when they are drawn."""
    if isinstance(targets, Cached | _Chosen):
        targets.fill(progress, views)


_ROUNDING = 1e-3
"""Excess over [0, 1] that is clipped."""
_BYTE_LIKE = 1.5
"""Largest value above which floats are probably bytes."""


class _Sourced(ABC):
    """Targets identified by what they were made from, never by what they computed since."""

    cameras: Cameras

    @cached_property
    def source(self) -> str:
        """Identity of the images' source, which `fingerprint_of` joins with that of the cameras."""
        return key_of([type(self).__name__, *self._given()])

    @abstractmethod
    def _given(self) -> Sequence[Any]:
        """Return all that the images depend on besides the cameras."""


class _Chosen(_Sourced):
    """Views of other targets.

    Args:
        places: the targets and the row in them of each view of `cameras`.
    """

    def __init__(self, cameras: Cameras, places: Sequence[tuple[Targets, int]]) -> None:
        self.cameras = cameras
        self._places = places

    def _given(self) -> Sequence[Any]:
        """Return the sources of the other targets, and which of them has each view in which row."""
        parts = [targets for targets, _ in self._parts()]
        numbers = {id(targets): number for number, targets in enumerate(parts)}
        places = [(numbers[id(targets)], row) for targets, row in self._places]
        return [_identify_source(targets) for targets in parts], places

    def _parts(self, views: Sequence[int] | None = None) -> list[tuple[Targets, list[int]]]:
        """Return the other targets and the rows in them of some views, of all by default."""
        if views is None:
            places = self._places
        else:
            places = [self._places[view] for view in views]
        parts: dict[int, tuple[Targets, list[int]]] = {}
        for targets, row in places:
            _, rows = parts.setdefault(id(targets), (targets, []))
            rows.append(row)
        return list(parts.values())

    def fill(self, progress: Progress, views: Sequence[int] | None = None) -> None:
        """Render some views, see `TeacherRenders.fill`."""
        for targets, rows in self._parts(views):
            fill(targets, progress, rows)

    def __getitem__(self, view: int) -> Float32:
        targets, row = self._places[view]
        return targets[row]

    def mask(self, view: int) -> Mask | None:
        """Return the mask, see `mask_of`."""
        return mask_of(*self._places[view])

    def alpha(self, view: int) -> Float32 | None:
        """Return the alpha, see `alpha_of`."""
        return alpha_of(*self._places[view])

    def against(self, view: int) -> str | None:
        """Return the kind, see `against_of`."""
        return against_of(*self._places[view])


class Subset(_Chosen):
    """Subset of other targets."""

    def __init__(self, targets: Targets, rows: ArrayLike) -> None:
        rows = np.asarray(rows, np.int64)
        super().__init__(
            targets.cameras.take(rows),
            [(targets, int(row)) for row in rows],
        )


class Exposed(Subset):
    """Other targets, scored after the gain and offset of each channel that fit a render best to its photo."""

    def __init__(self, targets: Targets) -> None:
        super().__init__(targets, range(len(targets.cameras)))


class _Converted(_Chosen):
    """Targets of another class, converted on access."""

    def __init__(self, targets: Targets, parameter: str) -> None:
        cameras = targets.cameras
        super().__init__(cameras, [(targets, view) for view in range(len(cameras))])
        self._parameter = parameter

    def _given(self) -> Sequence[Any]:
        """Return a hash of the converted images."""
        return [_hash_content(self)]

    def __getitem__(self, view: int) -> Float32:
        try:
            image = super().__getitem__(view)
        except IndexError:
            missing = f"({self.cameras.names[view]}) has no image"
            raise InputError(missing, parameter=self._parameter, index=view, item="view") from None
        array = as_image(image, self.cameras, view, self._parameter)[..., :3]
        return _as_floats(array)


def _as_floats(image: Values) -> Float32:
    """Return an image as contiguous float32, divided by 255 if it has bytes."""
    if image.dtype == np.uint8:
        scaled = image.astype(np.float32) / np.float32(255)
    else:
        scaled = image
    return np.ascontiguousarray(scaled, np.float32)


def with_pixels(targets: Targets) -> Targets:
    """Return the targets except those whose mask leaves no pixel.

    Raises:
        InputError: none is left.
    """
    count = len(targets.cameras)
    masks = ((view, mask_of(targets, view)) for view in range(count))
    rows = [view for view, mask in masks if mask is None or mask.any()]
    if not rows:
        raise InputError(f"the masks of {plural(count, 'view')} leave no pixel")
    if len(rows) == count:
        return targets
    return Subset(targets, rows)


_KEEPING = threading.Lock()
"""Held while targets change what they keep; one for all, so that targets can be pickled."""


class Cached(_Sourced, Shown):
    """Cache of what `_make` returns: up to `limit` bytes in memory, first come first kept, others on disk.

    Without room on the disk, they are made again on each access.
    """

    _spills: ClassVar[bool] = True
    """Whether images beyond the limit are written to a temporary file."""

    def __init__(self, cameras: Cameras, limit: int) -> None:
        require("limit", limit, limit >= 0, "at least 0 bytes")
        self.cameras = cameras
        self._limit = limit
        self._kept: dict[tuple[str, int], Values | None] = {}
        self._bytes = 0
        self._spill = Spill()

    def __repr__(self) -> str:
        return f"{type(self).__name__}({plural(len(self.cameras), 'view')})"

    @abstractmethod
    def _make(self, view: int) -> Values:
        """Create the image of one view, as it is cached."""

    def fill(self, progress: Progress, views: Sequence[int] | None = None) -> None:
        """Make images before they are drawn, if that takes long; see `fill`."""

    def _stored(self, view: int) -> Values:
        return self._cached("image", view, self._make)

    def _holds(self, view: int) -> bool:
        return ("image", view) in self._kept or ("image", view) in self._spill

    def _cached(self, kind: str, view: int, make: Callable[[int], Any]) -> Any:
        """Return an array of a view, or None, which is made if neither memory nor disk holds it."""
        key = kind, view
        if key in self._kept:
            return self._kept[key]
        if key in self._spill:
            return self._spill.get(key)
        made = make(view)
        if made is None:
            size = 0
        else:
            size = made.nbytes
        with _KEEPING:
            if key in self._kept:  # another thread was faster
                return self._kept[key]
            if self._bytes + size <= self._limit:
                self._kept[key] = made
                self._bytes += size
                return made
        if self._spills:
            self._spill.add(key, made)
        return made


class Photos(Cached):
    """Photos of `cameras`: their files, undistorted and at each camera's size, or given images.

    Alpha is composited over the background. A photo with a mask is black outside of it. An exposure is the
    affine colour transform C that trainers fit (photo = C·render); a photo that has one is mapped by C⁻¹ and
    clipped to [0, 1].

    Args:
        cameras: views, all with a photo unless `images` are given.
        images: one image per view: paths of files, or (H, W, 3) arrays or torch tensors, uint8 or floats in
            [0, 1], with alpha (H, W, 4). Arrays have the size of their camera. None reads the photos of
            `cameras`.
        background: RGB behind transparent pixels.
        exposures: (3, 4) exposures by view name, for photos that have one.
        limit: bytes kept in memory; further images are in a temporary file, see `Spill`.

    Raises:
        InputError: a view without a photo, an image that does not fit its view, or an exposure that is not
            invertible.

    >>> from g2ard.scene.cameras import Camera
    >>> views = Cameras.of([Camera.facing([0, -3, 0], [0, 0, 0], width=64, height=48)])
    >>> Photos(views, [np.full((48, 64, 3), 51, np.uint8)])[0].max().round(3)
    np.float32(0.2)
    """

    @checks_arguments
    def __init__(
        self,
        cameras: Cameras,
        images: Sequence[Any] | Values | None = None,
        *,
        background: Colour = BLACK,
        exposures: Mapping[str, Float] | None = None,
        limit: int = CACHE_BYTES,
    ) -> None:
        self._images: list[Any] | None = None
        if images is not None:
            if len(images) != len(cameras):
                raise InputError(
                    f"expected one image per view, got {len(images)} for {plural(len(cameras), 'view')}",
                    parameter="images",
                )
            if all(isinstance(image, str | Path) for image in images):
                paths = tuple(map(Path, images))
                masks = list(cameras.mask_paths)
                for view, mask in enumerate(masks):
                    if mask and mask == cameras.image_paths[view]:  # it is in the photo's file
                        masks[view] = paths[view]
                cameras = replace(cameras, image_paths=paths, mask_paths=tuple(masks))
            else:
                self._images = [
                    as_image(image, cameras, i, "images") for i, image in enumerate(images)
                ]
                cameras = replace(cameras, image_paths=(), mask_paths=())
        if self._images is None and None in cameras.image_paths:
            raise InputError(
                f"view {cameras.names[cameras.image_paths.index(None)]} has no photo",
                hint="pass views with photos, their {images=DIR}, or render them from {teacher=SCENE}",
            )
        super().__init__(cameras, limit)
        self._background = background
        self._undo = {
            view: _invert_exposure(name, exposures[name])
            for view, name in enumerate(cameras.names)
            if exposures and name in exposures
        }

    def _given(self) -> Sequence[Any]:
        """Return images, identities of the files of photos and masks, background and exposures."""
        paths = (*self.cameras.image_paths, *self.cameras.mask_paths)
        files = [path and file_identity([path]) for path in paths]
        return [files, self._images, self._background, self._undo]

    def against(self, view: int) -> str:
        """Return the kind, see `against_of`."""
        return "photo"

    def mask(self, view: int) -> Mask | None:
        """Return the mask of valid pixels, or None."""
        mask: Mask | None = self._cached("mask", view, partial(load_mask, self.cameras))
        return mask

    def alpha(self, view: int) -> Float32 | None:
        """Return the alpha, see `alpha_of`."""
        alpha: Float32 | None = self._cached("alpha", view, self._alpha)
        return alpha

    def _alpha(self, view: int) -> Float32 | None:
        if self._images is None:
            own = load_photo(self.cameras, view, None)[0]
        else:
            own = self._images[view]
        if own.shape[2] != 4:
            return None
        return _as_floats(own)[..., 3].copy()

    def _stored(self, view: int) -> Values:
        if self._images is not None and self._images[view].shape[2] == 3:
            return self._images[view]  # in memory anyway
        return super()._stored(view)

    def _make(self, view: int) -> NDArray[np.uint8 | np.float32]:
        if self._images is not None:
            return _composite(self._images[view], self._background)
        image, mask = load_photo(self.cameras, view, self._background)
        self._cached("mask", view, lambda _: mask)
        return np.rint(image * 255).astype(np.uint8)

    def __getitem__(self, view: int) -> Float32:
        photo = _as_floats(self._stored(view))
        undo = self._undo.get(view)
        if undo is not None:
            photo = np.ascontiguousarray(photo @ undo[:, :3].T + undo[:, 3], dtype=np.float32)
            photo = np.clip(photo, 0, 1, out=photo)
        mask = self.mask(view)
        if mask is not None:
            photo[~mask] = 0
        return photo


def _composite(image: Values, background: Colour) -> Float32:
    """Composite an image with alpha over the background."""
    floats = _as_floats(image)
    alpha = floats[..., 3:]
    colour = np.array(background, np.float32)
    composited = floats[..., :3] * alpha
    composited += colour * (1 - alpha)
    return np.ascontiguousarray(composited)


_RENDER_LEVELS = np.float32(65_535)
"""Largest value of a render rounded to 16 bits."""


def rounded(image: Float32) -> NDArray[np.uint16]:
    """Round a render in [0, 1] to 16 bits, in place."""
    image *= _RENDER_LEVELS
    return np.rint(image, out=image).astype(np.uint16)


def unrounded(image: NDArray[np.uint16]) -> Float32:
    """Return the render that `rounded` stored."""
    return np.multiply(image, 1 / _RENDER_LEVELS, dtype=np.float32)


class TeacherRenders(Cached):
    """Renders of the dense scene: (H, W, 3) float32, clipped to [0, 1], cached in 16 bits.

    Args:
        teacher: the dense scene.
        cameras: the views, world coordinates.
        background: RGB in [0, 1] behind the scene.
        settings: the renderer's conventions; None means gsplat's.
        limit: bytes of renders kept in memory; further ones are in a temporary file, see `Spill`.
        lazy: render a view on first access instead of all at once.
        renderer: a shared renderer of the same teacher, background and settings; None creates one.
        progress: called with the number of views rendered.

    Raises:
        InputError: a camera or a background that cannot be rendered.
    """

    @checks_arguments
    def __init__(
        self,
        teacher: Splats,
        cameras: Cameras,
        *,
        background: Colour = BLACK,
        settings: RasterSettings | None = None,
        limit: int = CACHE_BYTES,
        lazy: bool = False,
        renderer: Renderer | None = None,
        progress: Progress = silent,
    ) -> None:
        super().__init__(cameras, limit)
        self._teacher = teacher
        self._background = background
        self._settings = settings
        self._renderer = renderer
        if not lazy:
            self.fill(progress)

    def _given(self) -> Sequence[Any]:
        return [self._teacher, self._background, self._settings]

    def fill(self, progress: Progress, views: Sequence[int] | None = None) -> None:
        """Render the views, all by default, so that later steps take equal time; stop if the disk is full."""
        if views is None:
            views = range(len(self.cameras))
        missing = [view for view in views if not self._spill.full and not self._holds(view)]
        for number, _ in enumerate(in_threads(self._stored, missing), 1):
            progress("targets", number, len(missing))
            if self._spill.full:
                break
        self._renderer = None  # its buffers are larger than the scene

    def _make(self, view: int) -> NDArray[np.uint16]:
        return rounded(self._shared_renderer().clipped(self.cameras[view]))

    def _shared_renderer(self) -> Renderer:
        with _KEEPING:
            if self._renderer is None:
                teacher = self._teacher
                background = self._background
                self._renderer = Renderer(teacher, background=background, settings=self._settings)
            return self._renderer

    def against(self, view: int) -> str:
        """Return the kind, see `against_of`."""
        return "teacher"

    def __getitem__(self, view: int) -> Float32:
        return unrounded(self._stored(view))


class PhotosOrRenders(_Chosen):
    """Photo of each view, or a render of the dense scene for views without a photo.

    As in sec. 3.1: "real images are used when available, otherwise teacher renders".

    Args:
        teacher: the dense scene, or a function that returns its renders in some views.
        exposures: exposures of the photos, see `Photos`.
        limit: bytes kept in memory per kind, see `Photos`.
        renders: further arguments of `TeacherRenders`.
    """

    def __init__(
        self,
        cameras: Cameras,
        teacher: Splats | Callable[[Cameras], Targets],
        *,
        background: Colour = BLACK,
        exposures: Mapping[str, Float] | None = None,
        limit: int = CACHE_BYTES,
        **renders: Any,
    ) -> None:
        pictured = np.array([path is not None for path in cameras.image_paths], bool)
        parts = [cameras.take(np.flatnonzero(mask)) for mask in (pictured, ~pictured)]
        photos = Photos(parts[0], background=background, exposures=exposures, limit=limit)
        others: Targets
        if isinstance(teacher, Splats):
            others = TeacherRenders(
                teacher, parts[1], background=background, limit=limit, **renders
            )
        else:
            others = teacher(parts[1])
        rows = np.where(pictured, np.cumsum(pictured), np.cumsum(~pictured)) - 1
        places: list[tuple[Targets, int]] = []
        for is_photo, row in zip(pictured, rows.tolist(), strict=True):
            if is_photo:
                places.append((photos, row))
            else:
                places.append((others, row))
        super().__init__(cameras, places)


def _invert_exposure(name: str, exposure: Float) -> Float32:
    """Return the (3, 4) transform from the photo `name` to a render, from its exposure (render to photo)."""
    matrix = np.asarray(exposure, np.float64)
    if (
        matrix.shape != (3, 4)
        or not np.isfinite(matrix).all()
        or abs(np.linalg.det(matrix[:, :3])) < 1e-6
    ):
        raise InputError(f"exposure of {name}: expected an invertible 3×4 matrix")
    inverse = np.linalg.inv(matrix[:, :3])
    return np.hstack([inverse, -inverse @ matrix[:, 3:]]).astype(np.float32)
