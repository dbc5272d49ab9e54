"""Reader for `ns-export cameras` of nerfstudio: transforms_train.json and transforms_eval.json."""

from pathlib import Path
from typing import Any

from g2ard.errors import InputError
from g2ard.io import colmap, transforms
from g2ard.io.jsonfile import Fields, fields_of, matrix, read_any_json, read_json_list, text
from g2ard.io.photos import Frame, Lens, photo_size, rigid, view_set
from g2ard.io.settings import below
from g2ard.io.types import ViewSet

LISTS = {"transforms_train.json": "train", "transforms_eval.json": "test"}
"""File → its split."""


def is_export(content: Any) -> bool:
    """Return whether JSON content is such a list."""
    first = content[0] if isinstance(content, list) and content else None
    return isinstance(first, dict) and {"file_path", "transform"} <= set(first)


def exported(folder: Path) -> list[Path]:
    lists = [folder / name for name in LISTS if (folder / name).is_file()]
    return [file for file in lists if is_export(read_any_json(file))]


def read(path: Path, images: Path | None = None) -> ViewSet:
    """Read exported poses, {file_path, transform}: world_from_camera, 3×4, OpenGL axes, in the scene's world.

    `path` is one of the lists, or the folder of both. Intrinsics come from a transforms.json or a COLMAP
    model above the photos, scaled to the photos' size.
    """
    files = exported(path) if path.is_dir() else [path]
    lenses: dict[Path, dict[str, Lens]] = {}
    frames = []
    for file in files:
        for i, entry in enumerate(read_json_list(file)):
            frames.append(_frame(file, i, entry, images, lenses))
    return view_set(path, frames)


def _frame(
    path: Path, index: int, entry: Any, images: Path | None, lenses: dict[Path, dict[str, Lens]]
) -> Frame:
    camera = fields_of(path, entry, index, "camera")
    file_path = Path(text(camera, "file_path"))
    world_from_camera = rigid(matrix(camera, "transform"), camera.place.to("transform"))
    there = below(path, file_path)
    ups = (below(path, up) for up in file_path.parents[:3] if up.parts)
    lens = _lens(camera, file_path, there or next(filter(None, ups), None), lenses)
    photo = images / file_path.name if images else there
    if photo is not None and photo.is_file():
        lens = lens.at(photo_size(photo, path))
    return Frame(
        name=file_path.name,
        viewmat=transforms.opencv_view(world_from_camera),
        lens=lens,
        photo=photo or file_path,
        split=LISTS.get(path.name),
    )


def _lens(camera: Fields, named: Path, place: Path | None, known: dict[Path, dict[str, Lens]]) -> Lens:
    """Return a photo's intrinsics by file name, from the nearest folder above it that has them."""
    for folder in () if place is None else (place, *place.parents[:3]):
        if folder not in known:
            known[folder] = _lenses(folder)
        if named.name in known[folder]:
            return known[folder][named.name]
    error = camera.place.error(
        f"has no intrinsics in a transforms.json or COLMAP model above {named.as_posix()}, "
        "and ns-export does not write them"
    )
    raise error.at(hint="give the run's folder with its dataparser_transforms.json")


def _lenses(folder: Path) -> dict[str, Lens]:
    if (folder / "transforms.json").is_file():
        frames = transforms.frames(folder / "transforms.json")
    elif folder.is_dir() and colmap.model_folder(folder) is not None:
        frames = colmap.frames(folder)[1]
    else:
        return {}
    names = [Path(frame.photo.name if frame.photo else frame.name).name for frame in frames]
    if len(set(names)) < len(names):
        raise InputError("several photos have the same name, so their intrinsics are ambiguous", path=folder)
    return {name: frame.lens for name, frame in zip(names, frames, strict=True)}
