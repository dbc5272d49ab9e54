"""Reader for result folders of gsplat's simple_trainer.py, whose cfg.yml names the COLMAP data."""

from pathlib import Path

import g2ard.io.colmap as colmap
from g2ard.errors import InputError
from g2ard.io.frames import Listed
from g2ard.io.trainer_yaml import below, read_settings
from g2ard.io.types import ViewFiles

NAME = "cfg.yml"


def holds(folder: Path) -> bool:
    """Return whether a folder has the settings of such a run."""
    file = folder / NAME
    return file.is_file() and read_settings(file).word("data_dir") is not None


def data_of(path: Path) -> Path | None:
    """Return the folder of a run's data, or None if it does not exist."""
    file = ViewFiles(path).file(NAME)
    named = read_settings(file).path("data_dir")
    if named is None:
        return None
    return below(file, named)


def read(views: ViewFiles) -> Listed:
    """Read a run's cameras with their splits: every `test_every`th in order of names is test.

    Only runs with `normalize_world_space: false` are supported. Others move the world by the points'
    principal axes, whose signs depend on the linear algebra library, and do not store the transform. Without
    `images`, photos are in the data's `images_N` for `data_factor` N, or `images`.
    """
    file = views.file(NAME)
    settings = read_settings(file)
    kind = settings.word("data_type")
    if kind not in (None, "colmap"):
        text = f"unsupported data_type {kind!r}; expected 'colmap'"
        raise InputError(text, path=file)
    if settings.word("normalize_world_space") != "false":
        raise InputError(
            "was trained in a normalised world, and the run does not store the transform",
            path=file,
            hint="train with --no-normalize-world-space, or give cameras in the scene's world",
        )
    named = settings.path("data_dir")
    data = data_of(file)
    if named is None or data is None:
        text = f"data_dir {named and named.as_posix()} does not exist"
        hint = "give its COLMAP folder as views, or correct data_dir"
        raise InputError(text, path=file, hint=hint)
    photos = views.images
    smaller = data / f"images_{settings.word('data_factor')}"
    if not photos and smaller.is_dir():
        photos = smaller
    try:
        found = colmap.listed(ViewFiles(data, photos))
        frames = found.whole()
    except InputError as error:
        raise InputError(f"data_dir: {error}", path=file) from error
    every = settings.word("test_every") or "8"
    if not every.isdigit() or int(every) < 1:
        text = f"is {every!r}, expected a whole number ≥ 1"
        raise InputError(text, path=file, property="test_every")
    frames = [frame._replace(split="train") for frame in frames]
    for i in range(0, len(frames), int(every)):
        frames[i] = frames[i]._replace(split="test")
    run = Listed(found.path, frames)
    if settings.word("pose_opt") != "true":
        return run
    text = "the run optimised its poses; these are the poses before training"
    return run.noted("optimised_poses", len(frames), text)
