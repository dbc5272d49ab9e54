"""One opened scene or coloured point cloud of any format."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from g2ard.errors import InputError
from g2ard.io.detect import KINDS, Kind, file_format, reader, run_scene
from g2ard.io.paths import about
from g2ard.io.signs import explained
from g2ard.system.cached import cached_property

if TYPE_CHECKING:
    from g2ard.config.choices import RenderModel
    from g2ard.io.stream import PointStream, SceneStream
    from g2ard.io.tile_store import TileStore
    from g2ard.io.types import Notes
    from g2ard.scene.splats import Splats


class Source:
    """A scene or coloured point cloud on disk, or several as one.

    Its format is detected and its header read on first use, and only once.

    Args:
        path: the file or folder, or the folder of a `distill` run.
        render_model: overrides what a scene's file says.
        others: further scenes or point clouds that belong to it.

    Attributes:
        file: the file or folder itself, which in the folder of a run is its scene.
        through: changes the point cloud when it is opened, as to fewer points; None leaves it.
    """

    def __init__(
        self,
        path: str | Path,
        render_model: RenderModel | None = None,
        others: Sequence[Path] = (),
    ) -> None:
        self.path = Path(path)
        self.file = run_scene(path)
        self.render_model = render_model
        self.others = tuple(Source(other, render_model) for other in others)
        self.through: Callable[[PointStream], PointStream] | None = None

    def __str__(self) -> str:
        return str(self.path)

    @cached_property
    def format(self) -> str:
        """Name in `READERS`; an `InputError` is raised if the file is missing or unsupported."""
        return file_format(self.file)

    @property
    def kind(self) -> Kind:
        """Kind of the format: "splats", "points" or "views"."""
        return KINDS[self.format]

    @cached_property
    def scene(self) -> SceneStream:
        """Scene in blocks.

        Memory holds one block of a .ply, .compressed.ply or .splat, one chunk of a SOG, one tile, or the
        whole file of other formats.
        """
        stream: SceneStream = self._open("splats")
        if self.render_model:
            stream.render_model = self.render_model
        return stream

    @cached_property
    def store(self) -> TileStore | None:
        """The scene's tiles, if it is a folder of tiles."""
        if self.format != "tiles" or self.others:
            return None
        return self.scene.store  # type: ignore[attr-defined]

    @cached_property
    def _points(self) -> PointStream:
        stream: PointStream = self._open("points")
        if not self.through:
            return stream
        return self.through(stream)

    def cloud(self, *, bare: bool = False) -> PointStream:
        """Return the point cloud in blocks.

        Memory holds one block of a .ply, .las, .laz or .e57, or the whole file of other formats. Without
        colours, intensities become grey; without either, the cloud must be `bare`.
        """
        stream = self._points
        if not stream.channels and len(stream.sample) and not bare:
            raise InputError(stream.lack, path=self.file, hint=stream.todo or _UNCOLORED)
        return stream

    @property
    def count(self) -> int:
        """Rows of the scene or point cloud."""
        if self.kind == "splats":
            return self.scene.count
        return self._points.count

    @property
    def map_system(self) -> str | None:
        """Map system that the file states, if it is a point cloud or tiles."""
        if self.kind == "points":
            return self._points.system
        if self.kind == "splats" and self.store is not None:
            return self.store.system
        return None

    @property
    def metres_per_unit(self) -> float | None:
        """Metres of the unit of a point cloud that states it."""
        if self.kind == "points":
            return self._points.metres_per_unit
        return None

    @property
    def notes(self) -> Notes:
        """Notes on the scene's file, known once it has been read."""
        return self.scene.all_notes()

    @explained
    def whole(self) -> Splats:
        """Read the scene into memory."""
        return self.scene.whole()

    def drawn_as(self, render_model: RenderModel | None) -> Source:
        """Return the same file with another render model, None for the one it has."""
        if render_model in (None, self.render_model):
            return self
        return Source(self.path, render_model, [other.path for other in self.others])

    def check_scene(self) -> None:
        """Raise an `InputError` for anything but a scene."""
        reader(self.file, self.format, "splats")

    @explained
    def _open(self, expected: Kind) -> Any:
        """Open this one, or it and the others as one stream."""
        from g2ard.io.stream import PartsStream

        module = reader(self.file, self.format, expected)
        if self.others:
            first = Source(self.path, self.render_model)
            first.__dict__["format"] = self.format  # it is detected once
            return joined([first, *self.others])
        with about(self.file):
            if hasattr(module, "Stream"):
                return module.Stream(self.file)
            return PartsStream.of(self.file, *module.read(self.file))


_UNCOLORED = "add colours, for example with PDAL's filters.colorization, or run `distill` with photos ({views=DIR})"


def joined(sources: Sequence[Source]) -> SceneStream | PointStream:
    """Return several scenes or point clouds as one, for reading in blocks.

    Point clouds get one offset. Scenes get the offset of the first and the highest of their SH degrees; their
    render models must agree.
    """
    from g2ard.io.stream import JoinedScenes, joined_clouds

    if not sources:
        raise InputError("no scene given")
    if all(source.kind == "points" for source in sources):
        return joined_clouds([source.cloud() for source in sources])
    scenes = [source.scene for source in sources]
    if len(scenes) == 1:
        return scenes[0]
    return JoinedScenes(scenes)
