"""Writing streamed SOG (PlayCanvas): levels of detail as SOG files that hold the leaves of one tree in a row.

`lod-meta.json`, version 1: a node has a `bound` and two `children`, or, a leaf, `lods`: of each level that
has Gaussians there the file, the offset of the first of its rows and their count; and `errors` of all levels.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from g2ard.levels.error import leaf_errors
from g2ard.levels.tree import Cut, Leaf, Node
from g2ard.levels.tree import cut as cut_tree
from g2ard.progress import Progress, silent

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from g2ard.splats import Splats

__all__ = ["save_levels"]


def save_levels(
    path: str | Path,
    levels: Sequence[Splats],
    *,
    cut: Cut | None = None,
    errors: bool = True,
    overwrite: bool = False,
    progress: Progress = silent,
) -> int:
    """Write levels of detail as a folder of streamed SOG, `lod-meta.json` and `LEVEL_N/meta.json`.

    Args:
        path: the folder.
        levels: the same scene, the finest first, of one offset.
        cut: how the tree is cut; None means `Cut()`.
        errors: measure what each leaf's levels lose (`g2ard.levels.leaf_errors`), which tells viewers what to
            load; without them they go by counts.
        overwrite: whether files in the folder may be replaced.
        progress: told of leaves measured and files written.

    Returns:
        Bytes written.

    Raises:
        InputError: no level, one that is empty or not finite, or offsets that differ.
        OutputError: see `atomic_folder`.
    """
    from g2ard import __version__
    from g2ard.io.atomic import atomic_folder

    rule = cut or Cut()
    tree = cut_tree(levels, rule)
    files = _Files(levels, rule.most, {})
    root = _node(tree, files)
    if errors:
        _measure(tree, root, levels, progress)
    counts = [len(level) for level in levels]
    meta: dict[str, Any] = {
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
        "lodErrors": errors,
        "filenames": list(files.parts),
        "tree": root,
    }
    with atomic_folder(path, overwrite) as folder:
        files.write(folder, Path(path), progress)
        (folder / "lod-meta.json").write_text(json.dumps(meta, separators=(",", ":")))
        return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())


@dataclass
class _Files:
    """What goes where: a level's leaves fill a file until it holds more than `most`."""

    levels: Sequence[Splats]
    most: int
    parts: dict[str, list[NDArray[np.int64]]]
    level_of: dict[str, int] = field(default_factory=dict)
    last: dict[int, tuple[str, int]] = field(default_factory=dict)

    def place(self, level: int, rows: NDArray[np.int64]) -> dict[str, int]:
        """The file, offset and count of a leaf's rows."""
        name, filled = self.last.get(level, ("", self.most + 1))
        if filled > self.most:
            name, filled = f"{level}_{sum(of == level for of in self.level_of.values())}/meta.json", 0
            self.parts[name], self.level_of[name] = [], level
        self.parts[name].append(rows)
        self.last[level] = name, filled + len(rows)
        return {"file": list(self.parts).index(name), "offset": filled, "count": len(rows)}

    def write(self, folder: Path, path: Path, progress: Progress) -> None:
        """All files; the rows of each leaf in Morton order."""
        import numpy as np

        from g2ard.io.packing import morton_order, writable
        from g2ard.io.sog_write import sog_files

        for number, (name, leaves) in enumerate(self.parts.items(), start=1):
            level = writable(path / name, self.levels[self.level_of[name]])
            rows = np.concatenate([rows[morton_order(level.means[rows])] for rows in leaves])
            (folder / name).parent.mkdir()
            for file, content in sog_files(path / name, level.take(rows), ordered=True).items():
                (folder / name).with_name(file).write_bytes(content)
            progress("write", number, len(self.parts))


def _node(tree: Node | Leaf, files: _Files) -> dict[str, Any]:
    node: dict[str, Any] = {"bound": {"min": _rounded(tree.low), "max": _rounded(tree.high)}}
    if isinstance(tree, Leaf):
        placed = {str(level): files.place(level, rows) for level, rows in enumerate(tree.rows) if len(rows)}
        return {**node, "lods": placed}
    return {**node, "children": [_node(child, files) for child in tree.children]}


def _measure(tree: Node | Leaf, root: dict[str, Any], levels: Sequence[Splats], progress: Progress) -> None:
    """Put `errors` into the leaves of the tree as it is written."""
    pairs = [(tree, root)]
    leaves: list[tuple[Leaf, dict[str, Any]]] = []
    while pairs:
        part, node = pairs.pop()
        if isinstance(part, Leaf):
            leaves.append((part, node))
        else:
            pairs.extend(zip(part.children, node["children"], strict=True))
    for number, (leaf, node) in enumerate(leaves, start=1):
        node["errors"] = _rounded(leaf_errors(leaf, levels))
        progress("measure", number, len(leaves))


def _rounded(values: Sequence[float] | NDArray[np.float64]) -> list[float]:
    """Seven digits, those of a float32."""
    return [float(f"{float(value):.7g}") for value in values]
