"""Settings by dotted path: any config's fields, in config files and reports as on the command line."""

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, get_args

import pytest

from g2ard.config import choices
from g2ard.config.schema import changed, listed, parse_settings
from g2ard.errors import InputError
from g2ard.io import write_splats, write_views
from g2ard.io.scene_formats import FORMATS
from g2ard.pipeline.config import DistillConfig
from g2ard.pipeline.presets import preset
from g2ard.stages.recover.anchors import PAPER_REGULARIZERS, REGULARIZERS
from g2ard.stages.recover.config import PAPER, SCHEDULES
from g2ard.stages.simplify import SimplifyConfig
from helpers.commands import CommandLine, refused, succeeds
from helpers.scenes import around, checkered_ball


@dataclass(frozen=True)
class Inner:
    brand_new: float = 1.0
    edges: tuple[float, float] = (1.0, 2.0)
    worked_out: int = field(default=0, metadata={"setting": False})


@dataclass(frozen=True)
class Outer:
    cells: int | None = None
    mode: Literal["soft", "hard"] = "soft"
    exact: bool = False
    inner: Inner = field(default_factory=Inner)
    brand_new: float = 3.0


def test_a_field_of_any_dataclass_is_a_setting_at_once() -> None:
    texts = [
        "outer.cells=7",
        "edges=0.5,4",
        "exact=true",
        "mode=hard",
        "inner.brand_new=1e-3",
        "cells=none",
    ]
    values = parse_settings(texts, Outer())
    assert changed(Outer(cells=3), values) == Outer(None, "hard", True, Inner(1e-3, (0.5, 4.0)))
    assert changed(Inner(), values) == Inner()
    assert changed(Outer(), {}) == Outer()


def test_the_path_nearest_the_root_is_meant() -> None:
    assert parse_settings(["brand_new=2"], Outer()) == {"outer.brand_new": 2.0}
    assert parse_settings(["steps=3"], DistillConfig()) == {"recover.steps": 3}
    with pytest.raises(InputError, match=r"use simplify\.neighbors or lift\.neighbors"):
        parse_settings(["neighbors=3"], DistillConfig())


def test_a_config_is_set_as_a_whole_by_its_name_and_its_fields_after_it() -> None:
    texts = ["schedule.rates.sh0=1", "recover.schedule=paper", "regularizers=lift"]
    found = changed(DistillConfig(), parse_settings(texts, DistillConfig())).recover
    assert found.schedule == replace(PAPER, rates=replace(PAPER.rates, sh0=1.0))
    assert found.regularizers == REGULARIZERS["lift"]
    with pytest.raises(InputError, match="schedule: expected one of fast"):
        changed(DistillConfig(), {"recover.schedule": "slow"})


def test_regions_are_read_as_text() -> None:
    values = parse_settings(["keep_region=0,0,0,1;0,0,0,1,1,2"], DistillConfig())
    assert values == {"simplify.keep_region": ((0, 0, 0, 1), (0, 0, 0, 1, 1, 2))}
    with pytest.raises(InputError, match="expected X,Y,Z,R"):
        changed(DistillConfig(), {"simplify.keep_region": ((0, 0, 0),)})


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("outer.cells", "PATH=VALUE"),
        ("outer.cells=7.5", "outer.cells: expected a whole number or none, got '7.5'"),
        ("outer.exact=1", "true or false"),
        ("edges=1", "2 comma-separated numbers"),
        ("inner.brand_new=nan", "a number"),
        ("outer.mode=loud", "one of soft, hard"),
        ("inner.brandnew=2", "did you mean outer.inner.brand_new"),
        ("egdes=1,2", "did you mean outer.inner.edges"),
        ("inner.worked_out=1", "unknown setting 'inner.worked_out'"),
        ("qqqqqq=1", "expected one of outer.cells, outer.mode"),
        ("outer.inner.qqqqqq=1", "expected one of outer.inner.brand_new, outer.inner.edges"),
    ],
)
def test_invalid_settings_are_named(text: str, words: str) -> None:
    with pytest.raises(InputError, match=r"^[^\n]*$") as error:
        parse_settings([text], Outer())
    assert words in str(error.value)


def test_a_report_s_settings_can_be_typed_again() -> None:
    paper = preset("paper-lift")
    lines = [
        f"{path}={','.join(map(str, value)) if isinstance(value, tuple) else str(value).lower()}"
        for path, value in listed(paper).items()
    ]
    assert len(lines) > 50
    assert changed(DistillConfig(), parse_settings(lines, DistillConfig())) == paper
    json.dumps(listed(paper), allow_nan=False)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_splats(tmp_path / "a.ply", checkered_ball(600))
    write_views(tmp_path / "v.json", around(8, (32, 24)))
    return tmp_path


COMMANDS = {
    "simplify.max_growth=1.5": "simplify a.ply -r 4 -o out.ply",
    "select.kappa=12.5": "select a.ply --views v.json -k 3 --policy directional -o out.json",
    "recover.schedule.rates.sh0=0.0125": "recover a.ply --views v.json --teacher a.ply -o out.ply --steps 3",
    "adapt.prior_views=0.5": "adapt a.ply --views v.json --teacher a.ply -o out.ply --steps 3",
    "simplify.neighbors=5": "distill a.ply --views v.json -r 4 -o out --steps 3 --focus far --no-page",
}
"""Setting → a command that has it."""


@pytest.mark.parametrize("setting", COMMANDS)
def test_commands_report_settings(setting: str, folder: Path, command_line: CommandLine) -> None:
    (name, _, value), ask = setting.partition("="), COMMANDS[setting].split()
    for wrong, words in (
        (f"{name}x={value}", f"did you mean {name}"),
        (f"{setting}?", "expected a"),
        (f"{name}=-1", f"{name}: expected"),
    ):
        error = refused(command_line, folder, *ask, "--set", wrong)
        assert words in error
        assert "--set" in error
    out = succeeds(command_line, folder, *ask, "--set", setting, "--json", "-").out
    settings = json.loads(out)["settings"]
    assert settings[name] == float(value)
    if "recover.schedule.steps" in settings:
        assert settings["recover.schedule.steps"] == 3  # what --steps made of it


def test_settings_in_a_config_file_and_over_it(folder: Path, command_line: CommandLine) -> None:
    ask = ("simplify", "a.ply", "-o", "out.ply", "--config", "c.toml", "--json", "-", "-w")
    for tables in ("[simplify]\nratio = 4\n[simplify.set]\n", "ratio = 4\n[set]\n"):
        (folder / "c.toml").write_text(f"{tables}simplify.max_growth = 1.5\nneighbors = 5\n")
        out = succeeds(command_line, folder, *ask, "--set", "neighbors=4").out
        settings = json.loads(out)["settings"]
        found = [settings[f"simplify.{name}"] for name in ("max_growth", "neighbors", "retention")]
        assert found == [1.5, 4, 0.65]
    for content, words in (
        ("[simplify.set]\nmax_grow = 1.5\n", "did you mean simplify.max_growth"),
        ("[simplify]\nset = 3\n", "a table of settings"),
        ("[simplify]\nparentz = 0.5\n", "`simplify` has no option parentz"),
    ):
        (folder / "c.toml").write_text(content)
        assert words in refused(command_line, folder, *ask, "-r", 4)


def test_every_list_of_names_matches_its_table() -> None:
    assert tuple(SCHEDULES) == get_args(choices.ScheduleName)
    assert set(FORMATS) == set(get_args(choices.FormatName))
    presets = {"auto", *REGULARIZERS, "paper", *(f"paper-{name}" for name in PAPER_REGULARIZERS)}
    assert set(get_args(choices.PresetName)) == presets
    for method in get_args(choices.Method):
        assert SimplifyConfig(method).rounds(9, 3)
