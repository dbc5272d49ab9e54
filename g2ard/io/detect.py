"""Format detection by extension, then by content; cameras beside a scene."""

import os
import re
from collections.abc import Iterator
from contextlib import suppress
from difflib import get_close_matches
from functools import lru_cache
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Any, Literal

from g2ard.config.choices import BLACK, Colour
from g2ard.errors import InputError
from g2ard.io.finding import usable
from g2ard.io.paths import AnyPath, about, check_regular, naming
from g2ard.io.signs import MESH, Sign, foreign, sign_of

Kind = Literal["splats", "points", "views"]

READERS: dict[Kind, dict[str, tuple[str, ...]]] = {
    "splats": {
        "ply": (".ply",),
        "compressed_ply": (".compressed.ply",),
        "sog": (".sog", "meta.json", "lod-meta.json"),
        "spz": (".spz",),
        "glb": (".glb", ".gltf"),
        "splat": (".splat",),
        "ksplat": (".ksplat",),
        "usd": (".usda", ".usdc", ".usd", ".usdz"),
        "tiles": (),
    },
    "points": {
        "cloud_ply": (".ply",),
        "las": (".las", ".laz"),
        "e57": (".e57",),
        "points3d": ("points3d.bin", "points3d.txt"),
        "cloud_text": (".pcd", ".xyz", ".xyzrgb", ".xyzn", ".xyzi", ".pts", ".asc", ".neu"),
        "clouds": (),
    },
    "views": {
        "views": (),
        "nerfstudio": ("config.yml",),
        "colmap": ("cameras.bin", "cameras.txt", "images.bin", "images.txt"),
        "nerfstudio_export": (),
        "transforms": (),
        "llff": ("poses_bounds.npy",),
        "polycam": (),
        "inria": (),
        "gsplat_run": ("cfg.yml",),
    },
}
"""Formats of each kind, which are names of modules, and suffixes or names of their files."""

MODULES = {"tiles": "tile_store", "views": "g2ard_views"}
"""Modules that have another name than the format they read."""

_FOLDERS: dict[str, tuple[str, ...] | None] = {
    "nerfstudio": ("dataparser_transforms.json",),  # before its data, which are in another world
    "colmap": None,
    "nerfstudio_export": None,
    "transforms": (
        "transforms.json",
        "transforms_train.json",
        "transforms_val.json",
        "transforms_test.json",
    ),
    "llff": ("poses_bounds.npy",),
    "polycam": None,
    "inria": ("cameras.json",),
    "gsplat_run": None,
}
"""Formats of folders of views in the order of preference, and files of which one says so.

None asks the module (`holds`).
"""

_JSON: dict[str, tuple[type, set[str]]] = {
    "transforms": (dict, {"frames"}),
    "views": (dict, {"views"}),
    "nerfstudio": (dict, {"transform", "scale"}),
    "nerfstudio_export": (list, {"file_path", "transform"}),
    "inria": (list, {"position", "rotation"}),
}
"""Formats of .json files of views: an object with these keys, or a list of such objects."""

KINDS: dict[str, Kind] = {name: kind for kind, formats in READERS.items() for name in formats}
_BY_NAME = {
    end: name for formats in READERS.values() for name, ends in formats.items() for end in ends
}

_NAMES: dict[Kind, str] = {
    "splats": "a Gaussian scene",
    "points": "a coloured point cloud",
    "views": "views (a COLMAP folder, transforms.json, g2ard's .json)",
}
_OTHER_KINDS: dict[tuple[Kind, Kind], str] = {
    ("splats", "points"): "`g2ard lift` turns it into a scene",
    ("splats", "views"): "give the scene's file",
    ("points", "splats"): "run `simplify` or `distill` on it",
    ("points", "views"): "give the point cloud's file",
}
"""Hints by the expected and the found kind of a file."""

MANIFEST = "tiles.json"
"""File of a finished folder of tiles."""

PARTS = ".parts"
"""Folder of the steps of an unfinished one."""

_CLOUDS = (*READERS["points"]["las"], *READERS["points"]["e57"], ".pcd", ".ply")
"""Suffixes of files that a folder of clouds may hold."""

_BESIDE = (".lax", ".lasx", ".copc", ".prj", ".wkt", ".xml", ".txt", ".md", ".pdf", ".json")
"""Suffixes of files that surveys keep beside their clouds."""

_MOST_INSPECTED_FILES = 64  # maximum files of a folder to inspect for suggestions
# maximum files of a folder and those below to look for signs of other programs
_MOST_SEARCHED_FILES = 256


def suffixes(kind: Kind) -> str:
    """Return the suffixes of files of a kind, as messages list them.

    >>> suffixes("splats")[:28]
    '.ply, .compressed.ply, .sog,'
    """
    ends = (
        end for format_ends in READERS[kind].values() for end in format_ends if end.startswith(".")
    )
    return ", ".join(ends)


def kind(path: AnyPath) -> Kind:
    """Return the kind of a file or folder: "splats", "points" or "views".

    A COLMAP folder is "views", although `read_points` reads its sparse points too.
    """
    return KINDS[file_format(path)]


def may_hold_views(path: Path) -> bool:
    """Return whether a file's name is not one of scenes or point clouds."""
    named = _BY_NAME.get(path.name.lower()) or _BY_NAME.get(path.suffix.lower())
    return named is None or KINDS[named] == "views"


def file_format(path: AnyPath) -> str:
    """Return the format of a file or folder; raise an `InputError` if it is missing or unsupported."""
    path = run_scene(path)
    with naming(path):
        if path.is_dir():
            return _folder_format(path)
        if path.exists():
            check_regular(path)
            state = path.stat()
            return _of_file(path, state.st_mtime_ns, state.st_size)
        if path.is_symlink():
            raise InputError("is a broken link")
        if re.match(r"(https?|s3|gs):/", str(path)):
            raise InputError("g2ard reads local files; download it first")
        raise InputError(f"no such file or folder{_near(path)}")


def reader(path: Path, name: str, expected: Kind) -> Any:
    """Return the module that reads a file or folder of a format; reject one of another kind."""
    import g2ard.io.plyfiles as plyfiles

    found = KINDS[name]
    if expected == "points" and name == "colmap":
        name = "points3d"
    elif found != expected and (expected, name) != ("views", "e57"):
        if name in ("glb", "usd"):  # its error says what it holds instead of Gaussians
            with about(path):
                import_module(f"g2ard.io.{name}").read(path)
        if name == "cloud_ply" and plyfiles.is_mesh(plyfiles.read_header(path)):
            raise InputError("is a mesh", path=path, hint=MESH)
        if found != "views":
            what = _NAMES[found]
        else:
            what = name
        hint = _OTHER_KINDS.get((expected, found))
        raise InputError(f"expected {_NAMES[expected]}, found {what}", path=path, hint=hint)
    return import_module(f"g2ard.io.{MODULES.get(name, name)}")


@lru_cache(maxsize=64)
def _of_file(path: Path, modified: int, size: int) -> str:
    """Return the format of a file, looked into once until it is modified or has another size."""
    suffix = path.suffix.lower()
    _check_content(path)
    if path.name.lower() == "meta.json":
        _reject_gsplat(path.parent)
    if suffix == ".ply":
        return _ply_format(path)
    found = _BY_NAME.get(path.name.lower()) or _BY_NAME.get(suffix)
    if found:
        return found
    if suffix == ".json":
        return _json_format(path)
    reason = ""
    if suffix in (".txt", ".csv", ".tsv", ".dat", ""):
        from g2ard.io.cloud_text import check_points

        try:
            check_points(path)
            return "cloud_text"
        except InputError as error:
            reason = f", and no table of points: {error.message}"
    raise InputError(
        f"unknown format {path.suffix!r}{reason} (scenes: {suffixes('splats')}; point clouds: "
        f"{suffixes('points')}, .csv; views: a COLMAP folder, a .json, or a run)"
    )


def _check_content(path: Path) -> None:
    """Reject a file of another program, or of another format than its name says."""
    sign = sign_of(path)
    suffix = path.suffix.lower()
    if sign is None:
        return
    if not sign.reads:
        raise sign.error(path)
    if sign.reads == suffix:
        return
    named = _BY_NAME.get(suffix)
    fits = named in _PACKED and named == _BY_NAME.get(sign.reads)
    is_count = suffix == ".bin" and path.name.lower() in _BY_NAME  # COLMAP's first bytes are any
    if not fits and not is_count:
        hint = f"rename it to {path.stem}{sign.reads}"
        raise InputError(f"is {sign.what} in spite of its name", hint=hint)


# formats with suffixes of which each may hold what content tells as another of them
_PACKED = ("las", "usd")


def run_scene(path: AnyPath) -> Path:
    """Return the scene's file in the folder of a `distill` run, or `path` itself."""
    path = Path(path)
    if not (path / "report.json").is_file():
        return path
    from g2ard.io.scene_formats import SUFFIXES

    files = (path / f"scene{suffix}" for suffix in SUFFIXES)
    for file in files:
        if file.is_file():
            return file
    return path


def run_views(path: AnyPath) -> Path:
    """Return the generated views in the folder of a `distill` run, or `path` itself."""
    path = Path(path)
    made = path / "views.json"
    if run_scene(path) != path and made.is_file():
        return made
    return path


def run_background(path: AnyPath) -> Colour | None:
    """Return the background that a `distill` run in a folder was made with, or None."""
    from g2ard.io.jsonfile import Json, Place, Within1, checked, read_json

    if run_scene(path) == Path(path):
        return None
    report = Path(path) / "report.json"
    place = Place(report).to("settings")
    settings = checked(read_json(report).get("settings", {}), Json, place)
    background = settings.get("recover.background", BLACK)
    return checked(background, tuple[Within1, Within1, Within1], place.to("recover.background"))


def holds(name: str, folder: Path) -> bool:
    """Return whether a folder holds views of a format."""
    files = _FOLDERS[name]
    if files is None:
        return bool(import_module(f"g2ard.io.{name}").holds(folder))
    return any(usable(folder / file) and foreign(folder / file) is None for file in files)


def json_format(content: Any) -> str | None:
    """Return the format of views in JSON content, or None.

    >>> json_format({"views": []}), json_format({"views": {"train": 40}})
    ('views', None)
    """
    sample = content
    if isinstance(content, list):
        sample = next(iter(content), None)
    keys = set[str]()
    if isinstance(sample, dict):
        keys.update(sample)
        if "format" not in keys and not isinstance(sample.get("views"), list):
            keys.discard("views")  # a number of views, say
    for name, (own, needed) in _JSON.items():
        if isinstance(content, own) and needed <= keys:
            return name
    return None


def find_views(scene: AnyPath) -> Path | None:
    """Return the path of the cameras that a scene was trained with, for `read_view_set`, or None.

    Searched in this order:

    - cameras.json (INRIA) in the scene's folder, or in the model's folder above point_cloud/iteration_N/;
    - nerfstudio's dataparser_transforms.json, then the lists of `ns-export cameras`, in the scene's folder;
    - cfg.yml (gsplat's simple_trainer) above ply/.

    A transforms.json or COLMAP model beside a scene is ignored, since trainers may move the world they read.

    Args:
        scene: a scene's file or folder; it need not exist.

    Returns:
        A file, or a folder of lists; relative if `scene` is.
    """
    scene = Path(scene)
    own = scene.absolute()
    if not own.is_dir():
        own = own.parent
    found = next(_cameras_of(own), None)
    if found is None or scene.is_absolute():
        return found
    return Path(os.path.relpath(found))


def _cameras_of(own: Path) -> Iterator[Path]:
    """Yield the cameras of a scene in a folder, the best first."""
    import g2ard.io.gsplat_run as gsplat_run
    import g2ard.io.inria as inria
    import g2ard.io.nerfstudio as nerfstudio
    import g2ard.io.nerfstudio_export as nerfstudio_export

    iteration = re.fullmatch(r"iteration_\d+", own.name) and own.parent.name == "point_cloud"
    places = [own / inria.NAME]
    if iteration:
        places.append(own.parent.parent / inria.NAME)
    files = [file for file in places if file.is_file()]
    yield from (file for file in files if _format_in(file) == "inria")
    if (own / nerfstudio.NAME).is_file():
        yield own / nerfstudio.NAME
    if any(_format_in(own / name) == "nerfstudio_export" for name in nerfstudio_export.LISTS):
        yield own
    with suppress(InputError):  # a cfg.yml that cannot be read is some other program's
        if own.name == "ply" and gsplat_run.holds(own.parent):
            yield own.parent / gsplat_run.NAME
    yield from files  # without cameras it is damaged: its reader raises the error


def _format_in(file: Path) -> str | None:
    """Return the format of views in a JSON file, or None if it does not exist or cannot be read."""
    from g2ard.io.jsonfile import read_any_json

    with suppress(InputError):
        if not file.is_file():
            return None
        return json_format(read_any_json(file))
    return None


def _folder_format(path: Path) -> str:
    from g2ard.io.colmap import incomplete
    from g2ard.io.sog import chunks_of

    if (path / MANIFEST).is_file():
        return "tiles"
    chunks = chunks_of(path)
    if chunks:
        if chunks[0].is_dir():
            _reject_gsplat(chunks[0])
        return "sog"
    for name in _FOLDERS:
        if holds(name, path):
            return name
    if (path / "tileset.json").is_file():
        return file_format(path / "tileset.json")
    if any(path.glob("tile-*.f32")) or (path / PARTS).is_dir():
        raise InputError("has unfinished tiles", hint="run the same `g2ard ingest` again")
    error = incomplete(path)
    if error:
        raise error
    if _holds_clouds(path):
        return "clouds"
    raise InputError(_unsupported(path))


def clouds_in(folder: Path) -> list[Path]:
    """Return the clouds of a folder of clouds alone, by name; an empty list for another folder."""
    files = [file for file in sorted(folder.iterdir()) if not file.name.startswith(".")]
    clouds = [file for file in files if file.suffix.lower() in _CLOUDS]
    if any(file.suffix.lower() not in (*_CLOUDS, *_BESIDE) for file in files):
        return []
    return clouds


def _holds_clouds(folder: Path) -> bool:
    """Return whether a folder holds point clouds and nothing else; the first few are looked into."""
    clouds = clouds_in(folder)
    return bool(clouds) and all(kind(file) == "points" for file in islice(clouds, 4))


def _reject_gsplat(folder: Path) -> None:
    """Raise an error if a meta.json is that of gsplat's PNGs, which lists no files."""
    from g2ard.io.jsonfile import read_any_json

    content = read_any_json(folder / "meta.json")
    means = None
    if isinstance(content, dict):
        means = content.get("means")
    if isinstance(means, dict) and "shape" in means and "files" not in means:
        raise InputError(
            "holds PNG images of gsplat's compression, not SOG",
            path=folder,
            hint="export the scene as .ply with gsplat's `export_splats`",
        )


def _near(path: Path) -> str:
    """Suggest similar names in the parent folder, or say that it is missing."""
    if not path.parent.is_dir():
        return f", nor a folder {path.parent}"
    names = [file.name for file in path.parent.iterdir()]
    close = get_close_matches(path.name, names, 2)
    if not close:
        return ""
    meant = " or ".join(str(path.with_name(name)) for name in close)
    return f"; did you mean {meant}?"


_NO_FOLDER = "is not a supported folder"


def _unsupported(path: Path) -> str:
    """Say what a folder holds instead of one thing that can be read, and what to give."""
    from g2ard.io.colmap import models_below
    from g2ard.io.photo_headers import describe_unreadable

    held: dict[Kind, list[str]] = {
        "splats": [],
        "points": [],
        "views": [],
    }
    files = (
        file
        for file in sorted(path.iterdir())
        if file.suffix.lower() in (".json", *_BY_NAME) and file.is_file()
    )
    for file in islice(files, _MOST_INSPECTED_FILES):
        with suppress(InputError):
            held[kind(file)].append(file.name)
    words = {
        "splats": "a scene",
        "points": "a point cloud",
        "views": "views",
    }
    held_kinds = []
    for what, names in held.items():
        if names:
            held_kinds.append(f"{', '.join(names[:5])} ({words[what]})")
    if held_kinds:
        return f"{_NO_FOLDER}; give one of its files: {', '.join(held_kinds)}"
    runs = [folder.name for folder in sorted(path.iterdir()) if run_scene(folder) != folder]
    if runs:
        return f"{_NO_FOLDER}; give one of its runs: {', '.join(runs[:5])}"
    models = models_below(path)
    if models:
        return f"{_NO_FOLDER}; give {models[0]}, which has a COLMAP model"
    found = _foreign_in(path)
    if found:
        file, sign = found
        return f"{_NO_FOLDER}; {file.relative_to(path)} is {sign.what}: {sign.todo}"
    for place in (path / "images", path):
        photos = _photos_in(place)
        if not photos:
            continue
        poses = _poses_above(path)
        if poses is not None:
            return f"holds photos alone; give {poses}, which has their poses"
        first = ""
        formats = map(describe_unreadable, photos[:_MOST_INSPECTED_FILES])
        unread = next(filter(None, formats), None)
        if unread:
            first = f"convert its {unread} photos to JPEG, then "
        return (
            f"holds photos without poses: {first}estimate them with `colmap automatic_reconstructor "
            f"--workspace_path project --image_path {place}` and give project"
        )
    return (
        f"{_NO_FOLDER} (looked for SOG's meta.json, `ingest`'s tiles.json, a COLMAP sparse/0, "
        "transforms.json, cameras.json, LLFF's poses_bounds.npy, Polycam's keyframes, nerfstudio's and "
        "gsplat's runs)"
    )


def _foreign_in(path: Path) -> tuple[Path, Sign] | None:
    """Return a file of another program in a folder or up to two levels below, poses first."""
    from g2ard.io.finding import is_a_photo

    levels = ("*", "*/*", "*/*/*")
    files = (file for level in levels for file in sorted(path.glob(level)) if not is_a_photo(file))
    signs = ((file, foreign(file)) for file in islice(filter(usable, files), _MOST_SEARCHED_FILES))
    found = [(file, sign) for file, sign in signs if sign is not None]
    return min(found, key=lambda pair: not pair[1].poses, default=None)


def _photos_in(folder: Path) -> list[Path]:
    """Return the photos in a folder, or otherwise in the first of its folders with photos."""
    from g2ard.io.finding import is_a_photo

    if not folder.is_dir():
        return []
    held = sorted(folder.iterdir())
    inner = (
        sorted(sub.iterdir()) for sub in islice(filter(Path.is_dir, held), _MOST_INSPECTED_FILES)
    )
    found = ([file for file in files if is_a_photo(file)] for files in (held, *inner))
    return next(filter(None, found), [])


def _poses_above(path: Path) -> Path | None:
    """Return the transforms.json, or the folder of another file of poses, beside a folder of photos."""
    import g2ard.io.colmap as colmap
    import g2ard.io.transforms as transforms

    above = path.parent
    files = transforms.files_of(above)
    if len(files) == 1:
        return next(iter(files))
    if files or colmap.model_folder(above) or holds("inria", above):
        return above
    return None


def _ply_format(path: Path) -> str:
    from g2ard.io.plyfiles import groups_of, read_header, scene_names

    header = read_header(path)
    group = groups_of(header)[-1]
    if group not in header.counts:
        raise InputError("has no 'vertex' element")
    properties = scene_names(header.properties(group))
    if "packed_position" in properties:
        return "compressed_ply"
    scene_words = ("f_dc_", "rot_", "scale_", "opacity")
    if any(name.startswith(scene_words) for name in properties):
        return "ply"
    return "cloud_ply"


def _json_format(path: Path) -> str:
    from g2ard.io.jsonfile import read_any_json

    content = read_any_json(path)
    name = json_format(content)
    if name:
        return name
    if not isinstance(content, dict):
        raise InputError(
            "is a JSON list, but not cameras of INRIA's trainer or of nerfstudio's ns-export"
        )
    raise InputError("is neither a transforms.json ('frames') nor g2ard's views ('views')")
