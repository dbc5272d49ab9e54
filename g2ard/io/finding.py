"""Finding the photos, masks and points that a file of views names, in one order for all formats."""

from __future__ import annotations

from pathlib import Path, PureWindowsPath

from g2ard.io.paths import is_photo, other_photo

_MASK_FOLDERS = ("masks", "mask")


class Finder:
    """Files by the names that views give them.

    The first of these that exists is taken, each in the folders in their order:

    1. the path as written, absolute or below a folder;
    2. with `\\` read as `/`, its end: without root and drive, then without one leading folder after the
       other, so that `C:\\capture\\images\\a\\1.png` is found as `images/a/1.png`, `a/1.png` or `1.png`;
    3. in the same order, a photo of that name in other capitals;
    4. in the same order, a photo of that name with another suffix.

    Args:
        folders: where to look; a missing folder is ignored.
    """

    def __init__(self, *folders: Path) -> None:
        self._folders = tuple(dict.fromkeys(folders))
        self._listings: dict[Path, tuple[set[str], dict[tuple[str, str], Path]]] = {}

    def find(self, name: str) -> Path | None:
        """Return the file that `name` means, or None."""
        if not name or "\0" in name:
            return None
        for folder in self._folders:
            if (folder / name).is_file():
                return folder / name
        parts = plain_parts(name)
        ends = [Path(*parts[k:]) for k in range(len(parts))]
        for end in ends:
            for folder in self._folders:
                if end.name in self._listed((folder / end).parent)[0]:
                    return folder / end
        for key in (_name_key, _stem_key):
            for end in ends:
                for folder in self._folders:
                    if found := self._listed((folder / end).parent)[1].get(key(end)):
                        return found
        return None

    def photo(self, name: str) -> Path:
        """Return the file that `name` means, or where it was expected first."""
        return self.find(name) or self._folders[0] / name

    def _listed(self, folder: Path) -> tuple[set[str], dict[tuple[str, str], Path]]:
        """Return the names of a folder's files, and its photos by name and by stem in small letters."""
        if folder not in self._listings:
            files = sorted(p for p in folder.iterdir() if p.is_file()) if folder.is_dir() else []
            photos = [file for file in reversed(files) if is_photo(file)]
            keys = {key(file): file for key in (_stem_key, _name_key) for file in photos}
            self._listings[folder] = {file.name for file in files}, keys
        return self._listings[folder]


def _name_key(path: Path) -> tuple[str, str]:
    return "name", path.name.lower()


def _stem_key(path: Path) -> tuple[str, str]:
    return "stem", (path.stem if is_a_photo(path) else path.name).lower()


def plain_parts(name: str) -> list[str]:
    """Return the parts of a path of any system, without root, drive, `.` and `..`.

    >>> plain_parts("C:\\\\capture\\\\a.png"), plain_parts("../images/./a.png")
    (['capture', 'a.png'], ['images', 'a.png'])
    """
    path = PureWindowsPath(name)
    return [part for part in path.parts if part not in (path.anchor, path.drive, "..", ".")]


def is_end(name: str, photo: Path) -> bool:
    """Return whether a photo's path ends in all parts of `name`, whatever the suffix."""
    parts = plain_parts(name)
    return _stems(parts) == _stems(list(photo.parts[-len(parts) :]))


def _stems(parts: list[str]) -> list[str]:
    last = Path(parts[-1] if parts else "")
    return [*parts[:-1], _stem_key(last)[1]]


def is_a_photo(path: Path) -> bool:
    return is_photo(path) or other_photo(path) is not None


def mask_folders(photo: Path, depth: int) -> list[tuple[Path, Path]]:
    """Return folders of masks for a photo, nearest first, and the photo's path in its own folder beside them.

    The folder of all photos is at most `depth` folders above the photo.
    """
    found = []
    for own in photo.parents[: max(1, depth)]:
        size = own.name.partition("_")[2]  # images_4 goes with masks_4
        names = [f"{name}_{size}" for name in _MASK_FOLDERS if size] + list(_MASK_FOLDERS)
        found += [(own.parent / name, photo.relative_to(own)) for name in names]
    return [(folder, path) for folder, path in found if folder.is_dir()]


def find_mask(photo: Path, depth: int) -> Path | None:
    """Return the mask of a photo: of its path in a folder `masks` beside that of the photos, with its suffix,
    with `.png` after it, or with `.png` instead."""
    for folder, path in mask_folders(photo, depth):
        names = (path, path.with_name(f"{path.name}.png"), path.with_suffix(".png"))
        if found := next((folder / name for name in names if (folder / name).is_file()), None):
            return found
    return None
