"""Reader and writer for cameras.json, which INRIA's trainer writes into a model's folder."""

from collections import Counter
from typing import Any

import msgspec
import numpy as np

from g2ard.io.finding import Finder
from g2ard.io.frames import Frame, Lens, Listed, invert_pose, make_rigid
from g2ard.io.jsonfile import Matrix, Number, Place, Vector, Whole, checked, read_any_json
from g2ard.io.transforms import json_rows
from g2ard.io.types import ViewFiles
from g2ard.progress import plural
from g2ard.scene.cameras import Cameras

NAME = "cameras.json"


class _Camera(msgspec.Struct):
    img_name: str
    width: Whole
    height: Whole
    position: Vector
    rotation: Matrix
    fx: Number
    fy: Number
    id: Any = None


def read(views: ViewFiles) -> Listed:
    """Read a model's training and test cameras from its folder or its cameras.json.

    `rotation` holds the rows of world_from_camera, in OpenCV axes. The principal point is the image's centre,
    as in INRIA's trainer. The id is appended to repeated names, such as r_0 of each split of NeRF's synthetic
    scenes. Without `images`, photos are in `images` beside the file.
    """
    images = views.images
    file = views.file(NAME)
    listed = checked(read_any_json(file), list[_Camera], Place(file), entries="camera")
    beside = images or file.parent / "images"
    names = [camera.img_name for camera in listed]
    among = Finder.among(images, names, [beside], [file.parent])
    finder = None
    if beside.is_dir() or among.notes:
        finder = among
    times = Counter(names)
    frames = []
    for i, camera in enumerate(listed):
        frame = _frame(Place(file, i, "camera"), camera, finder)
        if times[camera.img_name] > 1:
            number = camera.id
            if number is None:
                number = i
            frame = frame._replace(name=f"{frame.name}_{number}")
        frames.append(frame)
    found = Listed(file, frames, notes=among.notes)
    repeated = sum(count for count in times.values() if count > 1)
    what = f"{plural(repeated, 'camera')} of {len(frames)}"
    text = f"{what} have repeated names; their ids are appended"
    return found.noted("repeated_names", repeated, text)


def _frame(place: Place, camera: _Camera, finder: Finder | None) -> Frame:
    world_from_camera = np.column_stack([camera.rotation, camera.position])
    pose = make_rigid(world_from_camera, place.to("rotation"))
    size = int(camera.width), int(camera.height)
    photo = None
    if finder:
        photo = finder.photo(camera.img_name)
    return Frame(
        name=camera.img_name,
        viewmat=invert_pose(pose),
        lens=Lens.pinhole(size, (camera.fx, camera.fy)),
        photo=photo,
        listed=camera.img_name,
    )


def text_of(cameras: Cameras) -> str:
    """Return {id, img_name, width, height, position, rotation, fx, fy} per view, in OpenCV axes."""
    rows = []
    for i, viewmat in enumerate(cameras.viewmats):
        turn = viewmat[:3, :3].T
        rows.append(
            {
                "id": i,
                "img_name": cameras.names[i],
                "width": int(cameras.widths[i]),
                "height": int(cameras.heights[i]),
                "position": (-turn @ viewmat[:3, 3]).tolist(),
                "rotation": turn.tolist(),
                "fy": float(cameras.Ks[i, 1, 1]),
                "fx": float(cameras.Ks[i, 0, 0]),
            }
        )
    return json_rows(rows) + "\n"
