"""Constants by name: any dataclass's fields, checked, in config files and reports as on the command line."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

import g2ard
from g2ard.config.constants import changed, listed, parsed
from g2ard.config.presets import preset
from g2ard.errors import InputError
from g2ard.io import read_splats, write_splats, write_views
from g2ard.pipeline import DistillConfig
from g2ard.stages.lift import LiftConfig
from g2ard.stages.simplify import SimplifyConfig
from helpers.commands import CommandLine
from helpers.scenes import around, checkered_ball


@dataclass(frozen=True)
class Inner:
    brand_new: float = 1.0
    edges: tuple[float, float] = (1.0, 2.0)
    worked_out: int = field(default=0, metadata={"constant": False})


@dataclass(frozen=True)
class Outer:
    cells: int | None = None
    mode: Literal["soft", "hard"] = "soft"
    exact: bool = False
    inner: Inner = field(default_factory=Inner)
    brand_new: float = 3.0


def test_a_field_of_any_dataclass_is_a_constant_at_once() -> None:
    texts = ["outer.cells=7", "edges=0.5,4", "exact=true", "mode=hard", "inner.brand_new=1e-3", "cells=none"]
    values = parsed(texts, {"outer": Outer()})
    assert changed(Outer(cells=3), "outer", values) == Outer(None, "hard", True, Inner(1e-3, (0.5, 4.0)))
    assert changed(Outer(), "other", values).cells is None
    assert changed(Outer(), "outer", {}) == Outer()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("outer.cells", "NAME=VALUE"),
        ("outer.cells=7.5", "outer.cells: expected a whole number or none, not '7.5'"),
        ("outer.exact=1", "true or false"),
        ("inner.edges=1", "2 numbers"),
        ("inner.brand_new=nan", "a number"),
        ("outer.mode=loud", "one of soft, hard"),
        ("brand_new=2", "'brand_new' could be inner.brand_new or outer.brand_new"),
        ("inner.brandnew=2", "did you mean inner.brand_new"),
        ("egdes=1,2", "did you mean inner.edges"),
        ("inner.worked_out=1", "no constant 'inner.worked_out'"),
        ("qqqqqq=1", "there are outer.cells, outer.mode"),
        ("outer.qqqqqq=1", "there are outer.cells, outer.mode, outer.exact, outer.brand_new"),
    ],
)
def test_what_is_refused_of_a_constant(text: str, words: str) -> None:
    with pytest.raises(InputError, match=r"^[^\n]*$") as error:
        parsed([text], {"outer": Outer()})
    assert words in str(error.value)


def test_what_has_an_option_is_not_set_by_name() -> None:
    with pytest.raises(InputError, match="there is an option for that"):
        parsed(["outer.cells=7"], {"outer": Outer()}, without=["cells"])
    assert "cells" not in listed({"outer": Outer()}, without=["cells"])["outer"]


def test_a_report_s_constants_can_be_typed_again() -> None:
    paper = preset("paper", prior="lift").distill
    lines = [
        f"{prefix}.{name}={','.join(map(str, value)) if isinstance(value, tuple) else str(value).lower()}"
        for prefix, constants in listed({"recover": paper}).items()
        for name, value in constants.items()
    ]
    assert len(lines) > 40
    assert changed(DistillConfig(), "recover", parsed(lines, {"recover": DistillConfig()})) == paper
    json.dumps(listed({"recover": paper, "lift": LiftConfig()}), allow_nan=False)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_splats(tmp_path / "a.ply", checkered_ball(600))
    write_views(tmp_path / "v.json", around(8, (32, 24)))
    return tmp_path


COMMANDS = [
    ("simplify", "a.ply", "-r", 4, "-o", "out.ply"),
    ("select", "a.ply", "--views", "v.json", "-k", 3, "-o", "out.json"),
    ("recover", "a.ply", "--views", "v.json", "--teacher", "a.ply", "-o", "out.ply", "--steps", 3),
    ("adapt", "a.ply", "--views", "v.json", "--teacher", "a.ply", "-o", "out.ply", "--steps", 3),
    ("distill", "a.ply", "--views", "v.json", "-r", 4, "-o", "out", "--steps", 3),
]
SOME = {
    "simplify": "simplify.max_growth=1.5",
    "select": "select.kappa=12.5",
    "recover": "rates.sh0=0.0125",
    "adapt": "rates.sh0=0.0125",
    "distill": "simplify.neighbors=5",
}


@pytest.mark.parametrize("command", COMMANDS, ids=lambda c: c[0])
def test_commands_take_constants_and_report_them(
    command: tuple[object, ...], folder: Path, command_line: CommandLine
) -> None:
    for wrong, words in (
        ("nothing.of_the_kind=1", "no constant"),
        (SOME[str(command[0])].replace("=", "x="), f"did you mean {SOME[str(command[0])].split('=')[0]}"),
        (SOME[str(command[0])] + "?", "expected a"),
        (SOME[str(command[0])].split("=")[0] + "=-1", SOME[str(command[0])].split("=")[0] + ": expected"),
    ):
        status, _, error = command_line(*command, "--set", wrong, cwd=folder)
        assert (status, len(error.splitlines())) == (2, 1), error
        assert words in error
        assert "--set" in error
    name, _, value = SOME[str(command[0])].partition("=")
    prefix, _, key = name.partition(".")
    status, out, error = command_line(*command, "--set", f"{name}={value}", "--json", "-", cwd=folder)
    assert status == 0, error
    constants = json.loads(out)["constants"]
    assert constants[prefix][key] == float(value)
    if command[0] in ("recover", "distill"):
        assert constants["schedule"]["steps"] == 3  # what --steps made of it


def test_constants_in_a_config_file_and_over_it(folder: Path, command_line: CommandLine) -> None:
    ask = ("simplify", "a.ply", "-o", "out.ply", "--config", "c.toml", "--json", "-", "-w")
    for tables in ("[simplify]\nratio = 4\n[simplify.set]\n", "ratio = 4\n[set]\n"):
        (folder / "c.toml").write_text(f"{tables}simplify.max_growth = 1.5\nneighbors = 5\n")
        status, out, error = command_line(*ask, "--set", "neighbors=4", cwd=folder)
        assert status == 0, error
        constants = json.loads(out)["constants"]["simplify"]
        assert (constants["max_growth"], constants["neighbors"], constants["retention"]) == (1.5, 4, 0.65)
    for content, words in (
        ("[simplify.set]\nmax_grow = 1.5\n", "did you mean simplify.max_growth"),
        ("[simplify]\nset = 3\n", "a table of constants"),
        ("[simplify]\nretentoin = 0.5\n", "no option of `simplify` is called retentoin"),
    ):
        (folder / "c.toml").write_text(content)
        status, _, error = command_line(*ask, "-r", 4, cwd=folder)
        assert (status, len(error.splitlines())) == (2, 1), error
        assert words in error


def test_a_constant_does_what_it_says(folder: Path, command_line: CommandLine) -> None:
    for growth in (1, 2):
        ask = ("simplify", "a.ply", "-r", 10, "-o", f"{growth}.ply", "--set", f"max_growth={growth}")
        status, _, error = command_line(*ask, "--no-views", cwd=folder)
        assert status == 0, error
    small, large = (read_splats(folder / f"{growth}.ply") for growth in (1, 2))
    assert large.scales.mean() > small.scales.mean()


PRIOR = checkered_ball()


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("simplify", "a.ply", "-r", 3, "-o", "o.ply", "--set", "simplify.cells=3"), "simplify.cells"),
        (("distill", "a.ply", "-o", "o", "--set", "rates.mean=1"), "rates.means"),
        (("select", "a.ply", "-k", 3, "-o", "o.json", "--set", "kappa=soft"), "kappa"),
        (("recover", "a.ply", "-o", "o.ply", "--set", "nothing=1"), "nothing"),
    ],
)
def test_a_printed_config_has_no_constant_that_is_not_known(
    folder: Path, command_line: CommandLine, arguments: tuple[object, ...], told: str
) -> None:
    status, out, error = command_line(*arguments, "--print-config", cwd=folder)
    assert (status, out) == (2, "")
    assert told in error
    right = (*arguments[:-1], "max_energy=0.02")
    if arguments[0] in ("simplify", "distill"):
        status, out, error = command_line(*right, "--print-config", cwd=folder)
        assert status == 0, error
        assert "max_energy" in out
        assert not (folder / "o").exists()


def test_simplify_takes_constants_in_python() -> None:
    whole = g2ard.simplify(PRIOR, ratio=5, method="paper", config=SimplifyConfig(min_coverage=2))
    named = g2ard.simplify(PRIOR, ratio=5, method="paper", constants={"simplify.min_coverage": 2})
    short = g2ard.simplify(PRIOR, ratio=5, method="paper", constants={"min_coverage": 2})
    usual = g2ard.simplify(PRIOR, ratio=5, method="paper")
    np.testing.assert_array_equal(whole.parents, named.parents)
    np.testing.assert_array_equal(whole.parents, short.parents)
    assert not np.array_equal(whole.parents, usual.parents)
    with pytest.raises(InputError, match=r"no constant 'simplify\.min_cover'"):
        g2ard.simplify(PRIOR, ratio=5, constants={"simplify.min_cover": 2})
    with pytest.raises(InputError, match=r"no constant 'rates\.mean'"):
        g2ard.distill(PRIOR, ratio=5, constants={"rates.mean": 2})
