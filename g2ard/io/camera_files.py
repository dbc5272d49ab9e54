"""Views as text: g2ard's own .json, INRIA's cameras.json, nerfstudio's transforms.json, COLMAP's tables.

The others hold less than g2ard's own; `lost_views` says what a format cannot hold.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from g2ard.config.choices import ViewFormat
from g2ard.errors import InputError, OutputError
from g2ard.io import views
from g2ard.io.paths import beside
from g2ard.io.photos import inverse
from g2ard.io.transforms import FLIP
from g2ard.progress import plural
from g2ard.scene.cameras import USUAL, Cameras
from g2ard.scene.transform import quaternion_of

_OFF_CENTRE = 0.5
"""Distance in pixels of a principal point from the middle that is worth a note."""


def view_format(path: Path, given: ViewFormat | None = None) -> ViewFormat:
    """Return the format of an output path: the given one, or that of its name.

    >>> [view_format(Path(name)) for name in ("poses.json", "a/cameras.json", "transforms_1.json", "model")]
    ['g2ard', 'inria', 'nerfstudio', 'colmap']
    """
    suffix, name = path.suffix.lower(), path.name.lower()
    if given is None and suffix == "":
        return "colmap"
    expected = "" if given == "colmap" else ".json"
    if suffix != expected:
        where = "a folder" if given == "colmap" else ".json, or as a folder for COLMAP"
        raise OutputError(f"views are written as {where}", path=path)
    if given is not None:
        return given
    if name == "cameras.json":
        return "inria"
    return "nerfstudio" if name.startswith("transforms") else "g2ard"


def lost_views(
    cameras: Cameras, format: ViewFormat, splits: Sequence[str | None], weighted: bool
) -> list[str]:
    """Describe what a format cannot hold of views."""
    if format == "g2ard":
        return []
    lost = []
    middle = [[w / 2, h / 2] for w, h in zip(cameras.widths, cameras.heights, strict=True)]
    off = int((abs(cameras.Ks[:, :2, 2] - middle).max(axis=1) > _OFF_CENTRE).sum())
    if format == "inria" and off:
        lost.append(f"{plural(off, 'principal point')} beside the image's middle")
    bent = cameras.distortions[:, slice(None) if format == "inria" else slice(4, None)].any(axis=1)
    if format != "nerfstudio" and bent.any():
        what = "lens distortion" if format == "inria" else "k3 of the lens distortion"
        lost.append(f"{what} of {plural(int(bent.sum()), 'view')}")
    if format != "nerfstudio" and any(word not in (None, "train") for word in splits):
        lost.append("splits")
    photos = sum(lens is not None for lens in cameras.lenses)
    lost += [f"photos of {plural(photos, 'view')} that other lenses took"] if photos else []
    kinds = sum(kind != USUAL for kind in cameras.kinds)
    lost += [f"the kinds of {plural(kinds, 'view')}"] if kinds else []
    return lost + (["sampling weights"] if weighted else [])


def texts_of(
    path: Path,
    cameras: Cameras,
    format: ViewFormat,
    splits: Sequence[str | None] = (),
    weights: ArrayLike | None = None,
) -> dict[str, str]:
    """Return the files of views by their paths below `path`, which is "" for a single file."""
    if not len(cameras):
        raise InputError("not written: there are no views", path=path)
    if format == "colmap":
        return _colmap(cameras)
    if format == "inria":
        return {"": _inria(cameras)}
    if format == "nerfstudio":
        return {"": _nerfstudio(cameras, path, splits)}
    return {"": views.text_of(path, cameras, splits, weights)}


def _inria(cameras: Cameras) -> str:
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
    return _lines(rows) + "\n"


def _nerfstudio(cameras: Cameras, place: Path, splits: Sequence[str | None]) -> str:
    """Return a transforms.json: world_from_camera in OpenGL axes, and lists of file names per split.

    Photos are relative to the file `place`; views without one are named `images/NAME`.
    """
    lenses = [_lens(cameras, i) for i in range(len(cameras))]
    shared = lenses[0] if all(lens == lenses[0] for lens in lenses) else {}
    frames: list[dict[str, Any]] = []
    for i, viewmat in enumerate(cameras.viewmats):
        photo, mask = (
            (cameras.image_paths[i], cameras.mask_paths[i]) if cameras.lenses[i] is None else (None, None)
        )
        pose = np.asarray(inverse(viewmat) @ FLIP)
        frame = {"file_path": beside(photo, place) or f"images/{cameras.names[i]}"}
        if (covered := beside(mask, place)) is not None:
            frame["mask_path"] = covered
        frames.append({**frame, **({} if shared else lenses[i]), "transform_matrix": pose.tolist()})
    head: dict[str, Any] = {"camera_model": "OPENCV", **shared}
    for word in sorted({word for word in splits if word}):
        names = [frame["file_path"] for frame, own in zip(frames, splits, strict=True) if own == word]
        head[f"{word}_filenames"] = names
    return json.dumps(head)[:-1] + f', "frames": {_lines(frames)}}}\n'


def _colmap(cameras: Cameras) -> dict[str, str]:
    """Return sparse/0 with cameras.txt, images.txt and an empty points3D.txt; a camera per lens."""
    lenses: dict[str, int] = {}
    images = []
    for i, viewmat in enumerate(cameras.viewmats):
        lens = _lens(cameras, i)
        words = [lens[key] for key in ("w", "h", "fl_x", "fl_y", "cx", "cy")]
        bent = [lens[key] for key in ("k1", "k2", "p1", "p2")]
        kind = ["OPENCV", *words, *bent] if any(bent) else ["PINHOLE", *words]
        camera = lenses.setdefault(" ".join(map(str, kind)), len(lenses) + 1)
        pose = [*quaternion_of(viewmat[:3, :3]).tolist(), *viewmat[:3, 3].tolist()]
        images.append(" ".join(map(str, [i + 1, *pose, camera, cameras.names[i]])) + "\n\n")
    rows = {
        "cameras": "".join(f"{number} {words}\n" for words, number in lenses.items()),
        "images": "".join(images),
        "points3D": "",
    }
    return {f"sparse/0/{name}.txt": f"# {columns}\n{rows[name]}" for name, columns in _COLUMNS.items()}


_COLUMNS = {
    "cameras": "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]",
    "images": "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then a line of POINTS2D[]",
    "points3D": "POINT3D_ID X Y Z R G B ERROR TRACK[]",
}


def _lens(cameras: Cameras, i: int) -> dict[str, Any]:
    """Return intrinsics as in transforms.json."""
    K = cameras.Ks[i]
    lens: dict[str, Any] = {"w": int(cameras.widths[i]), "h": int(cameras.heights[i])}
    lens |= {"fl_x": float(K[0, 0]), "fl_y": float(K[1, 1]), "cx": float(K[0, 2]), "cy": float(K[1, 2])}
    return lens | dict(zip(("k1", "k2", "p1", "p2", "k3"), cameras.distortions[i].tolist(), strict=True))


def _lines(rows: list[dict[str, Any]]) -> str:
    return "[\n" + ",\n".join(map(json.dumps, rows)) + "\n]"
