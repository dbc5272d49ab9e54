"""Writer for streamed SOG (PlayCanvas): levels of detail as SOG files of consecutive leaves.

`lod-meta.json`, version 1: a node has a `bound` and two `children`. A leaf has `lods` instead: for each level
with Gaussians there, the file, the offset of its first row and the count.
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from g2ard._core import __version__
from g2ard.arrays import Float, Int
from g2ard.config.checks import checks_arguments
from g2ard.errors import InputError
from g2ard.io.atomic import atomic_folder, drop_empty, drop_temporaries
from g2ard.io.jsonfile import read_json
from g2ard.io.packing import packing_order
from g2ard.io.paths import naming
from g2ard.io.scene_formats import Rounding
from g2ard.io.scenes import tell
from g2ard.io.sog_write import largest_rounding, sog_files
from g2ard.levels.tree import Cut, Level, Node, aligned
from g2ard.levels.tree import cut as cut_tree
from g2ard.progress import Progress, Say, silent
from g2ard.scene.splats import Splats
from g2ard.scene.transform import change_of_axes

_ENVIRONMENT_META = "env/meta.json"

_CHUNK_META = re.compile(r"(\d+_\d+|env)/meta\.json")  # names of a level's files

_CHUNK_IMAGE = re.compile(r"\w+\.webp")  # names of the images in them


@checks_arguments
def save_levels(
    path: str | Path,
    levels: Sequence[Level],
    *,
    cut: Cut | None = None,
    environment: Splats | None = None,
    overwrite: bool = False,
    work: Path | None = None,
    progress: Progress = silent,
    say: Say | None = None,
) -> int:
    """Write levels of detail as a streamed SOG folder: `lod-meta.json` and `LEVEL_N/meta.json`.

    Args:
        path: the output folder.
        levels: the same scene at several levels, finest first, with equal offsets. A `TileStore` is read
            one leaf or file at a time.
        cut: splitting rule of the tree; None means `Cut()`.
        environment: sky and far background, which viewers always show; written to `env/meta.json`.
        overwrite: replace files in the folder, and remove files of its previous `lod-meta.json`.
        work: folder for intermediate results; the same call on the same levels resumes from it and uses less
            memory.
        progress: called for leaves measured and files written.
        say: called with a note if positions are rounded by as much as `g2ard.save` would warn of; None warns.

    Returns:
        Bytes written.

    Raises:
        InputError: no levels, a level that is empty or not finite, or different offsets.
        OutputError: the folder exists and may not be replaced, or cannot be written.

    >>> import tempfile
    >>> grid = np.stack(np.meshgrid(range(8), range(8), [0]), -1).reshape(-1, 3)
    >>> fine = Splats.create(grid, scales=np.ones((64, 3)))
    >>> folder = Path(tempfile.mkdtemp()) / "streamed"
    >>> size = save_levels(folder, [fine, fine.take(range(0, 64, 4))])
    >>> (folder / "lod-meta.json").is_file()
    True
    """
    rule = cut or Cut()
    path = Path(path)
    levels, error, moved = aligned(levels)
    if environment is not None:
        environment = environment.narrowed(levels[0].offset)
    tree = cut_tree(levels, rule, work)
    files = _Files(
        levels,
        rule.most,
        {},
        Rounding(moved),
        error,
    )
    root = _describe_node(tree, files)
    meta = _describe_levels(levels, rule)
    if environment is not None:
        meta["environment"] = _ENVIRONMENT_META
    meta["filenames"] = list(files.parts)
    meta["tree"] = root
    if work is not None:
        drop_temporaries(work)
        drop_temporaries(path.parent, path.name)
        files.write(work, path, progress)
    with replaced(path, overwrite, _list_named(path)) as (folder, written):
        if work is None:
            files.write(folder, path, progress)
        else:
            for name in files.parts:  # linked, not moved: an interrupted call resumes from them
                shutil.copytree(
                    (work / name).parent,
                    (folder / name).parent,
                    copy_function=_link,
                )
        if environment is not None:
            with naming(path / _ENVIRONMENT_META):
                _write_part(folder / _ENVIRONMENT_META, sog_files(environment))
            files.rounding.add(largest_rounding(environment), environment)
        write_json(folder / "lod-meta.json", meta)
    if work is not None:
        for name in files.parts:
            shutil.rmtree((work / name).parent, ignore_errors=True)
    tell(path, files.rounding.notes, say)
    return sum(written.values())


def _describe_levels(levels: Sequence[Level], rule: Cut) -> dict[str, Any]:
    counts = [len(level) for level in levels]
    return {
        "version": 1,
        "asset": {
            "generator": f"g2ard {__version__}",
            "chunkGaussians": rule.most,
            "chunkExtent": rule.extent,
            "chunkMinGaussians": rule.least,
        },
        "count": sum(counts),
        "counts": counts,
        "lodLevels": len(levels),
    }


def _write_part(meta: Path, files: dict[str, bytes]) -> None:
    """Write the files of a SOG folder, of which `meta` is the meta.json, atomically.

    Files that a killed call left there without their meta.json are replaced.
    """
    with atomic_folder(meta.parent, overwrite=True) as begun:
        for name, content in files.items():
            (begun / name).write_bytes(content)


def _link(source: str, target: str) -> None:
    """Hard-link a file, or copy it across file systems."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


@dataclass
class _Files:
    """Assignment of leaves to files: a level's leaves fill a file until it holds more than `most` rows.

    Positions are rounded in the files, and before by up to `error`.
    """

    levels: Sequence[Level]
    most: int
    parts: dict[str, list[Int]]
    rounding: Rounding
    error: float
    level_of: dict[str, int] = field(default_factory=dict)
    last: dict[int, tuple[str, int]] = field(default_factory=dict)

    def place(self, level: int, rows: Int) -> dict[str, int]:
        """Append a leaf's rows and return their file, offset and count."""
        name, filled = self.last.get(level, ("", self.most + 1))
        if filled > self.most:
            number = list(self.level_of.values()).count(level)
            name = f"{level}_{number}/meta.json"
            filled = 0
            self.parts[name] = []
            self.level_of[name] = level
        self.parts[name].append(rows)
        self.last[level] = name, filled + len(rows)
        return {
            "file": list(self.parts).index(name),
            "offset": filled,
            "count": len(rows),
        }

    def write(self, folder: Path, path: Path, progress: Progress) -> None:
        """Write all missing files, each atomically; `path` names them in messages."""
        for number, name in enumerate(self.parts, start=1):
            rows = self._rows(name)
            self.rounding.add(self.error + largest_rounding(rows), rows)
            if not (folder / name).exists():
                with naming(path / name):
                    _write_part(folder / name, sog_files(rows, ordered=True))
            progress("write", number, len(self.parts))

    def _rows(self, name: str) -> Splats:
        """Return the rows of a file, each leaf's in Morton order."""
        leaves = self.parts[name]
        level = self.levels[self.level_of[name]]
        splats = level.take(np.concatenate(leaves))
        starts = np.cumsum([0, *map(len, leaves)])
        order = []
        for begin, end in pairwise(starts):
            means = splats.means[begin:end]
            order.append(begin + packing_order(means))
        return splats.take(np.concatenate(order))


def _describe_node(tree: Node, files: _Files) -> dict[str, Any]:
    turn = change_of_axes(files.levels[0].axes, "RDF")
    ends = np.array([tree.low, tree.high]) @ turn.T
    node: dict[str, Any] = {
        "bound": {
            "min": _round(ends.min(axis=0)),
            "max": _round(ends.max(axis=0)),
        }
    }
    if tree.children:
        node["children"] = [_describe_node(child, files) for child in tree.children]
        return node
    node["lods"] = {}
    for level, rows in enumerate(tree.rows):
        if len(rows):
            node["lods"][f"{level}"] = files.place(level, rows)
    return node


def _round(values: Sequence[float] | Float) -> list[float]:
    """Round to seven digits, the precision of float32."""
    return [float(f"{float(value):.7g}") for value in values]


def _list_named(path: Path) -> set[Path]:
    """Return the relative paths of all level files that the folder's `lod-meta.json` names."""
    named = set()
    meta = read_object(path / "lod-meta.json")
    parts = _filter_names(meta, "filenames", _CHUNK_META)
    parts += _filter_names(meta, "environment", _CHUNK_META)
    for part in map(Path, parts):
        named.add(part)
        for entry in read_object(path / part).values():
            if isinstance(entry, dict):
                images = _filter_names(entry, "files", _CHUNK_IMAGE)
                named.update(map(part.with_name, images))
    return named


@contextmanager
def replaced(
    path: Path,
    overwrite: bool,
    before: set[Path],
) -> Iterator[tuple[Path, dict[Path, int]]]:
    """Write a folder atomically, and remove those of the files `before` that it does not have.

    Yield the new folder, and a dict that gets the bytes of its files at the end.
    """
    written: dict[Path, int] = {}
    with atomic_folder(path, overwrite) as folder:
        yield folder, written
        for file in folder.rglob("*"):
            if file.is_file():
                written[file.relative_to(folder)] = file.stat().st_size
    stale = [path / file for file in before - written.keys()]
    for file in stale:
        file.unlink(missing_ok=True)
    drop_empty(list({file.parent for file in stale}))


def _filter_names(
    content: dict[str, Any],
    key: str,
    pattern: re.Pattern[str],
) -> list[str]:
    names = content.get(key)
    if not isinstance(names, list):
        names = [names]
    return list(filter(pattern.fullmatch, map(str, names)))


def read_object(file: Path) -> dict[str, Any]:
    """Return a file's JSON object, or {} if the file is missing or holds something else."""
    try:
        return read_json(file)
    except InputError:
        return {}


def write_json(file: Path, content: dict[str, Any]) -> None:
    """Write JSON without spaces."""
    file.write_text(json.dumps(content, separators=(",", ":")), encoding="utf-8", newline="\n")
