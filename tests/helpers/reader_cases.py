"""A small valid file of every kind that g2ard reads, for fuzzing."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from g2ard.io import write_splats, write_views
from g2ard.tiles.ingest import ingest
from helpers.cloud_files import columns, las, ply
from helpers.dataset_files import llff, polycam
from helpers.packed_files import saved as packed
from helpers.packed_files import truth, unpacked_ksplat
from helpers.sog_files import folder as sog_folder
from helpers.sog_files import parts, zipped
from helpers.trainer_files import data_of, export, inria, result_of, run_of
from helpers.view_files import colmap, orbit, transforms, views


def ascii_cloud(path: Path) -> Path:
    lines = ["ply", "format ascii 1.0", "element vertex 3"]
    lines += [f"property float {a}" for a in "xyz"]
    lines += [f"property uchar {c}" for c in ("red", "green", "blue")]
    lines += ["end_header", "0 0 1 1 2 3", "1 0 0 4 5 6", "0 1 0 7 8 9"]
    path.write_text("\n".join(lines) + "\n")
    return path


def saved(path: Path, write: Callable[..., None], what: object) -> Path:
    write(path, what)
    return path


def table(folder: Path, name: str, text: bool = False) -> Path:
    return colmap(folder / "project", orbit(3), text) / "sparse" / "0" / name


def run_file(folder: Path, name: str) -> Path:
    """Return a file of a nerfstudio run, or its data."""
    data, run = data_of(folder), run_of(folder)
    return data if name == "transforms.json" else run / name


def poses_bounds(folder: Path) -> Path:
    llff(folder)
    return folder / "poses_bounds.npy"


def keyframe(folder: Path) -> Path:
    """Return the first camera of a Polycam capture."""
    polycam(folder / "capture")
    return min((folder / "capture" / "keyframes" / "corrected_cameras").iterdir())


def levels(folder: Path) -> Path:
    """Return the lod-meta.json of a folder of SOG chunks."""
    sog_folder(folder / "0_0", parts())
    tree = {"children": [{"lods": {"0": {"file": 0, "offset": 0, "count": 10}}}]}
    path = folder / "lod-meta.json"
    path.write_text(json.dumps({"lodLevels": 1, "filenames": ["0_0/meta.json"], "tree": tree}))
    return path


def exports(folder: Path) -> Path:
    data_of(folder)
    return export(folder / "exports", Path("data/poster/images"), "transforms_train.json", range(3))


def result(folder: Path) -> Path:
    colmap(folder / "data" / "garden", orbit(3), text=False)
    return result_of(folder)


def tiles(folder: Path) -> Path:
    """Return the manifest of a folder of tiles."""
    return (
        ingest(
            saved(folder / "a.ply", write_splats, truth(30, 1)), folder / "tiles", tile_rows=12
        ).folder
        / "tiles.json"
    )


MAKERS: dict[str, Callable[[Path], Path]] = {
    "scene": lambda f: saved(f / "a.ply", write_splats, truth(9, 1)),
    "compressed": lambda f: packed(f, "compressed.ply", truth(9, 1)),
    "spz 3": lambda f: packed(f, "spz", truth(9, 1), spz_version=3),
    "spz 4": lambda f: packed(f, "spz", truth(9, 1), spz_version=4),
    "splat": lambda f: saved(f / "a.splat", write_splats, truth(9, 0)),
    "ksplat": lambda f: unpacked_ksplat("level2-sh2", f),
    "sog": lambda f: zipped(f / "a.sog", parts()),
    "meta.json": lambda f: sog_folder(f, parts()) / "meta.json",
    "lod-meta.json": levels,
    "glb": lambda f: saved(f / "a.glb", write_splats, truth(9, 1)),
    "cloud": lambda f: ply(
        f / "a.ply", columns("f4", "u1"), np.arange(36.0).reshape(6, 6), faces=3
    ),
    "ascii cloud": lambda f: ascii_cloud(f / "a.ply"),
    "las": lambda f: las(f / "a.las", np.arange(30.0).reshape(10, 3), np.ones((10, 3), int)),
    "laz": lambda f: las(f / "a.laz", np.arange(30.0).reshape(10, 3), np.ones((10, 3), int)),
    "cameras.bin": lambda f: table(f, "cameras.bin"),
    "images.bin": lambda f: table(f, "images.bin"),
    "points3D.bin": lambda f: table(f, "points3D.bin"),
    "cameras.txt": lambda f: table(f, "cameras.txt", text=True),
    "images.txt": lambda f: table(f, "images.txt", text=True),
    "points3D.txt": lambda f: table(f, "points3D.txt", text=True),
    "poses_bounds.npy": poses_bounds,
    "Polycam": keyframe,
    "transforms": lambda f: transforms(f / "a.json", orbit(2)),
    "cameras.json": lambda f: inria(f / "cameras.json", orbit(3)),
    "dataparser_transforms.json": lambda f: run_file(f, "dataparser_transforms.json"),
    "config.yml": lambda f: run_file(f, "config.yml"),
    "transforms of a run": lambda f: run_file(f, "transforms.json"),
    "ns-export": exports,
    "cfg.yml": result,
    "views": lambda f: saved(f / "a.json", write_views, views(2)),
    "tiles": tiles,
}


READ = {
    "transforms of a run": "outputs/poster/splatfacto/today",
    "Polycam": "capture",
    "tiles": "tiles",
}
"""The path to read instead of the damaged file, in the test's folder."""
