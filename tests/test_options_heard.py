"""No option is ignored: what a command cannot honour is a usage error, and a preset is one everywhere."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scenes import around, checkered_ball

import g2ard
from g2ard.errors import InputError
from g2ard.io import write_splats, write_views
from g2ard.stages.simplify import SimplifyConfig

CommandLine = Callable[..., tuple[int, str, str]]
PRIOR = checkered_ball()
VIEWED = ("--views", "v.json", "--teacher", "ball.ply", "-w", "--json", "-")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_splats(tmp_path / "ball.ply", PRIOR)
    write_views(tmp_path / "v.json", around(8, (48, 36)))
    return tmp_path


def test_the_paper_s_adaptation_blends_nothing(folder: Path, command_line: CommandLine) -> None:
    ask = ("adapt", "ball.ply", "-o", "o.ply", "--steps", 2, *VIEWED)
    for paper in (("--preset", "paper"), ("--schedule", "paper")):
        status, _, error = command_line(*ask, *paper, "--prior-views", 3, cwd=folder)
        assert (status, "--prior-views" in error) == (2, True), error
        status, out, error = command_line(*ask, *paper, cwd=folder)
        assert status == 0, error
        assert json.loads(out)["prior_share"] == 0
    assert g2ard.preset("paper").adapt.prior_views == 0
    status, out, error = command_line(*ask, cwd=folder)
    assert status == 0, error
    assert json.loads(out)["prior_share"] > 0


@pytest.mark.parametrize("preset", ["paper", "paper-trained", "paper-lift", "paper-noisy"])
def test_a_preset_above_the_tables_is_for_all_commands(
    folder: Path, command_line: CommandLine, preset: str
) -> None:
    (folder / "c.toml").write_text(f'preset = "{preset}"\n[recover]\nsteps = 2\n')
    config = ("-w", "--json", "-", "--config", "c.toml")
    status, out, error = command_line(
        "select", "ball.ply", "-k", 3, "--views", "v.json", "-o", "k.json", *config, cwd=folder
    )
    assert status == 0, error
    assert json.loads(out)["policy"] == "directional"
    status, out, error = command_line("simplify", "ball.ply", "-r", 9, "-o", "s.ply", *config, cwd=folder)
    assert status == 0, error
    assert json.loads(out)["config"]["method"] == "paper"


def test_a_study_takes_the_row_of_regularisers() -> None:
    from benchmarks.definition import METHODS, Definition
    from benchmarks.paper import as_in_the_paper

    study = Definition("s", "", (), (METHODS["g2ard"], METHODS["pup"]), steps=(5,))
    assert [m.preset for m in as_in_the_paper(study, row="lift").methods] == ["lift", "auto"]


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("simplify", "ball.ply", "-r", 3, "-o", "o.ply", "--set", "simplify.cells=3"), "simplify.cells"),
        (("distill", "ball.ply", "-o", "o", "--set", "rates.mean=1"), "rates.means"),
        (("select", "ball.ply", "-k", 3, "-o", "o.json", "--set", "kappa=soft"), "kappa"),
        (("recover", "ball.ply", "-o", "o.ply", "--set", "nothing=1"), "nothing"),
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


def test_unscaled_images_need_a_network(folder: Path, command_line: CommandLine) -> None:
    status, _, error = command_line(
        "evaluate", "ball.ply", *VIEWED[:4], "--lpips-input", "unscaled", cwd=folder
    )
    assert status == 2
    assert "--lpips-input" in error


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
