"""Paths that a command reads and writes, checked before any work."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

import typer

from g2ard.config.choices import ViewFormat
from g2ard.errors import G2ardError
from g2ard.io import check_scene_output, check_views_output, find_views, kind, read_view_set
from g2ard.io.atomic import check_output
from g2ard.io.detect import may_hold_views, run_scene
from g2ard.io.finding import is_photo
from g2ard.io.paths import real_path
from g2ard.io.scene_formats import files_of
from g2ard.system.cached import cached_property


class Claims:
    """Paths that a command reads and writes: no output is an input, and each belongs to one option.

    Args:
        given: values of options and arguments, some of them paths.
        written: those that are outputs.
    """

    def __init__(self, given: Iterable[Any], written: Collection[Any], overwrite: bool) -> None:
        self.overwrite = overwrite
        self._inputs: list[Path] = []
        # by identity: an output may equal an input, which is refused later
        outputs = set(map(id, written))
        for value in given:
            for path in value if isinstance(value, list) else [value]:
                if isinstance(path, Path) and id(path) not in outputs:
                    self._inputs.append(path)
        # real path → option, whether all below is its own
        self._outputs: dict[Path, tuple[str, bool]] = {}

    def claim(self, flag: str, *outputs: Path, folder: bool = False) -> None:
        """Record what an option writes, before any work.

        Args:
            flag: the option, or the name of what is written beside an output.
            folder: whether the outputs are folders of which every file belongs to the option.

        Raises:
            BadParameter: an output is also an input, even with --overwrite, or another option writes there.
        """
        self.spare_inputs(*outputs, flag=flag)
        for output in outputs:
            place = real_path(output)
            for other, (owner, whole) in self._outputs.items():
                inside = (whole and other in place.parents) or (folder and place in other.parents)
                if owner != flag and (inside or place == other):
                    taken = f"{flag}: {output} is written by {owner} too"
                    raise typer.BadParameter(f"{taken}; name another output")
            self._outputs[place] = flag, folder

    def claim_scene(self, flag: str, path: Path) -> None:
        """Record a scene that an option writes, and check that it can be written."""
        self.claim(flag, *files_of(path))
        check_scene_output(path, self.overwrite)

    def claim_file(self, flag: str, path: Path | None, *, page: bool = False) -> None:
        """Record a file or a page that an option writes, if it is given, and check that it can be written."""
        if path is None:
            return
        self.claim(flag, path)
        if page:
            from g2ard.viewer.page import check_page_output

            check_page_output(path, self.overwrite)
        else:
            check_output(path, self.overwrite)

    def claim_views(self, path: Path, format: ViewFormat | None) -> None:
        """Record the views that a command writes, and check that they can be written."""
        self.claim("--output", path, folder=path.suffix == "")
        check_views_output(path, self.overwrite, format)

    def spare_inputs(self, *outputs: Path, flag: str = "--output") -> None:
        """Raise a usage error if an output is also an input, even with --overwrite."""
        taken = set(map(real_path, [*self._inputs, *map(run_scene, self._inputs)]))
        folders = {place for place in taken if place.is_dir()}
        for output in outputs:
            place = real_path(output)
            inside = _DATA_FILES.fullmatch(place.name) and not folders.isdisjoint(place.parents)
            if place in taken or (place.exists() and (inside or place in self._read_beside(place))):
                raise typer.BadParameter(
                    f"{flag}: {output} is both an input and the output; name another output"
                )

    def _read_beside(self, place: Path) -> Collection[Path]:
        """Return files that inputs name or that are read beside them, if `place` may be one."""
        if is_photo(place):
            return self._photos
        return self._cameras if place.suffix.lower() in (".json", ".yml") else ()

    @cached_property
    def _photos(self) -> frozenset[Path]:
        """Photos and masks of views among the inputs or beside them, and all in input folders of photos."""
        found: list[Path | None] = []
        for path in filter(may_hold_views, [*self._inputs, *self._cameras]):
            try:
                what = kind(path)
            except (G2ardError, OSError):
                found += [p for p in path.rglob("*") if is_photo(p)] if path.is_dir() else []
                continue
            if what == "views":
                with suppress(G2ardError, OSError):  # the command will say it
                    cameras = read_view_set(path, unpictured=True).cameras
                    found += [*cameras.image_paths, *cameras.mask_paths]
        return frozenset(real_path(path) for path in found if path is not None)

    @cached_property
    def _cameras(self) -> frozenset[Path]:
        """Cameras that are read because they are beside an input scene."""
        found = (find_views(path) for path in self._inputs)
        return frozenset(real_path(path) for path in found if path is not None)

    def named_inputs(self) -> list[Path]:
        """Return the real paths of the inputs that options name."""
        return [real_path(path) for path in self._inputs]

    def input_files(self) -> list[Path]:
        """Return all files that the command reads: inputs, files in input folders, cameras that are found,
        photos, and what is found beside views."""
        named = {*map(run_scene, self._inputs), *self._cameras}
        found = named | self._photos | self._beside
        for path in named:
            if path.is_dir():
                found.update(path.rglob("*"))
        return sorted(path for path in found if path.is_file() and not self._writes(path))

    def _writes(self, path: Path) -> bool:
        """Return whether a file is among the outputs, as in a folder of views that a run is written into."""
        place = real_path(path)
        return not self._outputs.keys().isdisjoint((place, *place.parents))

    @cached_property
    def _beside(self) -> set[Path]:
        """Splits, points and exposures that are found beside views and photos."""
        from g2ard.io.exposures import exposure_file
        from g2ard.io.splits import split_files
        from g2ard.jobs.start_points import find_sparse_file

        found: set[Path] = {exposure_file(photo) for photo in self._photos}
        for path in filter(may_hold_views, [*self._inputs, *self._cameras]):
            found.update(split_files(path))
            with suppress(G2ardError, OSError):  # the command will say it
                found.update(filter(None, [find_sparse_file(path)]))
        return found


_DATA_FILES = re.compile(
    r"(cameras|images|points3D|frames|rigs)\.(txt|bin)|(cameras|transforms.*|(lod-)?meta|tiles)\.json|poses_bounds\.npy"
    r"|(tile|halo)-\d+\.f32|(means_[lu]|scales|quats|sh0|shN_(centroids|labels))\.webp"
)
"""Files that commands read in a folder given to them."""
