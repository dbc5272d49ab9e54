"""Finding the photos, masks and points that views name, by one rule for all formats."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path, PureWindowsPath
from typing import TYPE_CHECKING
from urllib.parse import unquote

if TYPE_CHECKING:
    from g2ard.io.types import Notes

_READ = ".png .jpg .jpeg .jpe .jfif .webp .tif .tiff .bmp .gif .ppm .pgm .pnm .tga .jp2"
_PHOTO_SUFFIXES = tuple(_READ.split())

_RAW = ".dng .cr2 .cr3 .nef .arw .raf .orf .rw2 .raw"
_OTHER_PHOTOS = {
    ".heic": "HEIC",
    ".heif": "HEIC",
    ".hif": "HEIC",
    ".avif": "AVIF",
    ".avifs": "AVIF",
    ".exr": "OpenEXR",
    ".hdr": "Radiance HDR",
    ".jxl": "JPEG XL",
    **{suffix: f"raw ({suffix[1:].upper()})" for suffix in _RAW.split()},
}
"""Suffixes of photos that cannot be read, and their formats."""

_LEFT_BY_SYSTEMS = re.compile(r"\._.*|\.ds_store|thumbs\.db|desktop\.ini", re.IGNORECASE)

_CODE_PAGES = ("cp949", "cp932", "gbk", "big5", "cp1252", "cp1251", "cp1250", "cp437")
"""Character sets of names that are not UTF-8."""
_MISREAD_AS = ("cp437", "cp1252", "latin-1")
"""Character sets that programs take names for whose own is not stated, as in .zip files."""

_MASK_FOLDERS = ("masks", "mask")
MOVING = "dynamic_mask_"
"""Prefix of instant-ngp's masks, in which white marks what moves."""
_MASKS_BESIDE = (
    "{name}.mask",
    "{stem}.mask",
    "{name}_mask",
    "{stem}_mask",
    "{stem}-mask",
    "mask_{stem}",
    MOVING + "{stem}",
    MOVING + "{name}",
)
_MASKS = ("{name}", "{stem}", *_MASKS_BESIDE)
"""Names of a photo's mask without its suffix: beside the photo, and in a folder of masks."""

_MOST_FOLDERS = 64  # folders to look into for photos that are not where they are expected
_ASKED = 64  # names, evenly spaced, that tell whether a folder holds the photos


class Finder:
    """Files by the names that views give them.

    The first of these that exists is taken, each in the folders in their order:

    1. the path as written, absolute or below a folder;
    2. with `\\` read as `/`, its end: without root and drive, then without one leading folder after the
       other, so that `C:\\capture\\images\\a\\1.png` is found as `images/a/1.png`, `a/1.png` or `1.png`;
    3. in the same order, a file of that name in other capitals or another Unicode form;
    4. in the same order, a photo of that name with another suffix;
    5. in the same order, a photo whose name is the same in another character set, with the escapes of
       addresses (`%20`), or with `_` for letters that Windows does not allow.

    Empty files, and those that systems leave in folders, are ignored.

    Args:
        folders: where to look; a missing folder is ignored.

    Attributes:
        notes: a note if `among` chose a folder where photos were not expected.
    """

    def __init__(self, *folders: Path, notes: Notes = ()) -> None:
        self._folders = tuple(dict.fromkeys(folders))
        self.notes = notes
        self._listings: dict[Path, tuple[dict[str, Path], dict[str, Path]]] = {}

    @classmethod
    def among(
        cls,
        given: Path | None,
        names: Sequence[str],
        folders: Sequence[Path],
        around: Iterable[Path],
    ) -> Finder:
        """Return the finder in the `given` folder, otherwise in `folders`, or if they hold none of the names,
        in the first folder that holds half of them: one of `around`, or a folder in these. A few like names
        may be of other photos."""
        from g2ard.io.types import Note

        if given:
            return cls(given)
        asked = names[:: max(1, len(names) // _ASKED)]
        expected = cls(*folders)
        if any(map(expected.find, asked)):
            return expected
        roots = [root for root in dict.fromkeys(around) if root.is_dir()]
        places = list(roots)
        for root in roots:
            places += sorted(filter(Path.is_dir, root.iterdir()))[:_MOST_FOLDERS]
        for place in places:
            found = cls(place)
            there = sum(found.find(name) is not None for name in asked)
            if 2 * there >= max(1, len(asked)):
                text = f"photos are in {place}, not in {folders[0]}"
                return cls(place, notes=(Note("photos_elsewhere", there, text),))
        return expected

    def find(self, name: str) -> Path | None:
        """Return the file that `name` means, or None."""
        if not name or "\0" in name:
            return None
        for folder in self._folders:
            if usable(folder / name):
                return folder / name
        parts = plain_parts(name)
        if not parts:
            return None
        ends = [parts[k:] for k in range(len(parts))]
        for keys in _keys(parts[-1]):
            for end in ends:
                for folder in self._folders:
                    files = self._within(folder, end[:-1])
                    found = _first(files, keys)
                    if found:
                        return found
        return None

    def photo(self, name: str) -> Path:
        """Return the file that `name` means, or where it was expected first."""
        return self.find(name) or self._folders[0] / name

    def mask(self, photo: Path, depth: int) -> Path | None:
        """Return the mask of a photo: in a folder of masks beside that of the photos, at most `depth` folders
        above, with the same folders in it; otherwise beside the photo."""
        places: list[tuple[Path, Path, Sequence[str]]] = []
        for folder, path in mask_folders(photo, depth):
            places.append((folder, path, _MASKS))
        places.append((photo.parent, Path(photo.name), _MASKS_BESIDE))
        for folder, path, names in places:
            keys = [f"stem {_folded(name)}" for name in _mask_names(path, names)]
            if names is _MASKS:
                keys.insert(0, f"exact {path.name}")
            files = self._within(folder, path.parts[:-1])
            found = _first(files, keys)
            if found:
                return found
        return None

    def _within(self, folder: Path, parts: Sequence[str]) -> dict[str, Path]:
        """Return the files by key of a folder below one."""
        for part in parts:
            inner = self._listed(folder)[1]
            below = _first(inner, chain.from_iterable(_keys(part)))
            if below is None:
                return {}
            folder = below
        return self._listed(folder)[0]

    def _listed(self, folder: Path) -> tuple[dict[str, Path], dict[str, Path]]:
        """Return the files and the folders of a folder by key; only photos have keys without suffix."""
        if folder in self._listings:
            return self._listings[folder]
        held = []
        if folder.is_dir():
            held = sorted(folder.iterdir(), reverse=True)
        held.sort(key=is_photo)  # those that can be read win over others of the same stem
        levels = [(path, _keys(path.name)) for path in held if usable(path)]
        files: dict[str, Path] = {}
        for depth in (3, 2, 1, 0):  # nearer spellings win
            for path, keys in levels:
                if depth < 2 or is_a_photo(path):
                    files |= dict.fromkeys(keys[depth], path)
        inner: dict[str, Path] = {}
        for path in filter(Path.is_dir, held):
            for names in _keys(path.name):
                inner |= dict.fromkeys(names, path)
        self._listings[folder] = files, inner
        return files, inner


def _first(files: Mapping[str, Path], keys: Iterable[str]) -> Path | None:
    """Return the file of the first key that there is."""
    return next((files[key] for key in keys if key in files), None)


def _mask_names(photo: Path, patterns: Sequence[str]) -> list[str]:
    return [pattern.format(name=photo.name, stem=photo.stem) for pattern in patterns]


def _keys(name: str) -> list[list[str]]:
    """Return what a file may be found by, the strictest first."""
    return [
        [f"exact {name}"],
        [f"name {_folded(name)}"],
        [f"stem {_folded(_stem(name))}"],
        [f"other {_folded(_stem(other))}" for other in _respelled(name)],
    ]


def _stem(name: str) -> str:
    if not is_a_photo(Path(name)):
        return name
    return Path(name).stem


def _folded(name: str) -> str:
    """Return a name in one Unicode form, without capitals.

    >>> _folded("Ku\\u0308che") == _folded("K\\u00dcCHE")
    True
    """
    folded = unicodedata.normalize("NFC", name).casefold()
    return unicodedata.normalize("NFC", folded)


def _respelled(name: str) -> Iterator[str]:
    """Yield a name as in files and addresses of other systems, and as in other character sets.

    Bytes that are not UTF-8 are surrogates, as `os.fsdecode` returns them.
    """
    yield name
    yield unquote(name)
    yield re.sub(r'[:*?"<>|]', "_", name)  # letters that Windows has not in names
    if name.isascii():
        return
    for wrong in ("utf-8", *_MISREAD_AS):
        errors = "strict"
        if wrong == "utf-8":
            errors = "surrogateescape"
        with suppress(UnicodeError):
            data = name.encode(wrong, errors)
            for own in ("utf-8", *_CODE_PAGES):
                with suppress(UnicodeError):
                    yield data.decode(own)


def readable(names: Sequence[str], files: Sequence[Path | None]) -> list[str]:
    """Return names without surrogates: in the character set that agrees with most of the photos' names, in
    UTF-8 with `\\x..` if none does.

    >>> readable(["caf\\udce9.png"], [Path("caf\\u00e9.png")]), readable(["caf\\udce9"], [None])
    (['café.png'], ['caf\\\\xe9'])
    """
    if all(map(str.isascii, names)):
        return list(names)

    def agreeing(spelled: Sequence[str]) -> int:
        count = 0
        for name, file in zip(spelled, files, strict=True):
            if file is not None and _folded(name).endswith(_folded(file.name)):
                count += 1
        return count

    data = [name.encode("utf-8", "surrogateescape") for name in names]
    best = [raw.decode("utf-8", "backslashreplace") for raw in data]
    for own in _CODE_PAGES:
        for wrong in ("utf-8", "latin-1"):  # text in another character set is read as one of these
            with suppress(UnicodeError):
                spelled = [name.encode(wrong, "surrogateescape").decode(own) for name in names]
                if agreeing(spelled) > agreeing(best):
                    best = spelled
    return best


def usable(path: Path) -> bool:
    """Return whether a path is a file that is not empty, and not one that systems leave in folders."""
    if _LEFT_BY_SYSTEMS.fullmatch(path.name):
        return False
    with suppress(OSError, ValueError):
        return path.is_file() and path.stat().st_size > 0
    return False


def files_in(folder: Path, *suffixes: str) -> list[Path]:
    """Return the usable files of a folder, sorted; none if it does not exist."""
    if not folder.is_dir():
        return []
    held = sorted(folder.iterdir())
    if suffixes:
        held = [path for path in held if path.suffix.lower() in suffixes]
    return list(filter(usable, held))


def photos_in(folder: Path, *, below: bool = False) -> list[Path]:
    """Return the photos in a folder that can be read, or also those below it, without masks beside them."""
    if below:
        files = sorted(filter(usable, folder.rglob("*")))
    else:
        files = files_in(folder)
    photos = [file for file in files if is_photo(file)]
    masks = set[Path]()
    for photo in photos:
        masks.update(map(photo.with_name, _mask_names(photo, _MASKS_BESIDE)))
    return [photo for photo in photos if photo.with_name(photo.stem) not in masks]


def is_photo(path: Path) -> bool:
    """Return whether a name has the suffix of a photo that can be read."""
    return path.suffix.lower() in _PHOTO_SUFFIXES


def other_photo(path: Path) -> str | None:
    """Return the format of a photo that cannot be read, by its suffix, or None."""
    return _OTHER_PHOTOS.get(path.suffix.lower())


def is_a_photo(path: Path) -> bool:
    return is_photo(path) or other_photo(path) is not None


def plain_parts(name: str) -> list[str]:
    """Return the parts of a path of any system, without root, drive, `.` and `..`.

    >>> plain_parts("C:\\\\capture\\\\a.png"), plain_parts("../images/./a.png")
    (['capture', 'a.png'], ['images', 'a.png'])
    """
    path = PureWindowsPath(name)
    return [part for part in path.parts if part not in (path.anchor, path.drive, "..", ".")]


def is_end(name: str, photo: Path) -> bool:
    """Return whether a photo's path ends in all parts of `name`, whatever the spelling and suffix."""
    parts = plain_parts(name)
    skipped = len(photo.parts) - len(parts)
    if skipped < 0:
        return False
    return all(map(_are_alike, parts, photo.parts[skipped:]))


def _are_alike(name: str, other: str) -> bool:
    """Return whether two names may be of one file."""
    levels = zip(_keys(name), _keys(other), strict=True)
    return any(not set(own).isdisjoint(others) for own, others in levels)


def mask_folders(photo: Path, depth: int) -> list[tuple[Path, Path]]:
    """Return folders of masks for a photo, nearest first, and the photo's path in its own folder beside them.

    The folder of all photos is at most `depth` folders above the photo.
    """
    found = []
    for own in photo.parents[: max(1, depth)]:
        size = own.name.partition("_")[2]  # images_4 goes with masks_4
        if not own.is_dir():
            continue
        names = [f"{name}_{size}" for name in _MASK_FOLDERS if size]
        names += _MASK_FOLDERS
        names += [f"{own.name}_{name}" for name in _MASK_FOLDERS]
        beside = {_folded(path.name): path for path in own.parent.iterdir() if path.is_dir()}
        path = photo.relative_to(own)
        folders = [beside[key] for key in map(_folded, names) if key in beside]
        found += [(folder, path) for folder in folders]
    return found
