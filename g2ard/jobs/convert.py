"""`g2ard.convert`: merging, cropping and moving scenes, and changing their axes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

import g2ard.io.spz as spz
from g2ard.arrays import Float
from g2ard.config.checks import Degree, Positive, checks_arguments
from g2ard.config.choices import AxesName, PointColor, RenderModel
from g2ard.config.schema import Settings
from g2ard.errors import InputError, require
from g2ard.io import Source
from g2ard.io.scene_formats import FORMATS
from g2ard.jobs.chosen_points import PointChoice
from g2ard.jobs.inputs import Numbers, Scene, lift_cloud, load_scene
from g2ard.progress import Progress, Say, silent, unsaid
from g2ard.scene.conditions import check_condition, fulfilling
from g2ard.scene.splats import Splats
from g2ard.scene.transform import (
    change_of_axes,
    in_box,
    in_sphere,
    join,
    moving,
    similarity,
    transform,
    with_axes,
)


@dataclass(frozen=True, eq=False)
class Changes(Settings):
    """Changes to a scene, checked when they are made; fields are arguments of `convert`."""

    box: Numbers | None = None
    sphere: Numbers | None = None
    invert: bool = False
    where: str | None = None
    transform: ArrayLike | None = None
    scale: Positive | None = None
    rotate: Numbers | None = None
    translate: Numbers | None = None
    recentre: bool = False
    to_axes: AxesName | None = None
    sh_degree: Degree | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, count in (("box", 6), ("sphere", 4), ("rotate", 3), ("translate", 3)):
            values = getattr(self, name)
            fits = values is None or (
                np.shape(values) == (count,) and all(map(math.isfinite, values))
            )
            require(name, values, fits, f"{count} numbers")
        if self.invert and self.box is None and self.sphere is None:
            raise InputError(
                "has nothing to invert", parameter="invert", hint="give {box} or {sphere}"
            )
        if self.where is not None:
            check_condition(self.where)
        if self.transform is not None:
            similarity(self.transform)

    def apply(self, splats: Splats) -> Splats:
        """Return the changed scene."""
        keep = np.ones(len(splats), bool)
        if self.box is not None:
            keep &= in_box(splats, self.box[:3], self.box[3:])
        if self.sphere is not None:
            keep &= in_sphere(splats, self.sphere[:3], self.sphere[3])
        keep ^= self.invert
        if self.where is not None:
            keep &= fulfilling(splats, self.where)
        if not keep.any():
            raise InputError(
                f"the conditions keep none of {len(splats):,} Gaussians",
                hint="change {box}, {sphere} or {where}; `g2ard info` shows extent, opacities and scales",
            )
        if not keep.all():
            splats = splats.take(keep)
        matrix = self._matrix()
        if matrix is not None:
            splats = transform(splats, matrix)
        if self.recentre:
            splats = replace(splats, offset=np.zeros(3))
        if self.sh_degree is not None:
            splats = splats.with_sh_degree(self.sh_degree)
        if self.to_axes is None:
            return splats
        return replace(with_axes(splats, change_of_axes(splats.axes, self.to_axes)), axes="RDF")

    def _matrix(self) -> Float | None:
        """Return the (4, 4) matrix of `transform` and then of `scale`, `rotate` and `translate`."""
        matrix = None if self.transform is None else np.asarray(self.transform, np.float64)
        if not any(given is not None for given in (self.scale, self.rotate, self.translate)):
            return matrix
        zero = (0.0, 0.0, 0.0)
        turn = zero if self.rotate is None else self.rotate
        shift = zero if self.translate is None else self.translate
        then = moving(1.0 if self.scale is None else self.scale, turn, shift)
        return then if matrix is None else then @ matrix


@checks_arguments
def convert(
    scenes: Scene | Sequence[Scene],
    *,
    box: Numbers | None = None,
    sphere: Numbers | None = None,
    invert: bool = False,
    where: str | None = None,
    transform: ArrayLike | None = None,
    scale: float | None = None,
    rotate: Numbers | None = None,
    translate: Numbers | None = None,
    recentre: bool = False,
    from_axes: AxesName | None = None,
    to_axes: AxesName | None = None,
    sh_degree: int | None = None,
    render_model: RenderModel | None = None,
    color: PointColor | None = None,
    say: Say = unsaid,
) -> Splats:
    """Merge, crop and move scenes, exactly like the command `g2ard convert`; `g2ard.save` writes the result.

    Point clouds alone are cropped first, by `box` and `where`, and then lifted. Options apply in their order
    here. `to_axes` suits formats without axes of their own, such as .ply; for .spz, pass `axes` and
    `spz_version` to `save` instead. `layout` and `compress` are options of `save` too.

    Args:
        scenes: a scene or several, or their paths.
        box: lower and upper corner (x, y, z, x, y, z) of what to keep, world coordinates.
        sphere: centre and radius (x, y, z, r) of what to keep.
        invert: keep what `box` and `sphere` would drop.
        where: condition on the Gaussians to keep, such as "opacity > 0.05 and elongation < 9"; see
            `g2ard.scene.conditions`. On points it may use the columns of their files: "classification == 2".
        transform: (4, 4) matrix of uniform scale, rotation and translation, row-major.
        scale: factor about the origin.
        rotate: angles about the x, y and z axes in turn, degrees.
        translate: (3,) shift, scene units.
        recentre: drop the offset to map coordinates.
        from_axes: axes of the files' coordinates, if not those of their format, such as "RDF".
        to_axes: axes of the result; a scene in memory is "RDF" (right, down, forward).
        sh_degree: SH degree of the result, 0 to 3.
        render_model: overrides what the scenes' files say.
        color: "intensity" or "class" to colour points by; None takes their colours.
        say: called with log messages.

    Returns:
        The scene.

    Raises:
        InputError: an unreadable scene, an invalid option, or no Gaussian left.

    >>> pair = Splats.create([[0, 0, 0], [5, 0, 0]], scales=np.ones((2, 3)))
    >>> convert([pair, pair], where="x > 1", scale=2).means.tolist()
    [[10.0, 0.0, 0.0], [10.0, 0.0, 0.0]]
    """
    opened = open_scenes(scenes, render_model)
    points = None if color is None else PointChoice(color=color)
    if isinstance(opened, Source):
        points = PointChoice(None if invert else box, where, color)
        where = None
    changes = Changes(
        box,
        sphere,
        invert,
        where,
        transform,
        scale,
        rotate,
        translate,
        recentre,
        to_axes,
        sh_degree,
    )
    return changes.apply(read_merged(opened, points, from_axes, say))


def open_scenes(
    scenes: Scene | Sequence[Scene], render_model: RenderModel | None = None
) -> Source | list[Splats | Source]:
    """Return scenes that are not read yet; point clouds alone become one."""
    several = [scenes] if isinstance(scenes, Scene) else list(scenes)
    sources = [
        scene if isinstance(scene, Splats) else Source(scene, render_model) for scene in several
    ]
    if sources and all(isinstance(one, Source) and one.kind == "points" for one in sources):
        first, *others = (Path(one) for one in several if not isinstance(one, Splats))
        return Source(first, render_model, others)
    return sources


def read_merged(
    opened: Source | list[Splats | Source],
    points: PointChoice | None = None,
    from_axes: AxesName | None = None,
    say: Say = unsaid,
    progress: Progress = silent,
) -> Splats:
    """Read the result of `open_scenes` and join it; point clouds are lifted.

    Args:
        points: of point clouds to read.
        from_axes: see `convert`.
    """
    if not isinstance(opened, Source):
        if points is not None:
            raise InputError("is for point clouds alone", parameter=points.given[0])
        return join([_load_in_axes(source, from_axes, say) for source in opened])
    if from_axes is not None:
        raise InputError("has no effect on point clouds", parameter="from_axes")
    if points is not None:
        points.narrow(opened, progress)
    return lift_cloud(opened, progress, say)


def _load_in_axes(scene: Splats | Source, axes: AxesName | None, say: Say) -> Splats:
    """Read a scene whose file may store other axes than its format defines."""
    splats = load_scene(scene, say)
    if axes is None:
        return splats
    if splats.axes != "RDF" and isinstance(scene, Source):
        raise InputError(
            "names its axes, which are followed", path=scene.file, hint="leave {from_axes} out"
        )
    defined = "RDF"
    if isinstance(scene, Source):
        if scene.format == "spz" and spz.names_axes(scene.file):
            raise InputError(
                "names its axes, which are followed", path=scene.file, hint="leave {from_axes} out"
            )
        known = (each.axes for each in FORMATS.values() if each.module == scene.format)
        defined = next((found for found in known if found), "RDF")
    if axes == defined:
        return splats
    return with_axes(splats, change_of_axes(axes, "RDF") @ change_of_axes("RDF", defined))
