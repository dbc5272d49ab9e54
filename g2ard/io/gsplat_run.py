"""The result folder of gsplat's examples/simple_trainer.py: cfg.yml names the COLMAP data it trained on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from g2ard.errors import InputError
from g2ard.io import colmap
from g2ard.io.photos import view_set
from g2ard.io.settings import below, read_settings
from g2ard.io.types import Note, ViewSet

NAME = "cfg.yml"


def is_run(path: Path) -> bool:
    """Whether a file is the settings of such a run."""
    return path.is_file() and path.name == NAME and read_settings(path).word("data_dir") is not None


def read(path: Path, images: Path | None = None) -> ViewSet:
    """Read the cameras a run was trained and tested on, each with its split: of the names in order, every
    `test_every`th from the first on is test.

    Only runs with `normalize_world_space: false` can be followed: the others turn, centre and scale the
    world by the points' principal axes, whose signs depend on the linear algebra at hand, and store nothing.

    Args:
        path: cfg.yml or its folder.
        images: the folder of the photos; None takes the data's `images_N` for `data_factor` N, else `images`.

    Raises:
        InputError: the world was normalised, or the data is no COLMAP model or not there.
    """
    file = path / NAME if path.is_dir() else path
    settings = read_settings(file)
    if settings.word("data_type") not in (None, "colmap"):
        raise InputError(
            f"data of type {settings.word('data_type')!r} are not supported (colmap is)", path=file
        )
    if settings.word("normalize_world_space") != "false":
        raise InputError(
            "trained in a normalised world, and the run does not say how it was moved there "
            "(train with --no-normalize-world-space, or give cameras of the scene's own world)",
            path=file,
        )
    named = settings.path("data_dir")
    data = below(file, named) if named is not None else None
    if named is None or data is None:
        raise InputError(f"its data_dir {named and named.as_posix()} is not there", path=file)
    smaller = data / f"images_{settings.word('data_factor')}"
    photos = images or (smaller if smaller.is_dir() else None)
    try:
        model, frames = colmap.frames(data, photos)
    except InputError as error:
        raise InputError(f"its data_dir: {error}", path=file) from error
    every = _whole(file, "test_every", settings.word("test_every") or "8")
    words = ["train" if i % every else "test" for i in range(len(frames))]
    found = view_set(model, [f._replace(split=word) for f, word in zip(frames, words, strict=True)])
    if settings.word("pose_opt") != "true":
        return found
    text = "the run optimised its poses, and these are as they were before"
    return replace(found, notes=(*found.notes, Note("optimised_poses", len(found.cameras), text)))


def _whole(path: Path, key: str, text: str) -> int:
    if not text.isdigit() or int(text) < 1:
        raise InputError(f"{key!r} is {text!r}, not a whole number ≥ 1", path=path)
    return int(text)
