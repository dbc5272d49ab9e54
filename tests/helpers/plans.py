"""Plans of views that tests share: planning is a pure function, and most of the time of a short run."""

from collections import OrderedDict
from dataclasses import replace
from functools import cache
from typing import Any

import pytest

from g2ard.poses.pool import Pool, plan_pool
from g2ard.progress import Progress, silent
from g2ard.scene.splats import Splats

_IMPORTERS = ("poses", "jobs.clean", "jobs.measured_budget")
"""Modules in which jobs find `plan_pool`."""
_MOST = 12
"""Plans that are kept."""

_plans: OrderedDict[str, Pool] = OrderedDict()


def share_plans(monkeypatch: pytest.MonkeyPatch) -> None:
    """Plan the views of a scene once in this process; tests/poses tests that plans are the same each time."""
    for name in _IMPORTERS:
        monkeypatch.setattr(f"g2ard.{name}.plan_pool", _shared)


def _shared(splats: Splats, *count: int, progress: Progress = silent, **options: Any) -> Pool:
    key = f"{splats.fingerprint()} {count} {sorted(options.items())}"
    if key in _plans:
        _plans.move_to_end(key)
        for stage in ("scene", "poses"):
            progress(stage, 1, 1)
        return _plans[key]
    pool = plan_pool(splats, *count, progress=progress, **options)
    _plans[key] = replace(pool, more=cache(pool.more))
    while len(_plans) > _MOST:
        _plans.popitem(last=False)
    return _plans[key]
