"""g2ard: distil a dense 3D Gaussian scene into a compact, standard 3DGS model at an exact budget.

| function | does |
|---|---|
| `load`, `save` | scenes, by extension |
| `load_views`, `save_views`, `load_points` | cameras, and coloured clouds |
| `distill` | the whole job, as `g2ard distill` does it |
| `distill_against` | the same on a scene, against targets of one's own |
| `ingest` | a scene or cloud of any size → tiles in a folder |
| `lift` | coloured points → surface-aligned discs |
| `simplify` | fewer Gaussians, at an exact count, as `g2ard simplify` does it |
| `make_pool`, `select` | views for a scene that has none; the views worth having |
| `recover` | a fixed set of Gaussians against photos or a teacher's renders |
| `adapt` | new appearance on frozen geometry |
| `register` | poses of photos, by aligning renders with them |
| `lod`, `save_levels` | levels of detail, as streamed SOG |
| `render`, `Renderer`, `evaluate` | images, depths; PSNR, SSIM |

They pass on `Splats`, a `Camera` or many `Cameras`, coloured `Points`, and targets: `Photos`,
`TeacherRenders`, or anything that has `cameras` and gives an image for each. Configurations
of stages are dataclasses (`SimplifyConfig`, `RecoverConfig`, …); `preset` holds the paper's. What stages do
with them is in `g2ard.stages`, how they are joined in `g2ard.pipeline`. All errors are `G2ardError`s.

Nothing heavy loads before it is used.

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

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from g2ard._core import __version__
    from g2ard.config.presets import preset
    from g2ard.errors import G2ardError, InputError, MissingDependencyError, OutputError
    from g2ard.io import Points
    from g2ard.io import read_points as load_points
    from g2ard.io import read_splats as load
    from g2ard.io import read_views as load_views
    from g2ard.io import write_splats as save
    from g2ard.io import write_views as save_views
    from g2ard.levels import save_levels
    from g2ard.pipeline import DistillConfig, Distilled, SelectConfig
    from g2ard.pipeline import distill as distill_against
    from g2ard.pipeline.adapt import AdaptConfig, Adapted, adapt
    from g2ard.policy.distill import distill
    from g2ard.policy.distill_options import DistillOptions
    from g2ard.policy.levels import lod
    from g2ard.policy.simplify import simplify
    from g2ard.poses import make_pool
    from g2ard.rendering.renderer import RasterSettings, Rendered, Renderer, render
    from g2ard.scene.cameras import Camera, Cameras, look_at
    from g2ard.scene.splats import Splats
    from g2ard.scene.targets import Photos, TeacherRenders
    from g2ard.stages.evaluate import Evaluation, evaluate
    from g2ard.stages.lift import lift
    from g2ard.stages.recover import RecoverConfig, Recovered, recover
    from g2ard.stages.recover.anchors import Regularizers
    from g2ard.stages.register import RegisterConfig, Registered, register
    from g2ard.stages.select import CoverageOptions, Selection, select
    from g2ard.stages.simplify import Simplified, SimplifyConfig
    from g2ard.tiles.ingest import ingest
    from g2ard.tiles.store import TileStore

__all__ = [
    "AdaptConfig",
    "Adapted",
    "Camera",
    "Cameras",
    "CoverageOptions",
    "DistillConfig",
    "DistillOptions",
    "Distilled",
    "Evaluation",
    "G2ardError",
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
    "preset",
    "recover",
    "register",
    "render",
    "save",
    "save_levels",
    "save_views",
    "select",
    "simplify",
]

_HOMES = {
    "_core": ("__version__",),
    "scene.cameras": ("Camera", "Cameras", "look_at"),
    "errors": ("G2ardError", "InputError", "MissingDependencyError", "OutputError"),
    "io.types": ("Points",),
    "pipeline": ("DistillConfig", "Distilled", "SelectConfig"),
    "levels": ("save_levels",),
    "policy.distill": ("distill",),
    "policy.distill_options": ("DistillOptions",),
    "policy.levels": ("lod",),
    "policy.simplify": ("simplify",),
    "poses": ("make_pool",),
    "config.presets": ("preset",),
    "scene.splats": ("Splats",),
    "pipeline.adapt": ("AdaptConfig", "Adapted", "adapt"),
    "stages.evaluate": ("Evaluation", "evaluate"),
    "stages.lift": ("lift",),
    "stages.recover": ("RecoverConfig", "Recovered", "recover"),
    "stages.recover.anchors": ("Regularizers",),
    "stages.register": ("RegisterConfig", "Registered", "register"),
    "rendering.renderer": ("RasterSettings", "Rendered", "Renderer", "render"),
    "stages.select": ("CoverageOptions", "Selection", "select"),
    "stages.simplify": ("Simplified", "SimplifyConfig"),
    "scene.targets": ("Photos", "TeacherRenders"),
    "tiles.ingest": ("ingest",),
    "tiles.store": ("TileStore",),
}
"""Module → what it gives under its own name."""

_ALIASES = {
    "distill_against": ("pipeline", "distill"),
    "load": ("io", "read_splats"),
    "load_points": ("io", "read_points"),
    "load_views": ("io", "read_views"),
    "save": ("io", "write_splats"),
    "save_views": ("io", "write_views"),
}
"""Name → module, and what that calls it."""


def __getattr__(name: str) -> Any:
    home, own = _ALIASES.get(name, (next((m for m, names in _HOMES.items() if name in names), None), name))
    if home is None:
        raise AttributeError(f"module 'g2ard' has no attribute {name!r}")
    from importlib import import_module

    found = getattr(import_module(f"g2ard.{home}"), own)
    globals()[name] = found  # asked for once
    return found


def __dir__() -> list[str]:
    return sorted(__all__)
