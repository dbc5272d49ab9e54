"""Other simplification methods, implemented from their papers at an exact count, without recovery.

`reduce(name, splats, budget, cameras)` runs a method; so does the command `python -m benchmarks.baselines
NAME SCENE COUNT OUT.ply --views VIEWS`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from g2ard.progress import Progress
    from g2ard.scene.cameras import Cameras
    from g2ard.scene.splats import Splats

__all__ = ["METHODS", "NEED_VIEWS", "reduce"]

METHODS = ("random", "opacity-area", "lightgaussian", "pup", "mini-splatting", "nanogs")
NEED_VIEWS = ("lightgaussian", "pup", "mini-splatting")
"""Methods that score Gaussians by training views."""


def reduce(
    name: str,
    splats: Splats,
    budget: int,
    cameras: Cameras | None = None,
    *,
    seed: int = 0,
    indoor: bool = False,
    progress: Progress | None = None,
) -> Splats:
    """Reduce a scene to exactly `budget` Gaussians by a baseline of `METHODS`, without recovery.

    Args:
        name: name of the method.
        splats: the scene.
        budget: Gaussians to keep, 1 to N.
        cameras: training views, for methods in `NEED_VIEWS`.
        seed: seed of random methods (random, Mini-Splatting).
        indoor: whether Mini-Splatting uses its importance for rooms.
        progress: callback per view.

    >>> import numpy as np
    >>> from g2ard.scene.splats import Splats
    >>> scene = Splats.create(np.eye(3), scales=[[1, 1, 1], [2, 2, 2], [3, 3, 3]])
    >>> reduce("opacity-area", scene, 2).scales[:, 0].tolist()
    [2.0, 3.0]
    """
    from g2ard.errors import InputError
    from g2ard.progress import silent

    tell = progress or silent
    if name not in METHODS:
        raise InputError(f"baseline: expected one of {', '.join(METHODS)}, got {name!r}")
    if name in NEED_VIEWS and cameras is None:
        raise InputError(f"{name}: needs training views; give --views")
    if name == "nanogs":
        from benchmarks.baselines.nanogs import nanogs

        return nanogs(splats, budget)
    if name == "random":
        from benchmarks.baselines.simple import random_subset

        return random_subset(splats, budget, seed=seed)
    if name == "opacity-area":
        from benchmarks.baselines.simple import opacity_area

        return opacity_area(splats, budget)
    assert cameras is not None
    if name == "lightgaussian":
        from benchmarks.baselines.lightgaussian import lightgaussian

        return lightgaussian(splats, budget, cameras, progress=tell)
    if name == "pup":
        from benchmarks.baselines.pup import pup

        return pup(splats, budget, cameras, progress=tell)
    from benchmarks.baselines.mini_splatting import mini_splatting

    return mini_splatting(splats, budget, cameras, seed=seed, indoor=indoor, progress=tell)
