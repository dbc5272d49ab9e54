"""Views as files list them, and the cameras they become: photos within limits, poses that are rigid."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from g2ard.arrays import Float
from g2ard.errors import InputError
from g2ard.io.finding import (
    Finder,
    is_a_photo,
    is_end,
    mask_folders,
    photos_in,
    plain_parts,
    readable,
    usable,
)
from g2ard.io.jsonfile import Place
from g2ard.io.photo_headers import (
    describe_unreadable,
    has_alpha,
    have_same_aspect,
    needs_turn,
    open_image,
    orientation,
    swap_sides,
)
from g2ard.io.types import Note, Notes, Size, ViewSet
from g2ard.progress import plural
from g2ard.scene.cameras import USUAL, Cameras
from g2ard.scene.lenses import PhotoLens, pinhole_matrix
from g2ard.scene.transform import rotation_matrices


class Lens(NamedTuple):
    """Size, pinhole matrix and OpenCV distortion k1 k2 p1 p2 k3 of a camera, or the lens of a photo that
    pinhole views are to be made from, or that this is such a view of (`made`)."""

    size: Size
    K: Float
    distortion: tuple[float, ...] = (0.0,) * 5
    photo: PhotoLens | None = None
    made: bool = False

    @property
    def is_bent(self) -> bool:
        """Whether views are to be made from the photo."""
        return self.photo is not None and not self.made

    def at(self, size: Size) -> Lens:
        """Return the lens for resized photos."""
        if size == self.size:
            return self
        K = self.K.copy()
        K[0] *= size[0] / self.size[0]
        K[1] *= size[1] / self.size[1]
        return self._replace(size=size, K=K)

    @classmethod
    def pinhole(
        cls,
        size: Size,
        focal: tuple[float, float],
        middle: tuple[float, float] | None = None,
        distortion: tuple[float, ...] = (0.0,) * 5,
    ) -> Lens:
        """Return the lens of focal lengths and a principal point, None for the middle of the image."""
        fx, fy = focal
        cx, cy = middle or (size[0] / 2, size[1] / 2)
        K = pinhole_matrix(fx, fy, cx, cy)
        return cls(size, K, distortion)

    @classmethod
    def of(cls, photo: PhotoLens) -> Lens:
        """Return the lens of a photo, from which `make_view_set` makes views."""
        return cls(photo.size, np.diag([*photo.focal, 1.0]), photo=photo)


class Frame(NamedTuple):
    """A view as listed in a file; its `photo` may be missing, and `listed` is what the file calls it."""

    name: str
    viewmat: Float
    lens: Lens
    photo: Path | None
    split: str | None = None
    weight: float | None = None
    mask: Path | None = None
    kind: str = USUAL
    listed: str = ""


class Listed(NamedTuple):
    """Views as a file lists them.

    Args:
        path: the file or folder.
        left_out: names of views with numbers that are not finite, and what is wrong.
        notes: further notes.
    """

    path: Path
    frames: Sequence[Frame]
    left_out: Sequence[tuple[str, InputError]] = ()
    notes: Notes = ()

    def noted(self, code: str, count: int, text: str) -> Listed:
        """Return the views with a further note, if it counts anything."""
        if count:
            return self._replace(notes=(*self.notes, Note(code, count, text)))
        return self

    def whole(self) -> Sequence[Frame]:
        """Return the frames, or raise the error of the first view that is left out."""
        if self.left_out:
            raise self.left_out[0][1]
        return self.frames


def _fit_lens_to_photo(lens: Lens, photo: Path) -> tuple[Lens, bool]:
    """Return a lens for the size of its photo, if that has the same aspect, and whether EXIF turns the photo.

    A photo that cannot be read changes nothing.
    """
    with suppress(Exception), open_image(photo) as image:
        size = image.size
        if needs_turn(image, lens.size):
            size = swap_sides(size)
        is_turned = orientation(image) != 1
        if not lens.made and have_same_aspect(size, lens.size):
            lens = lens.at(size)
        return lens, is_turned
    return lens, False


def make_rigid(matrix: Float, place: Place) -> Float:
    """Return the rigid transform nearest to a (4, 4) or (3, 4) pose with rounding errors or a uniform scale.

    Raise an `InputError` for a pose that is not finite, is mirrored, or differs from a rotation by over 1 %.
    """
    if matrix.shape not in ((4, 4), (3, 4)) or not np.isfinite(matrix).all():
        raise place.error("is not a finite 4×4 matrix")
    U, scales, Vt = np.linalg.svd(matrix[:3, :3])
    largest, _, least = scales
    R = U @ Vt
    is_mirrored = np.linalg.det(R) < 0
    if not largest > 0 or least < 0.99 * largest or is_mirrored:
        raise place.error("is not a rotation and a translation")
    out = np.eye(4)
    out[:3, :3] = R
    out[:3, 3] = matrix[:3, 3]
    return out


def make_pose(quat: ArrayLike, translation: ArrayLike) -> Float:
    """Return the (4, 4) rigid transform of a quaternion wxyz, of any length, and a translation."""
    out = np.eye(4)
    out[:3, :3] = rotation_matrices(np.array([quat]))[0]
    out[:3, 3] = translation
    return out


def invert_pose(matrix: Float) -> Float:
    R = matrix[:3, :3]
    t = matrix[:3, 3]
    out = np.eye(4)
    out[:3, :3] = R.T
    out[:3, 3] = -R.T @ t
    return out


def _stack_cameras(path: Path, frames: Sequence[Frame]) -> Cameras:
    masks = Finder()
    rows = []
    for frame in frames:
        lens = frame.lens
        row = (
            frame.viewmat,
            lens.K,
            lens.size,
            frame.name,
            frame.photo,
            lens.distortion,
            _find_mask(frame, masks),
            frame.kind,
            lens.photo,
        )
        rows.append(row)
    try:
        return Cameras.from_lists(*zip(*rows, strict=True))
    except InputError as error:
        raise error.at(path=path) from error
    except OverflowError as error:
        raise InputError("the size of a view is too large", path=path) from error


def _find_mask(frame: Frame, masks: Finder) -> Path | None:
    """Return the frame's mask, or that found for its photo."""
    if frame.mask is not None or frame.photo is None:
        return frame.mask
    depth = len(plain_parts(frame.listed or frame.name))
    return masks.mask(frame.photo, depth)


def make_view_set(listed: Listed) -> ViewSet:
    """Stack frames with unique names; frames whose photo is missing keep their pose only."""
    path, frames, left_out, further = listed
    if not frames and not listed.whole():
        raise InputError("no views found", path=path)
    names = readable([frame.name for frame in frames], [frame.photo for frame in frames])
    frames = [frame._replace(name=name) for frame, name in zip(frames, names, strict=True)]
    name, times = Counter(frame.name for frame in frames).most_common(1)[0]
    if times > 1:
        raise InputError(f"{times} views are named {name!r}; names must be unique", path=path)
    notes = []
    if left_out:
        name, fault = left_out[0]
        views = plural(len(left_out), "view")
        text = (
            f"{views} left out, which numbers that are not finite describe: {fault} (view {name!r})"
        )
        notes.append(Note("not_finite", len(left_out), text))
    frames, found_notes = _check_photos(frames)
    notes += found_notes
    bent = [frame.lens.photo for frame in frames if frame.lens.is_bent]
    if bent:
        frames = [view for frame in frames for view in _split_into_pinholes(frame)]
        made = sum(frame.lens.photo is not None for frame in frames)
        models = ", ".join(sorted({lens.model for lens in bent if lens}))
        photos = plural(len(bent), "photo")
        text = f"{photos} ({models}) resampled to {plural(made, 'pinhole view')}"
        notes.append(Note("resampled", made, text))
    pictured = [frame.photo for frame in frames if frame.photo is not None]
    present = [frame for frame in frames if frame.photo is not None and usable(frame.photo)]
    if present and len(present) < len(frames):
        there = {frame.name for frame in present}
        for i, frame in enumerate(frames):
            if frame.name not in there:
                frames[i] = frame._replace(photo=None, mask=None)
    elif not present and pictured:
        photos = plural(len(pictured), "photo")
        text = f"none of {photos} found; using poses only (the first is {pictured[0]})"
        notes.append(Note("no_photos", len(pictured), text))
        frames = [frame._replace(photo=None) for frame in frames]
    cameras = replace(_stack_cameras(path, frames), source=path)
    masked = sum(mask is not None for mask in cameras.mask_paths)
    if masked:
        text = f"{plural(masked, 'photo')} of {len(present)} have masks"
        notes.append(Note("masks", masked, text))
    elif present:
        folders = _find_idle_masks(present[0])
        if folders:
            name = present[0].name
            text = f"no mask in {folders[0]} is named like a photo, as {name}.png would be"
            notes.append(Note("unused_masks", 1, text))
    return ViewSet(
        cameras,
        (*notes, *further),
        _list_splits(frames),
        _list_weights(frames),
    )


def _list_splits(frames: Sequence[Frame]) -> tuple[str | None, ...]:
    splits = tuple(frame.split for frame in frames)
    if any(splits):
        return splits
    return ()


def _list_weights(frames: Sequence[Frame]) -> Float | None:
    """Return the weights of views, 1 where none is stated; None if none is."""
    weights = [frame.weight for frame in frames]
    if set(weights) == {None}:
        return None
    return np.array([1.0 if weight is None else weight for weight in weights])


def _split_into_pinholes(frame: Frame) -> list[Frame]:
    """Return the pinhole views of a frame, which is its only one unless its lens needs several."""
    lens = frame.lens.photo
    if lens is None or not frame.lens.is_bent:
        return [frame]
    views = []
    scale = frame.lens.size[0] / lens.size[0]
    for face, turn, K, size in lens.faces(scale):
        viewmat = np.eye(4)
        viewmat[:3] = turn.T @ frame.viewmat[:3]
        name = frame.name
        if face:
            name += f"#{face}"
        own = Lens(size, K, photo=lens.turned(turn), made=True)
        views.append(frame._replace(name=name, viewmat=viewmat, lens=own))
    return views


def _find_idle_masks(frame: Frame) -> list[Path]:
    """Return folders of masks for a photo that hold images."""
    if frame.photo is None:
        return []
    depth = len(plain_parts(frame.listed or frame.name))
    folders = mask_folders(frame.photo, depth)
    return [folder for folder, _ in folders if photos_in(folder, below=True)]


_PHOTO_NOTES = {
    "unreadable_photos": "of {views} cannot be read: {first}; convert to JPEG or PNG",
    "equal_names": "not found among equal names in folders: {first}",
    "other_suffix": "found with another suffix: {first}",
    "exif_orientation": "with an EXIF orientation (the first is {first}): turned where only that fits the "
    "size of the view, otherwise read as stored",
    "other_size": "of another size than the file says, which their views take ({first})",
    "other_spelling": "found with another spelling, Unicode form or character set: {first}",
}
"""Code of a note on photos → its text after their number."""


def _check_photos(frames: Sequence[Frame]) -> tuple[list[Frame], list[Note]]:
    """Drop photos that cannot be read, and photos that names of several folders were shortened to."""
    out = list(frames)
    found = {code: list[str]() for code in _PHOTO_NOTES}
    times = Counter(frame.photo for frame in frames)
    for i, frame in enumerate(frames):
        photo = frame.photo
        if photo is None or not usable(photo):
            continue
        what = describe_unreadable(photo)
        if what is not None:
            found["unreadable_photos"].append(f"{frame.name} is {what}")
            out[i] = frame._replace(photo=None, mask=None)
            continue
        if frame.listed and times[photo] > 1 and not is_end(frame.listed, photo):
            found["equal_names"].append(f"{frame.name} is not {photo}, which another view has")
            out[i] = frame._replace(photo=None, mask=None)
            continue
        wanted = Path(frame.listed)
        if is_a_photo(wanted):
            if photo.suffix.lower() != wanted.suffix.lower():
                found["other_suffix"].append(f"{frame.name} is {photo.name}")
            elif plain_parts(frame.listed)[-1].lower() != photo.name.lower():
                found["other_spelling"].append(f"{frame.name} is {photo.name}")
        lens, is_turned = _fit_lens_to_photo(frame.lens, photo)
        if is_turned:
            found["exif_orientation"].append(photo.name)
        if lens.size != frame.lens.size:
            sizes = "{}×{} instead of {}×{}".format(*lens.size, *frame.lens.size)
            found["other_size"].append(f"{frame.name} is {sizes}")
            out[i] = frame._replace(lens=lens)
    notes = []
    for code, photos in found.items():
        if photos:
            text = _PHOTO_NOTES[code].format(first=photos[0], views=len(frames))
            text = f"{plural(len(photos), 'photo')} {text}"
            notes.append(Note(code, len(photos), text))
    return out, notes


def drop_unpictured(found: ViewSet) -> ViewSet:
    """Return the views with a photo, and a note on the others; all views if none has a photo."""
    has = np.array([path is not None for path in found.cameras.image_paths], bool)
    missing = int(np.count_nonzero(~has))
    if not missing or missing == len(has):
        return found
    first = found.cameras.names[int(np.argmin(has))]
    text = f"{plural(missing, 'view')} of {len(has)} skipped: no photo (the first is {first!r})"
    return found.take(has).noted("missing_photos", missing, text)


def use_alpha_as_masks(found: ViewSet) -> ViewSet:
    """Make each photo with alpha and without a mask its own mask, and note how many."""
    cameras = found.cameras
    masks = list(cameras.mask_paths)
    count = 0
    for i, photo in enumerate(cameras.image_paths):
        if masks[i] is None and photo is not None and has_alpha(photo):
            masks[i] = photo
            count += 1
    found = replace(found, cameras=replace(cameras, mask_paths=tuple(masks)))
    text = f"{plural(count, 'photo')} of {len(masks)} masked by alpha"
    return found.noted("alpha_masks", count, text)
