"""Reader for `ns-export cameras` of nerfstudio: transforms_train.json and transforms_eval.json."""

from pathlib import Path

import msgspec
import numpy as np

import g2ard.io.colmap as colmap
import g2ard.io.transforms as transforms
from g2ard.errors import InputError
from g2ard.io.finding import Finder
from g2ard.io.frames import Frame, Lens, Listed, make_rigid
from g2ard.io.jsonfile import Place, Pose, checked, read_any_json
from g2ard.io.trainer_yaml import below
from g2ard.io.types import ViewFiles

LISTS = {"transforms_train.json": "train", "transforms_eval.json": "test"}
"""File → its split."""


class _Camera(msgspec.Struct):
    file_path: str
    transform: Pose


def holds(folder: Path) -> bool:
    return bool(exported(folder))


def exported(folder: Path) -> list[Path]:
    lists = [folder / name for name in LISTS if (folder / name).is_file()]
    return [file for file in lists if isinstance(read_any_json(file), list)]


def read(views: ViewFiles) -> Listed:
    """Read exported poses, {file_path, transform}: world_from_camera, 3×4, OpenGL axes, in the scene's world.

    `path` is one of the lists, or the folder of both. Intrinsics come from a transforms.json or a COLMAP
    model above the photos, scaled to the photos' size.
    """
    path = views.path
    files = [path]
    if path.is_dir():
        files = exported(path)
    finder = None
    if views.images:
        finder = Finder(views.images)
    lenses: dict[Path, dict[str, Lens]] = {}
    frames = []
    for file in files:
        listed = checked(read_any_json(file), list[_Camera], Place(file), entries="camera")
        for i, camera in enumerate(listed):
            place = Place(file, i, "camera")
            frames.append(_frame(place, camera, finder, lenses))
    return Listed(path, frames)


def _frame(
    place: Place,
    camera: _Camera,
    finder: Finder | None,
    lenses: dict[Path, dict[str, Lens]],
) -> Frame:
    path = place.path
    file_path = Path(camera.file_path)
    world_from_camera = make_rigid(np.array(camera.transform), place.to("transform"))
    there = below(path, file_path)
    ups = (below(path, up) for up in file_path.parents[:3] if up.parts)
    lens = _lens(place, file_path, there or next(filter(None, ups), None), lenses)
    photo = there
    if finder:
        photo = finder.photo(camera.file_path)
    return Frame(
        name=file_path.name,
        viewmat=transforms.opencv_view(world_from_camera),
        lens=lens,
        photo=photo or file_path,
        split=LISTS.get(path.name),
        listed=camera.file_path,
    )


def _lens(
    listed: Place,
    named: Path,
    place: Path | None,
    known: dict[Path, dict[str, Lens]],
) -> Lens:
    """Return a photo's intrinsics by file name, from the nearest folder above it that has them."""
    for folder in () if place is None else (place, *place.parents[:3]):
        if folder not in known:
            known[folder] = _lenses(folder)
        if named.name in known[folder]:
            return known[folder][named.name]
    error = listed.error(
        f"has no intrinsics in a transforms.json or COLMAP model above {named.as_posix()}, "
        "and ns-export does not write them"
    )
    raise error.at(hint="give the run's folder with its dataparser_transforms.json")


def _lenses(folder: Path) -> dict[str, Lens]:
    if (folder / "transforms.json").is_file():
        frames = transforms.listed(ViewFiles(folder / "transforms.json")).whole()
    elif folder.is_dir() and colmap.model_folder(folder) is not None:
        frames = colmap.listed(ViewFiles(folder)).whole()
    else:
        return {}
    names = [(frame.photo or Path(frame.name)).name for frame in frames]
    if len(set(names)) < len(names):
        text = "several photos have the same name, so their intrinsics are ambiguous"
        raise InputError(text, path=folder)
    return {name: frame.lens for name, frame in zip(names, frames, strict=True)}
