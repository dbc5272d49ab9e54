"""Plans of views that tests share: planning is a pure function, and most of the time of a short run."""

import hashlib
import os
import pickle
import tempfile
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from importlib import import_module
from os import replace as put_in_place  # the original: tests of interruptions count its calls
from pathlib import Path
from typing import Any

import pytest

from g2ard.poses import matter
from g2ard.poses.pool import Pool, plan_pool
from g2ard.poses.showing import best_views
from g2ard.progress import Progress, silent
from g2ard.scene.cameras import Camera, Cameras
from g2ard.scene.splats import Splats

FOLDER = "G2ARD_TEST_PLANS"
"""Variable of the environment: a folder in which all processes of a run of the tests keep plans."""
_IMPORTERS = [
    *("g2ard.poses", "g2ard.jobs.clean", "g2ard.jobs.register"),
    *("g2ard.jobs.close_up", "g2ard.jobs.format_loss"),
    *("g2ard.jobs.run_views", "benchmarks.views", "benchmarks.kinds.select"),
]
"""Modules that have `plan_pool`."""
_SHOWING = [
    "g2ard.jobs.run_views",
    "g2ard.jobs.notebook",
    "g2ard.jobs.viewer_frame",
    "g2ard.jobs.scoring",
]
"""Modules that have `best_views`."""
_MOST = 100
"""Plans that are kept in memory."""
SIZE = (440, 330)
"""Size of generated views in tests that draw hundreds: a third of the usual pixels; `clean` draws at 400."""
_USUAL_SIZE = (800, 600)
"""Size of generated views that a run plans unless another one is requested."""
_CELLS = (200_000, 6_000_000)
"""Cells of occupancy grids: of small scenes, the usual two million are most of the time of planning."""
_FULL_PIXELS = 4 * SIZE[0] * SIZE[1]
"""Pixels that are scored at full size."""

_plans: OrderedDict[str, Any] = OrderedDict()


def share_plans(monkeypatch: pytest.MonkeyPatch, usual: tuple[int, int] = _USUAL_SIZE) -> None:
    """Plan a scene's views once for all processes, those of the usual size as large as `usual`.

    tests/poses tests that plans are the same each time.
    """
    for name in (*_IMPORTERS, *_SHOWING):  # first all, or one would import another's patch for good
        import_module(name)
    for name in _IMPORTERS:
        monkeypatch.setattr(f"{name}.plan_pool", partial(_shared, usual=usual))
    for name in _SHOWING:
        monkeypatch.setattr(f"{name}.best_views", _shown)


def plan_small_scenes(monkeypatch: pytest.MonkeyPatch, *, coarse: bool = True) -> None:
    """Share plans of smaller views, `coarse` ones in coarser grids, and score few views at full size."""
    share_plans(monkeypatch, SIZE)
    monkeypatch.setattr("g2ard.jobs.run_views.FULL_PIXELS", _FULL_PIXELS)
    if coarse:
        monkeypatch.setattr("g2ard.poses.matter._CELLS", _CELLS)


def _shown(
    splats: Splats, count: int = 1, cameras: Cameras | None = None, **options: Any
) -> Cameras:
    if cameras is not None:
        # has paths of photos, which no key holds
        return best_views(splats, count, cameras, **options)
    key = (
        f"best {splats.fingerprint()} {splats.up} {count} {matter._CELLS} {sorted(options.items())}"
    )
    return _kept(key, lambda: best_views(splats, count, **options))


def _shared(
    splats: Splats,
    *count: int,
    usual: tuple[int, int],
    size: tuple[int, int] = _USUAL_SIZE,
    progress: Progress = silent,
    **options: Any,
) -> Pool:
    options["size"] = usual if size == _USUAL_SIZE else size
    key = f"{splats.fingerprint()} {splats.up} {count} {matter._CELLS} {sorted(options.items())}"
    plan = cache(lambda: plan_pool(splats, *count, progress=progress, **options))

    def more(kind: str, wanted: int) -> list[Camera]:
        return _kept(f"{key} {kind} {wanted}", lambda: plan().more(kind, wanted))

    pool = _kept(key, lambda: replace(plan(), more=_none))
    for stage in ("scene", "poses"):
        progress(stage, 1, 1)
    return replace(pool, more=more)


def _none(kind: str, count: int) -> list[Camera]:
    return []


def _kept(key: str, make: Callable[[], Any]) -> Any:
    """Return what `make` returned for this key, in this process or another one."""
    if key not in _plans:
        path = Path(os.environ.get(FOLDER, "nowhere"), hashlib.sha256(key.encode()).hexdigest())
        _plans[key] = pickle.loads(path.read_bytes()) if path.exists() else make()
        if path.parent.is_dir() and not path.exists():
            with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
                pickle.dump(_plans[key], file)
            put_in_place(file.name, path)
    _plans.move_to_end(key)
    while len(_plans) > _MOST:
        _plans.popitem(last=False)
    return _plans[key]
