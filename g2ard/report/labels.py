"""Names and sizes of scenes, as pages, tables and messages show them."""

import os
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from g2ard.io.source import Source
from g2ard.progress import plural

TARGET = "target"
"""Word for what renders are compared with."""

DENSE = "dense scene"
"""Words for what is distilled."""

RESULT = "result"
"""Word for what comes of it."""

_GENERIC = re.compile(
    r"(scene|points?(_?cloud|3d)?|cloud|splats?|gaussians?|model|output|result|simplified|(lod-)?meta|tileset|"
    r"iteration_\d+|[\d_.-]+)",
    re.IGNORECASE,
)
"""File and folder names that do not say which scene it is."""


def name_scenes(paths: Sequence[Path]) -> list[str]:
    """Return names of files or folders, with as many of their folders as tell which scene each one is.

    >>> [name_scenes([Path(one)]) for one in ("garden.ply", "park/0_0", "run/scene.sog")]
    [['garden.ply'], ['park/0_0'], ['run/scene.sog']]
    >>> name_scenes([Path("a/small.ply"), Path("b/small.ply")])
    ['a/small.ply', 'b/small.ply']
    """
    rows = [Path(os.path.abspath(path)).parts for path in paths]
    depths = {row: _find_depth(row) for row in rows}
    while True:
        names = {row: "/".join(row[-depth:]) for row, depth in depths.items()}
        times = Counter(names.values())
        alike = [row for row in depths if times[names[row]] > 1 and depths[row] < len(row)]
        if not alike:
            return [names[row] for row in rows]
        for row in alike:
            depths[row] += 1


def _find_depth(parts: tuple[str, ...]) -> int:
    """Return how many parts of a path, from the last one, hold a name that is not generic."""
    last = max(1, len(parts) - 1)
    told = (
        depth for depth in range(1, last) if not _GENERIC.fullmatch(parts[-depth].split(".")[0])
    )
    return next(told, last)


def count_content(count: int, scene: Source | str) -> str:
    """Return a number of points, if the scene is the file of a point cloud, otherwise of Gaussians."""
    return plural(
        count, "point" if isinstance(scene, Source) and scene.kind == "points" else "Gaussian"
    )


def label_scenes(
    scenes: Sequence[Source | str], counts: Sequence[int], roles: Sequence[str] = ()
) -> list[str]:
    """Return a label for each scene: its role if there are roles, its name and its size.

    Args:
        scenes: files, or names of scenes without one.

    >>> label_scenes(["small", "dense"], [1, 2000])
    ['small: 1 Gaussian', 'dense: 2,000 Gaussians']
    >>> label_scenes(["garden"], [2000], [DENSE])
    ['dense scene: garden, 2,000 Gaussians']
    """
    names = iter(name_scenes([scene.path for scene in scenes if isinstance(scene, Source)]))
    labels = []
    for scene, count in zip(scenes, counts, strict=True):
        name = next(names) if isinstance(scene, Source) else scene
        labels.append((name, count_content(count, scene)))
    if not roles:
        return [f"{name}: {size}" for name, size in labels]
    return [f"{role}: {name}, {size}" for role, (name, size) in zip(roles, labels, strict=True)]
