"""Every list of names is the keys of what it names."""

from typing import get_args

import pytest

from g2ard.config import choices
from g2ard.errors import InputError
from g2ard.io.scene_formats import FORMATS
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats
from g2ard.stages.recover.anchors import PAPER_REGULARIZERS, REGULARIZERS
from g2ard.stages.recover.loop import _engine_class
from g2ard.stages.recover.schedule import SCHEDULES
from g2ard.stages.select import select
from g2ard.stages.simplify import SimplifyConfig


def test_every_list_of_names_matches_its_table() -> None:
    assert tuple(SCHEDULES) == choices.SCHEDULE_NAMES
    assert set(FORMATS) == set(get_args(choices.FormatName))
    presets = {"auto", *REGULARIZERS, "paper", *(f"paper-{name}" for name in PAPER_REGULARIZERS)}
    assert set(get_args(choices.PresetName)) == presets
    for method in choices.METHODS:
        assert SimplifyConfig(method).rounds(9, 3)


def test_other_names_are_refused_with_the_list() -> None:
    scene, views = Splats.create([[0, 0, 0]], scales=[[1, 1, 1]]), Cameras.from_lists([], [], [], [])
    with pytest.raises(InputError, match=r"expected auto, directional, .*, uniform, got 'best'"):
        select(scene, views, 1, policy="best")
    with pytest.raises(InputError, match=r"engine: expected fused, torch, gsplat, got 'jax'"):
        _engine_class("jax")
