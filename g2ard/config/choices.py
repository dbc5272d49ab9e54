"""What callers choose by name: the one list of each that functions, options, configs and studies share.

Nothing is imported here, so that `--help` can say what there is.
"""

from __future__ import annotations

from typing import Literal, get_args

Colour = tuple[float, float, float]
"""RGB in [0, 1]."""
BLACK: Colour = (0.0, 0.0, 0.0)
"""The background behind a scene unless another is given."""

Method = Literal["default", "fast", "paper"]
"""Of simplification."""
METHODS: tuple[Method, ...] = get_args(Method)

Policy = Literal["auto", "directional", "coverage", "pose-diverse", "random", "uniform"]
"""Of view selection."""
POLICIES: tuple[Policy, ...] = get_args(Policy)

UNMEASURED: tuple[Policy, ...] = ("random", "uniform")
"""Policies that measure nothing, and so cannot say how many views are enough."""

PoolKind = Literal["auto", "orbit", "walk", "aerial", "inside", "focus"]
"""Poses that are made (`g2ard.poses.make_pool`)."""
POOL_KINDS: tuple[PoolKind, ...] = get_args(PoolKind)

ScheduleName = Literal["fast", "default", "best", "paper"]
"""Schedules of recovery (`g2ard.stages.recover.schedule`)."""
SCHEDULE_NAMES: tuple[ScheduleName, ...] = get_args(ScheduleName)

PaperPresetName = Literal["paper", "paper-trained", "paper-lift", "paper-noisy"]
"""The paper's regularisers, for a prior that is measured or named."""
PresetName = Literal["auto", "trained", "lift", "noisy", PaperPresetName]
"""Which regularisers hold a prior's geometry (`g2ard.stages.recover.presets`)."""

Engine = Literal["fused", "torch", "gsplat"]
"""What takes recovery's steps (`g2ard.stages.recover.engine`)."""
ENGINES: tuple[Engine, ...] = get_args(Engine)

AdaptSchedule = Literal["default", "paper"]
"""Schedules of adaptation (`g2ard.pipeline.adapt`)."""
ADAPT_SCHEDULES: tuple[AdaptSchedule, ...] = get_args(AdaptSchedule)

Refinement = Literal["auto", "none", "photometric", "exact"]
"""What follows a photo's pose from features (`g2ard.stages.register`)."""
REFINEMENTS: tuple[Refinement, ...] = get_args(Refinement)

Keep = Literal["registered", "uncertain", "all"]
"""Which photos' poses registration keeps."""

Convention = Literal["gsplat", "inria"]
"""Whose renderer is followed where renderers differ (`g2ard.rendering.renderer`)."""
CONVENTIONS: tuple[Convention, ...] = get_args(Convention)

LpipsInput = Literal["scaled", "unscaled"]
"""The range that LPIPS's networks see (`g2ard.rendering.lpips`)."""
LPIPS_INPUTS: tuple[LpipsInput, ...] = get_args(LpipsInput)

FormatName = Literal["ply", "sog", "spz", "glb", "compressed.ply", "splat"]
"""Files that scenes are written to (`g2ard.io.scene_formats`)."""
