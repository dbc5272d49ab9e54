"""Writers of scenes by suffix, in any case, or by meta.json for a SOG folder."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from g2ard.config.choices import FormatName
from g2ard.errors import OutputError


class SceneFormat(NamedTuple):
    """A format to write scenes in.

    Args:
        suffix: suffix of its files.
        module: its module in `g2ard.io`.
        function: the writer in the module, `fn(path, splats, *, overwrite, **options)`.
        options: names of its options.
    """

    suffix: str
    module: str
    function: str = "write"
    options: tuple[str, ...] = ()


FORMATS: dict[FormatName, SceneFormat] = {
    "compressed.ply": SceneFormat(".compressed.ply", "compressed_ply"),
    "ply": SceneFormat(".ply", "ply", options=("normals",)),
    "sog": SceneFormat(".sog", "sog_write"),
    "spz": SceneFormat(".spz", "spz", options=("spz_version",)),
    "glb": SceneFormat(".glb", "glb", options=("compress",)),
    "splat": SceneFormat(".splat", "splat"),
    "usda": SceneFormat(".usda", "usd"),
    "usdc": SceneFormat(".usdc", "usd"),
}
"""Formats by name, longer suffixes first."""

_FOLDER = SceneFormat("meta.json", "sog_write", "write_folder")


def scene_format(path: str | Path) -> SceneFormat:
    """Return the format of an output path, or raise an `OutputError` if it is unsupported.

    >>> scene_format("a.COMPRESSED.PLY").module, scene_format("room/meta.json").function
    ('compressed_ply', 'write_folder')
    """
    name = Path(path).name.lower()
    if name == "meta.json":
        return _FOLDER
    for found in FORMATS.values():
        if name.endswith(found.suffix):
            return found
    known = ", ".join(f.suffix for f in FORMATS.values())
    raise OutputError(f"scenes are written as {known}, or as a SOG folder (NAME/meta.json)", path=path)


def check_options(path: str | Path, options: dict[str, object]) -> SceneFormat:
    """Return the format of an output path, or raise an `OutputError` if it lacks one of the options."""
    found = scene_format(path)
    for name in options:
        if name not in found.options:
            raise OutputError(f"{found.suffix} has no option {name!r}", path=path)
    return found
