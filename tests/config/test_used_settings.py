"""No setting is silently ignored: it changes the result of every method, or is refused with a reason."""

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
import pytest

import g2ard
from g2ard.config.choices import POLICIES
from g2ard.config.schema import values_of
from g2ard.io import Source
from g2ard.io.types import ViewSet
from g2ard.jobs.budget import Budget
from g2ard.jobs.distill import open_job
from g2ard.jobs.distill_options import DistillOptions
from g2ard.jobs.inputs import GivenViews
from g2ard.jobs.simplify import open_reduction
from g2ard.jobs.tile_options import Tiling
from g2ard.pipeline.adapt import freeze_geometry
from g2ard.pipeline.dense import load_whole
from g2ard.pipeline.presets import configure
from g2ard.scene.splats import SH_C0
from g2ard.stages.lift import LiftConfig
from g2ard.stages.recover.config import Schedule
from g2ard.stages.simplify import Default, Fast, Paper
from g2ard.tiles.ingest import ingest
from helpers.feature_scenes import blotched
from helpers.photos import photographed
from helpers.registration import off
from helpers.scenes import around, checkered_ball

VIEWS = around(8, (48, 36))


def _uneven(count: int) -> g2ard.Splats:
    rng = np.random.default_rng(1)
    ball = checkered_ball(count)
    scales = ball.scales * np.exp(rng.normal(0, 0.7, (count, 3))).astype(np.float32)
    return replace(ball, logit_opacities=rng.normal(-1, 3, count).astype(np.float32), scales=scales)


SCENE = _uneven(900)
SMALL = g2ard.simplify(SCENE, count=60, blind=True).splats
TARGETS = g2ard.TeacherRenders(SCENE, VIEWS)

SIMPLIFY: dict[str, Any] = {
    "retention": 0.5,
    "fold": 0.9,
    "min_opacity": 0.3,
    "morton_premerge_ratio": 1.5,
    "morton_premerge_steps": 3,
    "longest_run": 1.0,
    "edge_weight": 50.0,
    "neighbors": 3,
    "geometric_weight": 0.0,
    "dilation": 2.0,
    "pixel_scale": 20.0,
    "surface_depth": 30.0,
    "max_growth": 1.0,
    "keep_region": ((0, 0, 1, 0.8),),
    "keep_times": 16.0,
    "color_bin": 2.0,
    "max_energy": 0.0,
    "min_coverage": 2.0,
    "support": 0.5,
    "flag_threshold": 1e-6,
    "flag_members": 1,
    "protection": 9.0,
}
RECOVER: dict[str, Any] = {
    "sh_degree": 2,
    "ssim_weight": 0.9,
    "background": (1.0, 0.5, 0.0),
    "seed": 1,
    "schedule.rates.means": 0.5,
    "schedule.rates.log_scales": 0.5,
    "schedule.rates.quats": 0.5,
    "schedule.rates.logit_opacities": 0.5,
    "schedule.rates.sh0": 0.5,
    "schedule.rates.shN": 0.5,
    "schedule.final_rate": 0.9,
    "schedule.appearance_decay": (0.5, 0.5),
    "schedule.multiplier": 0.1,
    "schedule.reach": 1e-3,
    "schedule.finest": 9.0,
    "schedule.momentum": 0.1,
    "schedule.reference_extent": 0.5,
    "schedule.guarded": False,
    "steps": 9,
    "recovery_time": 0.02,
    "regularizers.anchor": 50.0,
    "regularizers.shape": 50.0,
    "regularizers.effective_rank": True,
    "regularizers.thickness": 50.0,
    "regularizers.rank_offset": 0.2,
    "regularizers.period": 2,
    "regularizers.in_plane": 0.01,
}
ADAPT: dict[str, Any] = {
    "sh_degree": 2,
    "ssim_weight": 0.9,
    "background": (1.0, 0.5, 0.0),
    "seed": 1,
    "steps": 9,
    "tolerance": 50.0,
    "schedule": "paper",
    "prior_views": 9.0,
    "first_stretch": 1,
    "colour_worth": 99.0,
    "recovery": replace(freeze_geometry(Schedule.named("paper")), final_rate=0.5),
}
REGISTER: dict[str, Any] = {
    "size": 100,
    "align_size": 64,
    "refine": "none",
    "passes": 1,
    "coarsest": 64,
    "iterations": 1,
    "still": 1.0,
    "accept": 1.0,
    "doubt": 1.0,
    "max_angle_sigma": 1e-6,
    "max_position_sigma": 1e-9,
    "min_alpha": 0.99,
    "max_edge": 1e-3,
    "min_overlap": 0.9,
    "window": 5,
    "candidates": 1,
    "pool_size": 16,
    "focal_sigma": 0.05,
    "correlated": 1.0,
    "features": 10,
    "ratio": 0.3,
    "max_reprojection": 0.5,
    "min_inliers": 100,
    "fallback": False,
    "alike": 1.0,
}
LIFT: dict[str, Any] = {
    "neighbors": 5,
    "spread": 2.0,
    "normal_ratio": 0.5,
    "max_anisotropy": 1.5,
    "opacity": 0.9,
}
SELECT: dict[str, Any] = {
    "cells": 50,
    "kappa": 1.0,
    "alpha": 0.1,
    "offset": 5.0,
    "anchors": 4,
    "epsilon": 9.0,
    "depth_tolerance": 0.5,
}


def _simplified(method: str, **how: Any) -> Callable[[Mapping[str, Any]], object]:
    def run(settings: Mapping[str, Any]) -> object:
        return g2ard.simplify(
            SCENE, count=80, method=method, settings=settings, **how
        ).splats.fingerprint()

    return run


def _recovered(settings: Mapping[str, Any]) -> object:
    return g2ard.recover(SMALL, TARGETS, **settings).splats.fingerprint()


def _selected(policy: str) -> Callable[[Mapping[str, Any]], object]:
    def run(settings: Mapping[str, Any]) -> object:
        named = {f"select.{name}": value for name, value in settings.items()}
        chosen_by = {"policy": policy, "views_count": 5}
        options = configure(g2ard.DistillConfig(), settings={**chosen_by, **named}).select
        chosen = g2ard.select(SCENE, VIEWS, 5, policy=policy, options=options)
        return chosen.order.tolist(), chosen.gains.tolist()

    return run


def _lifted(settings: Mapping[str, Any]) -> object:
    colors = np.full((len(SCENE), 3), 0.5)
    return g2ard.lift(SCENE.means, colors, **settings).fingerprint()


def _adapted(settings: Mapping[str, Any]) -> object:
    config = configure(
        g2ard.AdaptConfig(), settings={f"adapt.{name}": v for name, v in settings.items()}
    )
    return g2ard.adapt(SMALL, TARGETS, config).splats.fingerprint()


@cache
def _photos() -> tuple[g2ard.Splats, g2ard.Cameras]:
    scene, folder = blotched(2500), Path(mkdtemp())
    return scene, photographed(folder, scene, around(2, (160, 120), 2.5), gain=0.7, bias=0.1)


def _registered(settings: Mapping[str, Any]) -> object:
    """Register a photo from a pose near its own, and one from a pool."""
    scene, photos = _photos()
    start = {photos.names[0]: off(photos.viewmats[0], 0.08, 2, 0)}
    named = {f"register.{name}": value for name, value in settings.items()}
    pool = around(6, (160, 120), 2.8)
    done = g2ard.register(scene, photos, poses=start, pool=pool, settings=named, keep="all").report
    return [repr(vars(replace(photo, seconds=0.0))) for photo in done.photos]


DISTILL: dict[str, Any] = {
    **{f"simplify.{name}": value for name, value in SIMPLIFY.items()},
    **{f"recover.{name}": value for name, value in RECOVER.items()},
    **{f"lift.{name}": value for name, value in LIFT.items()},
    **{f"select.{name}": value for name, value in SELECT.items()},
    "select.views_count": 5,
    "select.policy": "directional",
    "select.weighted": False,
    "select.reselect": True,
    "select.focus": "near",
    "select.focus_share": 0.25,
}
HANDED_ON = {
    "simplify.fold",
    "recover.ssim_weight",
    "recover.regularizers.anchor",
    "recover.schedule.reach",
}
FEW = {
    name: value
    for name, value in DISTILL.items()
    if name.startswith("select.") or name in HANDED_ON
}
"""Settings that a whole distillation is tried with: stages get theirs as one object, so few tell for all."""
_REACHING_TILES = (
    "simplify.fold recover.background recover.sh_degree select.policy select.views_count"
)
IN_TILES = {name: DISTILL[name] for name in _REACHING_TILES.split()}
"""Settings that a distillation in tiles is tried with: one of each stage, and what its targets depend on."""
_OF_TILES = "retention fold min_opacity morton_premerge_ratio dilation keep_region protection"
OF_TILES = {name: SIMPLIFY[name] for name in _OF_TILES.split()}
"""Settings that a simplification in tiles is tried with: it takes the same object as one in memory."""
UNEVEN = ViewSet(VIEWS, splits=("train",) * 7 + ("test",), weights=np.arange(8.0) ** 2)
BUDGET = 80


FAR = {"select.focus": "far"}  # plans no views of other kinds to train on, which takes longest


def _distilled(settings: Mapping[str, Any]) -> object:
    settings = {**FAR, **settings}
    return g2ard.distill(
        SCENE, count=BUDGET, views=UNEVEN, size=48, settings=settings
    ).splats.fingerprint()


@cache
def _tiles() -> tuple[Path, Tiling]:
    folder = Path(mkdtemp())
    g2ard.save(folder / "scene.ply", SCENE)
    ingest(folder / "scene.ply", folder / "tiles", tile_rows=len(SCENE) // 2)
    return folder / "tiles", Tiling(workers=1, folder=folder / "work")


def _simplified_in_tiles(settings: Mapping[str, Any]) -> object:
    scene, tiling = _tiles()
    config = configure(g2ard.SimplifyConfig(), settings=settings)
    with open_reduction(Source(scene), tiling, given=GivenViews(UNEVEN), config=config) as reduce:
        return load_whole(reduce(BUDGET).splats).fingerprint()


def _distilled_in_tiles(settings: Mapping[str, Any]) -> object:
    scene, tiling = _tiles()
    options = DistillOptions(views=UNEVEN, size=48, settings={**FAR, **settings})
    with open_job(Source(scene), Budget(count=BUDGET), options, tiling) as job:
        return job.run().splats.fingerprint()


PRIORS = ("trained", "lift")  # noisy has the terms of lift
RUNS: dict[str, tuple[Callable[[Mapping[str, Any]], object], dict[str, Any]]] = {
    **{method: (_simplified(method, views=VIEWS), SIMPLIFY) for method in ("default", "fast")},
    **{
        f"{method} blind": (_simplified(method, blind=True), SIMPLIFY)
        for method in ("default", "fast")
    },
    "paper": (_simplified("paper"), SIMPLIFY),
    "default in tiles": (_simplified_in_tiles, OF_TILES),
    **{f"recover {kind}": (_recovered, RECOVER) for kind in PRIORS},
    **{policy: (_selected(policy), SELECT) for policy in POLICIES},
    "lift": (_lifted, LIFT),
    **dict.fromkeys(("adapt", "adapt paper"), (_adapted, ADAPT)),
    **dict.fromkeys(("register sift", "register direct"), (_registered, REGISTER)),
    "distill": (_distilled, FEW),
    "distill in tiles": (_distilled_in_tiles, IN_TILES),
}
RECOVERY: dict[str, Any] = {"steps": 6, "regularizers.period": 1, "regularizers.shape": 1.0}
RECOVERY_BESIDE: dict[str, dict[str, Any]] = {
    "recovery_time": {"steps": None},
    "schedule.guarded": {"steps": 24, "schedule.multiplier": 30.0},
    "regularizers.rank_offset": {"regularizers.effective_rank": True},
    "regularizers.effective_rank": {"regularizers.effective_rank": False},
}
BESIDE: dict[str, dict[str, Any]] = {
    **{f"recover {kind}": {**RECOVERY, "regularizers": kind} for kind in PRIORS},
    **{
        f"recover {kind}: {name}": beside
        for kind in PRIORS
        for name, beside in RECOVERY_BESIDE.items()
    },
    "adapt": {"steps": 6, "first_stretch": 2, "tolerance": 0.0, "colour_worth": 0.0},
    "adapt paper": {"steps": 6, "schedule": "paper"},
    "adapt paper: schedule": {"schedule": "default"},
    "register sift": {"matcher": "sift", "size": 160, "align_size": 96},
    "register direct": {"matcher": "direct", "size": 160, "align_size": 128},
    **{
        f"{run}{of}": {f"recover.{name}": value for name, value in beside.items()}
        for run in ("distill", "distill in tiles")
        for of, beside in {
            "": {**RECOVERY, "regularizers": "trained", "schedule.guarded": False},
            **{f": recover.{name}": beside for name, beside in RECOVERY_BESIDE.items()},
            ": recover.schedule.guarded": {
                **RECOVERY_BESIDE["schedule.guarded"],
                "schedule.guarded": True,
            },
        }.items()
    },
    "paper: max_energy": {"color_bin": 1.0},
    "paper: protection": {"flag_threshold": 0.1},
}
"""Run, or run and setting → other settings, with which it matters."""


@cache
def _usual(run: str, setting: str) -> object:
    return RUNS[run][0](_beside(run, setting))


def _beside(run: str, setting: str) -> dict[str, Any]:
    return {**BESIDE.get(run, {}), **BESIDE.get(f"{run}: {setting}", {})}


@pytest.mark.parametrize(
    ("run", "setting"), [(run, name) for run, (_, table) in RUNS.items() for name in table]
)
def test_a_setting_changes_the_result_or_is_refused(run: str, setting: str) -> None:
    function, table = RUNS[run]
    try:
        result = function({**_beside(run, setting), setting: table[setting]})
    except g2ard.InputError as error:
        result = str(error)
    if isinstance(result, str) and setting.rpartition(".")[2] in result.replace("-", "_"):
        assert re.search("has no effect|needs views", result)
    else:
        assert result != _usual(run, setting if f"{run}: {setting}" in BESIDE else "")


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"policy": "directional"}, "select.policy: has no effect without views_count"),
        ({"pixel_scale": 2.0}, "simplify.pixel_scale: has no effect with views"),
    ],
)
def test_distill_refuses_settings_without_effect(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(g2ard.InputError, match=words):
        g2ard.distill(SCENE, ratio=10, views=VIEWS, steps=1, settings=settings)


def test_values_of_a_preset_may_have_no_effect() -> None:
    configure(g2ard.DistillConfig(), "paper", {"method": "fast", "views_count": None})
    with pytest.raises(g2ard.InputError, match="has no effect on the method fast"):
        configure(g2ard.SimplifyConfig(), "paper", {"method": "fast", "fold": 0.5})


_BESIDES = "method engine matcher schedule.steps schedule.for_renders schedule.round_steps schedule.means_in_scales"
"""Settings that choose a run, or that only its schedule sets."""


def test_the_tables_hold_every_setting() -> None:
    paper = g2ard.DistillConfig(g2ard.SelectConfig("directional"), Paper())
    for root, configs, table in (
        ("simplify.", (Default(), Fast(), Paper()), SIMPLIFY),
        ("recover.", (g2ard.RecoverConfig(),), RECOVER),
        ("select.", (g2ard.CoverageOptions(),), SELECT),
        ("lift.", (LiftConfig(),), LIFT),
        ("adapt.", (g2ard.AdaptConfig(),), ADAPT),
        ("register.", (g2ard.RegisterConfig(),), REGISTER),
        ("", (g2ard.DistillConfig(), paper), DISTILL),
    ):
        besides = tuple(f".{name}" for name in _BESIDES.split())
        named = {
            path for config in configs for path in values_of(config) if not path.endswith(besides)
        }
        # set as a whole
        named = {re.sub(r"^adapt.recovery\..*", "adapt.recovery", path) for path in named}
        named = {f"{root}{path.partition('.')[2]}" for path in named} if root else named
        assert named == {f"{root}{name}" for name in table}


@pytest.mark.parametrize("root", [g2ard.SimplifyConfig, g2ard.SelectConfig])
def test_a_variant_has_only_its_own_settings(root: Any) -> None:
    tag, path = root._tag, root.__name__.removesuffix("Config").lower()
    every = {
        name: value for kind in root._variants.values() for name, value in vars(kind()).items()
    }
    for variant in root._variants:
        own = root(variant)
        for name in every.keys() - vars(own).keys():
            for make in (
                lambda: root(**{tag: variant, name: every[name]}),  # noqa: B023
                lambda: configure(root(), settings={f"{path}.{tag}": variant, name: every[name]}),  # noqa: B023
            ):
                with pytest.raises(
                    g2ard.InputError, match=rf"{name}: has no effect on the {tag} {variant}, only"
                ):
                    make()
        assert own.turned("paper" if tag == "method" else "directional").turned(variant) == own


def test_given_weights_of_regularisers_are_used() -> None:
    weights = g2ard.Regularizers.of("lift")
    common: dict[str, Any] = {"views": VIEWS, "steps": 2}
    told: list[str] = []
    settings = {"recover.regularizers": weights, **FAR}
    whole = g2ard.distill(SCENE, ratio=10, say=told.append, settings=settings, **common)
    named = g2ard.distill(SCENE, ratio=10, regularizers="lift", settings=FAR, **common)
    assert whole.splats.fingerprint() == named.splats.fingerprint()
    assert "regularisers: as given" in told
    again, named = (
        g2ard.recover(SMALL, teacher=SCENE, **common, settings={"recover.regularizers": value})
        for value in (weights, "lift")
    )
    assert again.splats.fingerprint() == named.splats.fingerprint()


def test_recover_measures_which_weights_suit_the_scene() -> None:
    ball = checkered_ball(900)
    discs = g2ard.lift(ball.means, np.clip(0.5 + SH_C0 * ball.sh0[:, 0], 0, 1))
    small = g2ard.simplify(discs, count=60, blind=True).splats
    given: dict[str, Any] = {
        "teacher": discs,
        "views": VIEWS,
        "steps": 6,
        "settings": {"period": 1},
    }
    lift, trained, measured = (
        g2ard.recover(small, **given, regularizers=kind).splats.fingerprint()
        for kind in ("lift", "trained", None)
    )
    assert measured == lift != trained
