"""Allowed names, listed once for functions, options, configs and studies.

This module imports nothing heavy, so that `--help` stays fast.
"""

from typing import Any, Literal, get_args

Named = dict[str, Any]
"""Values by name: options, figures of a report."""

Colour = tuple[float, float, float]
"""RGB in [0, 1]."""
BLACK: Colour = (0.0, 0.0, 0.0)
"""Default background colour."""

WHITE: Colour = (1.0, 1.0, 1.0)

LengthUnit = Literal["m", "ft", "us-ft"]
"""Units of scenes on a globe."""
UNITS: dict[LengthUnit, float] = {"m": 1.0, "ft": 0.3048, "us-ft": 1200 / 3937}
"""Unit → its metres."""

Method = Literal["default", "fast", "paper"]
"""Methods of simplification."""

Policy = Literal["auto", "directional"]
"""Policies of view selection."""
POLICIES: tuple[Policy, ...] = get_args(Policy)

PoolKind = Literal["auto", "orbit", "walk", "aerial", "inside", "sharp"]
"""Kinds of generated view pools (`g2ard.poses.make_pool`)."""
POOL_KINDS: tuple[PoolKind, ...] = get_args(PoolKind)

Focus = Literal["far", "near", "standing", "anywhere"]
"""Kinds of training views that `distill --focus` adds; `far` adds none (`g2ard.SelectConfig`)."""

ScheduleName = Literal["fast", "default", "best", "paper"]
"""Schedules of recovery (`g2ard.stages.recover.config`)."""

PaperPresetName = Literal["paper", "paper-trained", "paper-lift", "paper-noisy"]
"""The paper's regularisers, for a prior that is measured or named."""
PresetName = Literal["auto", "trained", "lift", "noisy", PaperPresetName]
"""Regularisers for each kind of prior (`g2ard.stages.recover.anchors`)."""

Engine = Literal["fused", "torch"]
"""Engines that run recovery's steps (`g2ard.stages.recover.engine`)."""

AdaptSchedule = Literal["default", "paper"]
"""Schedules of adaptation (`g2ard.pipeline.adapt`)."""

Refinement = Literal["auto", "none", "photometric"]
"""Refinements of a photo's pose after feature matching (`g2ard.stages.register`)."""

Keep = Literal["registered", "uncertain", "all"]
"""Photos whose poses registration keeps."""

Alpha = Literal["composite", "mask"]
"""Treatment of transparent pixels of photos (`g2ard.io.types.ViewFiles`)."""

PointColor = Literal["intensity", "class"]
"""Columns that colour points instead of their own colours (`g2ard.jobs.chosen_points`)."""

Convention = Literal["gsplat", "inria"]
"""Rasteriser conventions that renderers disagree on (`g2ard.rendering.renderer`)."""

RenderModel = Literal["classic", "antialiased"]
"""Renderings that scenes are trained for; antialiased is also called mip (`g2ard.rendering.renderer`)."""
RENDER_MODELS: tuple[RenderModel, ...] = get_args(RenderModel)

# fmt: off
Axes = Literal[
    "LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF",
    "LFD", "RFD", "LFU", "RFU", "LBD", "RBD", "LBU", "RBU",
]
# fmt: on
"""Axes by the directions of x, y and z: left or right, down or up, back or forward."""
AXES: tuple[Axes, ...] = get_args(Axes)
AxesName = Literal[Axes, "y-up", "z-up"]
"""Axes by directions, or by the usual right-handed system with that axis up."""
NAMED_AXES: dict[str, Axes] = {"y-up": "RUB", "z-up": "RFU"}

LpipsInput = Literal["scaled", "unscaled"]
"""Value range of the images passed to LPIPS's networks (`g2ard.rendering.metrics`)."""

ViewFormat = Literal["g2ard", "inria", "nerfstudio", "colmap"]
"""Formats that views can be written to (`g2ard.io.views`)."""

FormatName = Literal["ply", "sog", "spz", "glb", "compressed.ply", "splat", "usda", "usdc"]
"""Formats that scenes can be written to (`g2ard.io.scene_formats`)."""


PlyLayout = Literal["inria"]
"""Fixed layouts of .ply files (`g2ard.io.ply`)."""


def is_made(views: object) -> bool:
    """Return whether views are to be generated rather than given."""
    return isinstance(views, str) and views == "made"


def is_given(views: object) -> bool:
    """Return whether views are neither found nor generated."""
    return views is not None and not is_made(views)


def colour_text(colour: Colour) -> str:
    """Return a colour as `--background` takes it.

    >>> colour_text((1, 1, 1)), colour_text((0.5, 0.25, 1))
    ('white', '0.5,0.25,1')
    """
    rounded = tuple(round(float(value), 3) for value in colour)
    if rounded == BLACK:
        return "black"
    if rounded == WHITE:
        return "white"
    return ",".join(f"{value:g}" for value in rounded)
