"""Writers of scenes by suffix, in any case, or by meta.json for a SOG folder."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from g2ard.config.choices import FormatName
from g2ard.errors import OutputError
from g2ard.io.paths import AnyPath, naming

if TYPE_CHECKING:
    from g2ard.io.types import Note
    from g2ard.scene.splats import Splats


class SceneFormat(NamedTuple):
    """A format to write scenes in.

    Args:
        function: the writer in the module, `fn(path, splats, *, overwrite, **options)`.
        options: names of its options.
        models: whether it can state the render model.
        axes: of its coordinates, by definition or unless it states others; None if scenes bring their own.
        loss: 0 for one that keeps float32, 1 for one that loses little, 2 for one that loses more.
        tells: whether its writer takes `progress`.
    """

    suffix: str
    module: str
    function: str = "write"
    options: tuple[str, ...] = ()
    models: bool = True
    axes: str | None = None
    loss: int = 0
    tells: bool = False

    def writer(self) -> Any:
        """Return the module that writes it."""
        return import_module(f"g2ard.io.{self.module}")


FORMATS: dict[FormatName, SceneFormat] = {
    "compressed.ply": SceneFormat(".compressed.ply", "compressed_ply", loss=1),
    "ply": SceneFormat(".ply", "ply", options=("normals", "layout")),
    "sog": SceneFormat(".sog", "sog_write", loss=1, tells=True),
    "spz": SceneFormat(
        ".spz",
        "spz",
        options=("spz_version", "axes"),
        axes="RUB",
        loss=2,
        tells=True,
    ),
    "glb": SceneFormat(".glb", "glb", options=("compress",), models=False, axes="LUF"),
    "splat": SceneFormat(".splat", "splat", models=False, loss=2),
    "usda": SceneFormat(".usda", "usd", models=False, axes="RUB", tells=True),
    "usdc": SceneFormat(".usdc", "usd", models=False, axes="RUB", tells=True),
}
"""Formats by name, longer suffixes first."""

SUFFIXES = tuple(known.suffix for known in FORMATS.values())
WRITTEN = ", ".join(SUFFIXES)
"""Suffixes of written scenes, for messages."""

LARGEST_SPZ = 10_485_760
"""Gaussians that readers of SPZ from before May 2026 accept."""

_VISIBLE_ROUNDING = 0.01
"""Rounding of positions that can be visible, as a share of a typical Gaussian's scale."""

_FOLDER = SceneFormat("meta.json", "sog_write", "write_folder", loss=1, tells=True)


def scene_format(path: AnyPath) -> SceneFormat:
    """Return the format of an output path, or raise an `OutputError` if it is unsupported.

    >>> scene_format("a.COMPRESSED.PLY").module, scene_format("room/meta.json").function
    ('compressed_ply', 'write_folder')
    """
    name = Path(path).name.lower()
    if name == "meta.json":
        return _FOLDER
    for output_format in FORMATS.values():
        if name.endswith(output_format.suffix):
            return output_format
    raise OutputError(
        f"scenes are written as {WRITTEN}, or as a SOG folder (NAME/meta.json)", path=path
    )


def files_of(path: Path) -> list[Path]:
    """Return the files that writing a scene may create: the path, or a meta.json and its images."""
    files = [path]
    if path.name == "meta.json":
        files += [path.with_name(f"{name}.webp") for name in _FOLDER_IMAGES]
    return files


_FOLDER_IMAGES = (
    "means_l",
    "means_u",
    "scales",
    "quats",
    "sh0",
    "shN_centroids",
    "shN_labels",
)


def written_bytes(path: Path) -> int:
    """Return the size of a written scene: of its file, or of all files beside a meta.json."""
    if path.name == "meta.json":
        return sum(file.stat().st_size for file in path.parent.iterdir())
    return path.stat().st_size


def lost_in(path: AnyPath, splats: Splats, **options: object) -> list[Note]:
    """Return notes on what the format of an output path cannot hold; `options` are the writer's."""
    from g2ard.io.types import Note

    output_format = scene_format(path)
    notes = []
    is_spz = output_format.module == "spz" or options.get("compress") == "spz"
    # SPZ inside a .glb has a flag for it
    if splats.antialiased and not (output_format.models or is_spz):
        what = f"{output_format.suffix} cannot say that the scene is antialiased"
        text = f"{what}; other programs draw it too opaque"
        notes.append(Note("lost_render_model", 1, text))
    if output_format.module == "splat":
        place = _unstated(path, splats)
        if place:
            notes.append(Note("lost_place", 1, place))
    if is_spz and len(splats) > LARGEST_SPZ:
        text = f"readers of SPZ from before May 2026 refuse more than {LARGEST_SPZ:,} Gaussians"
        notes.append(Note("large_spz", len(splats), text))
    return notes


def _unstated(path: AnyPath, splats: Splats) -> str | None:
    """Return how to get back coordinates that a .splat cannot state."""
    from g2ard.io.splat import form_of

    form = form_of(splats)
    options = ""
    if form.offset.any():
        shift = ",".join(f"{value:.12g}" for value in form.offset)
        options += f" --translate={shift}"
    if form.axes != "RDF":
        options += f" --to-axes {form.axes}"
    if not options:
        return None
    return (
        "cannot state map coordinates: positions are relative to the scene's middle, y down; "
        f"`g2ard convert {Path(path).name} OUT.ply{options}` puts them back"
    )


def check_positions(
    path: AnyPath,
    splats: Splats,
    count: int | None = None,
) -> None:
    """Raise the `InputError` of writing a scene whose positions the format cannot hold, before the work.

    Gaussians of surfaces widen with the root of the ratio when the scene is reduced to `count`.
    """
    writer = scene_format(path).writer()
    if hasattr(writer, "check_far") and len(splats):
        from g2ard.io.packing import as_packed

        ratio = len(splats) / (count or len(splats))
        with naming(path):
            packed = as_packed(splats)
            means = packed.means.astype(float)
            writer.check_far(packed, means, widened=ratio**0.5)


@dataclass
class Rounding:
    """Changes of positions by rounding in one file or in several of a scene.

    If the scene was moved to fit float32 (`far`), every change is told, not only those that can be visible.
    """

    far: bool
    _told: bool = False
    _count: int = 0
    _worst: tuple[float, float] = 0.0, 0.0

    def add(self, error: float, splats: Splats) -> None:
        """Add the largest change of a position in a file of these Gaussians."""
        largest = splats.scales.max(axis=1)
        largest.partition(len(largest) // 2)
        typical = float(largest[len(largest) // 2])
        if self.far:
            self._told |= error > 0
        else:
            self._told |= error > _VISIBLE_ROUNDING * typical
        self._count += len(splats)
        self._worst = max(self._worst, (error, typical))

    @property
    def notes(self) -> list[Note]:
        """A note on the largest change, if it is to be told."""
        from g2ard.io.types import Note

        if not self._told:
            return []
        error, typical = self._worst
        size = f"a typical Gaussian has a scale of {typical:.2g}"
        text = f"positions are rounded by up to {error:.2g} units; {size}"
        return [Note("rounded_positions", self._count, text)]


def axes_note(path: AnyPath, options: dict[str, Any]) -> str | None:
    """Return a note on the axes of a written file if programs differ in them; `options` are the writer's."""
    output_format = scene_format(path)
    axes = options.get("axes")
    if "axes" not in output_format.options:
        return None
    if axes is not None and options.get("spz_version", 3) == 4:
        return None
    if axes == "RDF":
        return (
            "has the coordinates of a .ply, as splat-transform and SuperSplat read it; programs that "
            "follow the definition show it turned by half a turn"
        )
    return (
        "has the axes of the definition (right, up, back); splat-transform and SuperSplat show it turned by "
        "half a turn; `g2ard convert --to-axes RDF` writes a file for them"
    )


def check_options(path: AnyPath, options: dict[str, object]) -> SceneFormat:
    """Return the format of an output path, or raise an `OutputError` if it lacks one of the options."""
    output_format = scene_format(path)
    for name in options:
        if name not in output_format.options:
            raise OutputError(f"{output_format.suffix} has no option {name!r}", path=path)
    return output_format
