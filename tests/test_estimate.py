"""What `distill --dry-run` says: counts exactly, seconds and bytes about."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

import g2ard
from g2ard.policy.budget import Budget
from g2ard.policy.distill import prepare
from g2ard.policy.estimate import estimate

CommandLine = Callable[..., tuple[int, str, str]]


def ball(count: int = 900) -> g2ard.Splats:
    points = np.random.default_rng(0).normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return g2ard.Splats.create(points, scales=np.full((count, 3), 0.05), logit_opacities=np.full(count, 4))


def test_a_dry_run_counts_what_the_run_takes_and_writes_nothing(
    tmp_path: Path, command_line: CommandLine
) -> None:
    g2ard.save(tmp_path / "ball.ply", ball())
    ask = ("distill", "ball.ply", "-r", "10", "-o", "run", "--steps", "12", "--size", "48", "--json", "-")
    status, out, error = command_line(*ask, "--dry-run", cwd=tmp_path)
    assert status == 0, error
    assert [path.name for path in tmp_path.iterdir()] == ["ball.ply"]
    (told,) = json.loads(out)["runs"]
    status, out, error = command_line(*ask, cwd=tmp_path)
    assert status == 0, error
    ran = json.loads(out)
    assert told["count"] == ran["output_count"] == 90
    assert told["steps"] == ran["rounds"][-1]["recover"][-1]["steps"] == 12
    views = len(g2ard.load_views(tmp_path / "run" / "views.json"))
    assert views < told["views"] <= views + 24  # those of another kind are in no file
    assert told["total_seconds"] == sum(told["seconds"].values()) > 0
    assert told["pixels"] == 48 * 36


def test_memory_grows_by_views_and_gaussians_and_a_time_limit_is_kept() -> None:
    job = prepare(ball(), [Budget(90, None)], steps=3, size=48, time_limit=7.0)
    few, many = estimate(job, 90), estimate(job, 450)
    assert many.bytes - few.bytes == 983 * 360
    assert few.bytes > 12 * few.views * few.pixels
    assert few.seconds["recover"] == 7.0
