"""Reader for LLFF's poses_bounds.npy beside a folder of photos."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from g2ard.errors import InputError, damaged
from g2ard.io.finding import photos_in
from g2ard.io.frames import Frame, Lens, Listed, invert_pose, make_rigid
from g2ard.io.jsonfile import Place
from g2ard.io.types import ViewFiles
from g2ard.progress import plural

NAME = "poses_bounds.npy"

_LLFF_AXES = np.array(
    [
        [0.0, 1.0, 0.0],
        [1.0, 0.0, 0.0],
        [0.0, 0.0, -1.0],
    ]
)
"""Columns that turn down, right, backwards into right, down, forward."""


def read(views: ViewFiles) -> Listed:
    """Read the poses of all photos of a folder, in the order of their names.

    Each row holds a 3×5 matrix and the nearest and farthest depth, which are ignored. The matrix is
    world_from_camera with axes down, right, backwards, and the column height, width, focal length in pixels.

    `path` is the file or its folder. Photos lie in `images`, or in `images_4` or the like if that is missing,
    and may be smaller than the stated size.
    """
    file = views.file(NAME)
    try:
        # mapped: a header cannot claim more than there is
        rows = np.load(file, mmap_mode="r", allow_pickle=False)
    except Exception as error:  # numpy raises any exception for damaged headers
        reason = " ".join(str(error).split())
        raise damaged(f"is not a NumPy array ({reason})", path=file) from error
    is_table = rows.ndim == 2 and len(rows) and rows.shape[1] in (15, 17)
    if not is_table or rows.dtype.kind != "f":
        shape = "×".join(map(str, rows.shape))
        raise InputError(f"holds {shape} values of {rows.dtype}, expected N×17 numbers", path=file)
    photos = _photos(replace(views, path=file.parent))
    if photos and len(photos) != len(rows):
        poses = plural(len(rows), "pose")
        found = plural(len(photos), "photo")
        raise InputError(
            f"has {poses} for {found} in {photos[0].parent}",
            path=file,
            hint="{images=DIR} names the folder with one photo per pose",
        )
    frames = []
    for i, row in enumerate(rows.astype(float)):
        matrix = row[:15].reshape(3, 5)
        photo = photos[i] if photos else None
        frames.append(_frame(Place(file, i, "row"), matrix, photo))
    return Listed(file, frames)


def _frame(place: Place, matrix: np.ndarray, photo: Path | None) -> Frame:
    height, width, focal = matrix[:, 4].tolist()
    positive = height >= 1 and width >= 1 and focal > 0
    if not positive or not np.isfinite(matrix).all():
        raise place.error(f"has height {height}, width {width} and focal length {focal}")
    turn = matrix[:, :3] @ _LLFF_AXES
    pose = make_rigid(np.hstack([turn, matrix[:, 3:4]]), place)
    lens = Lens.pinhole((round(width), round(height)), (focal, focal))
    name = f"{place.index:05d}"
    if photo is not None:
        name = photo.name
    return Frame(name, invert_pose(pose), lens, photo)


def _photos(views: ViewFiles) -> list[Path]:
    """Return the photos that belong to the rows, sorted by name; none if there is no folder of photos."""
    places = [place for place in views.path.glob("images*") if place.is_dir()]
    places.sort(key=lambda place: (len(place.name), place.name))
    if views.images:
        places = [views.images]
    for place in places:
        if found := photos_in(place):
            return found
    return []
