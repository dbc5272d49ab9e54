"""Distil dense 3D Gaussian scenes into compact, standard 3DGS scenes of an exact size.

| function | purpose |
|---|---|
| `load`, `save` | read and write scenes, by extension |
| `load_views`, `save_views`, `load_points` | read and write cameras, read coloured point clouds |
| `convert`, `clean` | merge, crop and move scenes; remove their clutter |
| `distill` | run the whole pipeline, like `g2ard distill` |
| `distill_against` | run it on a scene in memory, against your own targets |
| `ingest` | split a scene or point cloud of any size into tiles |
| `lift` | turn coloured points into surface-aligned discs |
| `simplify` | reduce a scene to an exact count, like `g2ard simplify` |
| `make_pool`, `orbit`, `select` | generate views; select the most useful views |
| `recover` | optimise a fixed set of Gaussians against photos or a teacher's renders |
| `adapt` | fit a new appearance on frozen geometry |
| `register` | estimate poses of photos |
| `lod`, `save_levels`, `save_tileset` | compute levels of detail, write them as streamed SOG or 3D Tiles |
| `render`, `Renderer`, `evaluate` | render images and depths; measure PSNR and SSIM |

They exchange `Splats`, `Camera`, `Cameras`, `Points`, and targets: `Photos`, `TeacherRenders`, or any object
with `cameras` and an image for each. Stages are configured by dataclasses (`SimplifyConfig`,
`RecoverConfig`, …); `preset` returns the paper's settings. All errors are `G2ardError`s.

Modules load on first use.

>>> import numpy as np
>>> import g2ard
>>> ball = np.random.default_rng(0).normal(size=(2000, 3))
>>> ball /= np.linalg.norm(ball, axis=1, keepdims=True)
>>> scene = g2ard.Splats.create(ball, scales=np.full((2000, 3), 0.05))
>>> small = g2ard.simplify(scene, ratio=10).splats
>>> view = g2ard.Camera.facing([0, -3, 0], [0, 0, 0], width=64, height=48)
>>> len(small), g2ard.render(small, view).image.shape
(200, (48, 64, 3))
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from g2ard.system.shown import Shown

if TYPE_CHECKING:
    from g2ard._core import __version__
    from g2ard.errors import G2ardError, InputError, MissingDependencyError, OutputError
    from g2ard.io import read_points as load_points
    from g2ard.io import read_splats as load
    from g2ard.io import read_views as load_views
    from g2ard.io import write_splats as save
    from g2ard.io import write_views as save_views
    from g2ard.io.tile_store import TileStore
    from g2ard.io.types import Points
    from g2ard.jobs.clean import Cleaned, clean
    from g2ard.jobs.convert import convert
    from g2ard.jobs.distill import distill
    from g2ard.jobs.distill_options import DistillOptions
    from g2ard.jobs.levels import lod, save_tileset
    from g2ard.jobs.notebook import view
    from g2ard.jobs.recover import recover
    from g2ard.jobs.register import register
    from g2ard.jobs.run_views import orbit
    from g2ard.jobs.simplify import simplify
    from g2ard.jobs.viewer_frame import up_of
    from g2ard.levels import Georeference, save_levels
    from g2ard.pipeline.adapt import AdaptConfig, Adapted, adapt
    from g2ard.pipeline.config import DistillConfig, SelectConfig
    from g2ard.pipeline.distill import Distilled
    from g2ard.pipeline.distill import distill as distill_against
    from g2ard.pipeline.presets import preset
    from g2ard.poses import make_pool
    from g2ard.progress import show_progress
    from g2ard.rendering.renderer import RasterSettings, Rendered, Renderer, render
    from g2ard.rendering.targets import Photos, TeacherRenders
    from g2ard.scene.cameras import Camera, Cameras, look_at
    from g2ard.scene.splats import Splats
    from g2ard.stages.evaluate import Evaluation, evaluate
    from g2ard.stages.lift import lift
    from g2ard.stages.recover.anchors import Regularizers
    from g2ard.stages.recover.config import FitConfig, RecoverConfig
    from g2ard.stages.recover.optimize import Recovered
    from g2ard.stages.recover.rasterize import rasterize
    from g2ard.stages.register import RegisterConfig, Registered
    from g2ard.stages.select import CoverageOptions, Selection, select
    from g2ard.stages.simplify import Simplified, SimplifyConfig
    from g2ard.tiles.ingest import ingest

__all__ = [
    "AdaptConfig",
    "Adapted",
    "Camera",
    "Cameras",
    "Cleaned",
    "CoverageOptions",
    "DistillConfig",
    "DistillOptions",
    "Distilled",
    "Evaluation",
    "FitConfig",
    "G2ardError",
    "Georeference",
    "InputError",
    "MissingDependencyError",
    "OutputError",
    "Photos",
    "Points",
    "RasterSettings",
    "RecoverConfig",
    "Recovered",
    "RegisterConfig",
    "Registered",
    "Regularizers",
    "Rendered",
    "Renderer",
    "SelectConfig",
    "Selection",
    "Simplified",
    "SimplifyConfig",
    "Splats",
    "TeacherRenders",
    "TileStore",
    "__version__",
    "adapt",
    "clean",
    "convert",
    "distill",
    "distill_against",
    "evaluate",
    "ingest",
    "lift",
    "load",
    "load_points",
    "load_views",
    "lod",
    "look_at",
    "make_pool",
    "orbit",
    "preset",
    "rasterize",
    "recover",
    "register",
    "render",
    "save",
    "save_levels",
    "save_tileset",
    "save_views",
    "select",
    "show_progress",
    "simplify",
    "up_of",
    "view",
]

_HOMES = {
    "_core": ("__version__",),
    "scene.cameras": ("Camera", "Cameras", "look_at"),
    "errors": ("G2ardError", "InputError", "MissingDependencyError", "OutputError"),
    "io.types": ("Points",),
    "pipeline.config": ("DistillConfig", "SelectConfig"),
    "pipeline.presets": ("preset",),
    "pipeline.distill": ("Distilled",),
    "levels": ("Georeference", "save_levels"),
    "jobs.clean": ("Cleaned", "clean"),
    "jobs.convert": ("convert",),
    "jobs.distill": ("distill",),
    "jobs.distill_options": ("DistillOptions",),
    "jobs.levels": ("lod", "save_tileset"),
    "jobs.notebook": ("view",),
    "jobs.recover": ("recover",),
    "jobs.register": ("register",),
    "jobs.simplify": ("simplify",),
    "jobs.run_views": ("orbit",),
    "jobs.viewer_frame": ("up_of",),
    "poses": ("make_pool",),
    "progress": ("show_progress",),
    "scene.splats": ("Splats",),
    "pipeline.adapt": ("AdaptConfig", "Adapted", "adapt"),
    "stages.evaluate": ("Evaluation", "evaluate"),
    "stages.lift": ("lift",),
    "stages.recover.rasterize": ("rasterize",),
    "stages.recover.config": ("FitConfig", "RecoverConfig"),
    "stages.recover.optimize": ("Recovered",),
    "stages.recover.anchors": ("Regularizers",),
    "stages.register": ("RegisterConfig", "Registered"),
    "rendering.renderer": ("RasterSettings", "Rendered", "Renderer", "render"),
    "stages.select": ("CoverageOptions", "Selection", "select"),
    "stages.simplify": ("Simplified", "SimplifyConfig"),
    "rendering.targets": ("Photos", "TeacherRenders"),
    "tiles.ingest": ("ingest",),
    "io.tile_store": ("TileStore",),
}
"""Module → its public names."""

_ALIASES = {
    "distill_against": ("pipeline.distill", "distill"),
    "load": ("io", "read_splats"),
    "load_points": ("io", "read_points"),
    "load_views": ("io", "read_views"),
    "save": ("io", "write_splats"),
    "save_views": ("io", "write_views"),
}
"""Public name → module, name in the module."""


def __getattr__(name: str) -> Any:
    home, own = _ALIASES.get(
        name, (next((m for m, names in _HOMES.items() if name in names), None), name)
    )
    if home is None:
        raise AttributeError(f"module 'g2ard' has no attribute {name!r}")
    if name == "rasterize":
        from g2ard.errors import require_torch

        require_torch("g2ard.rasterize")
    from importlib import import_module

    try:
        found = getattr(import_module(f"g2ard.{home}"), own)
    except ModuleNotFoundError as error:
        from g2ard.errors import explained

        raise explained(error) from None
    if type(found) is type(__getattr__):
        from g2ard.config.checks import checks_arguments

        found = checks_arguments(found)
    globals()[name] = found
    return found


def _html_of(shown: Any) -> str:
    from g2ard.jobs.notebook import write_html

    return write_html(shown)


Shown._html_of = _html_of


def __dir__() -> list[str]:
    return sorted(__all__)
