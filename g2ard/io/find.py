"""Search for the cameras that trainers leave beside a scene."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from g2ard.errors import InputError


def find_views(scene: str | Path) -> Path | None:
    """Return the cameras that a scene was trained with, for `read_view_set`, or None.

    Searched in this order:

    - cameras.json (INRIA) in the scene's folder, or in the model's folder above point_cloud/iteration_N/;
    - nerfstudio's dataparser_transforms.json, then the lists of `ns-export cameras`, in the scene's folder;
    - cfg.yml (gsplat's simple_trainer) above ply/.

    A transforms.json or COLMAP model beside a scene is ignored, since trainers may move the world they read.

    Args:
        scene: a scene's file or folder; it need not exist.
    """
    from g2ard.io import gsplat_run, inria, nerfstudio, nerfstudio_export

    scene = Path(scene)
    own = (scene if scene.is_dir() else scene.parent).absolute()
    iteration = re.fullmatch(r"iteration_\d+", own.name) and own.parent.name == "point_cloud"
    places = [own / inria.NAME, *([own.parent.parent / inria.NAME] if iteration else ())]
    found = next((file for file in places if _holds(file, inria.is_inria)), None)
    if found is None and (own / nerfstudio.NAME).is_file():
        found = own / nerfstudio.NAME
    if found is None and any(
        _holds(own / name, nerfstudio_export.is_export) for name in nerfstudio_export.LISTS
    ):
        found = own
    if found is None and own.name == "ply" and _is_run(own.parent / gsplat_run.NAME):
        found = own.parent / gsplat_run.NAME
    if found is None:  # a damaged file: its reader raises the error
        found = next((file for file in places if file.is_file()), None)
    return found if found is None or scene.is_absolute() else Path(os.path.relpath(found))


def _is_run(file: Path) -> bool:
    from g2ard.io.gsplat_run import is_run

    try:
        return is_run(file)
    except InputError:
        return False


def _holds(file: Path, test: Callable[[Any], bool]) -> bool:
    """Return whether a JSON file exists and passes `test`."""
    from g2ard.io.jsonfile import read_any_json

    try:
        return file.is_file() and test(read_any_json(file))
    except InputError:
        return False
