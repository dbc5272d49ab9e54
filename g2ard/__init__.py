"""g2ard: distil a dense 3D Gaussian scene into a compact, standard 3DGS model at an exact budget.

Each stage is a module with a function of its name, or nearly so:

| module | function |
|---|---|
| `g2ard.stages.lift` | `lift`: coloured points → surface-aligned discs |
| `g2ard.stages.simplify` | `simplify`: fewer Gaussians, at an exact count |
| `g2ard.poses` | `make_pool`: views for a scene that has none |
| `g2ard.stages.select` | `select`: the views worth having |
| `g2ard.stages.recover` | `recover`: a fixed set of Gaussians against photos or a teacher's renders |
| `g2ard.stages.adapt` | `adapt`: new appearance on frozen geometry |
| `g2ard.pipeline` | `distill`: all of it |
| `g2ard.stages.render`, `g2ard.stages.evaluate` | `render`, `visibility`; `evaluate` |
| `g2ard.synth` | `city`: a procedural city |

What they pass on, and files, are here: `Splats`, `Cameras`, `read_splats`, `write_splats`, `read_points`,
`read_views`, `write_views`; and `preset`, which holds the paper's configuration of every stage. Nothing heavy
loads before it is used.
"""

from __future__ import annotations

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from g2ard.cameras import Cameras
    from g2ard.io import read_points, read_splats, read_views, write_splats, write_views
    from g2ard.presets import preset
    from g2ard.splats import Splats

__version__ = "0.1.0"

__all__ = [
    "Cameras",
    "Splats",
    "__version__",
    "preset",
    "read_points",
    "read_splats",
    "read_views",
    "write_splats",
    "write_views",
]

_HOMES = {"Splats": "g2ard.splats", "Cameras": "g2ard.cameras", "preset": "g2ard.presets"}


def __getattr__(name: str) -> Any:
    if name in __all__:
        from importlib import import_module

        return getattr(import_module(_HOMES.get(name, "g2ard.io")), name)
    raise AttributeError(f"module 'g2ard' has no attribute {name!r}")
