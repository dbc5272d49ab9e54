"""The studies at the paper's scale, on small data in the published layouts."""

import json
import re
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import pytest

from benchmarks import cambridge
from benchmarks.kinds import matched, worker
from benchmarks.kinds.matched import Matched
from benchmarks.kinds.methods import ROUND_STEPS
from benchmarks.process import Usage
from benchmarks.study import DEFINITIONS, read_study
from g2ard.io import read_views, write_splats, write_views
from g2ard.stages.simplify import round_counts
from helpers import dataset_files
from helpers.commands import CommandLine, succeeds
from helpers.feature_scenes import blotched
from helpers.project import ROOT
from helpers.scenes import checkered_ball
from helpers.systems import needs_processes

PAPER = sorted(path.stem for path in (DEFINITIONS / "paper").glob("*.toml"))
SCENE = checkered_ball(400)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folders that the three variables name; no ood.json, which is optional."""
    root = tmp_path_factory.mktemp("data")
    dataset_files.matrix_city(root / "city", SCENE)
    dense = read_views(root / "city/small_city/street/train_dense/small_city_road_horizon_dense")
    viewmats = dense.viewmats.copy()
    viewmats[:, :3, 3] /= 100  # as docs/datasets.md does
    write_views(root / "city/adapt.json", replace(dense, viewmats=viewmats))
    for name in ("garden", "room"):
        (root / "mip").mkdir(exist_ok=True)
        dataset_files.mip_nerf_360(root / "mip" / name)
        dataset_files.inria_model(root / "mip/models" / name, SCENE)
    places = blotched(2500)
    college = root / "cambridge/KingsCollege"
    dataset_files.cambridge(college, (400, 225), places)
    found = cambridge.read(college)
    write_views(college.with_suffix(".json"), found.cameras, splits=found.splits)
    dataset_files.ace_poses(root / "cambridge/poses_Cambridge_KingsCollege_.txt")
    write_splats(root / "cambridge/KingsCollege.ply", places)
    for name in ("5x", "10x", "20x", "30.3x", "30.3x-no-erank"):
        (root / "cambridge/maps" / name).mkdir(parents=True)
        write_splats(root / "cambridge/maps" / name / "scene.ply", places)
    return root


@pytest.fixture
def study(
    data: Path, tmp_path: Path, command_line: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., tuple[list[dict[str, Any]], str]]:
    """Runs a study at the paper's scale by its command: rows and messages. Stages run in this process."""

    def here(command: Sequence[str], log: Path) -> Usage:
        began = time.monotonic()
        worker._main(Path(command[-1]))
        return Usage(0.1, time.monotonic() - began, 1.0)

    for name, folder in (("MATRIXCITY", "city"), ("MIPNERF360", "mip"), ("CAMBRIDGE", "cambridge")):
        monkeypatch.setenv(name, str(data / folder))
    monkeypatch.setattr(matched, "measured", here)

    def run(name: str, *options: str) -> tuple[list[dict[str, Any]], str]:
        file = DEFINITIONS / "paper" / f"{name}.toml"
        out, err = succeeds(
            command_line, tmp_path, "benchmarks", "run", file, "-o", name, "--json", "-", *options
        )
        return json.loads(out)["rows"], err

    return run


SMALL = (
    "--set",
    "released=false",
    "--ratios",
    "2",
    "--seeds",
    "0",
    "--set",
    "steps=20",
    "--size",
    "48",
)


@needs_processes
@pytest.mark.parametrize("name", [n for n in PAPER if n != "kings_college_registration"])
def test_every_table_has_rows_on_data_as_it_is_published(
    name: str, study: Callable[..., tuple[list[dict[str, Any]], str]]
) -> None:
    made = read_study(DEFINITIONS / "paper" / f"{name}.toml")
    adapts = ("--adapt-steps", "3") if made.adapt_steps else ()
    rows, said = study(name, *SMALL, *adapts)
    assert {row["method"] for row in rows} == {method.name for method in made.methods}
    assert {row["scene"] for row in rows} == {scene.name for scene in made.scenes}
    assert "…" not in said, "the table is wider than the terminal"
    for row in rows:
        assert "error" not in row, row
        assert row["psnr"] > 3
    if name.startswith("matrixcity"):
        assert {row["split"] for row in rows} == {"val"}
        assert "ood.json does not exist" in said or "ood_85.json does not exist" in said
        assert "train: 12 views, the paper has 4,075" in said
        assert "val: 4 views, the paper has 510" in said


def test_poses_are_registered_from_aces_file(
    study: Callable[..., tuple[list[dict[str, Any]], str]],
) -> None:
    rows, _ = study(
        "kings_college_registration", "--size", "400", "--only", "teacher,30.3× without eRank"
    )
    assert [row["scene"] for row in rows] == ["teacher", "30.3× without eRank"]
    for row in rows:
        assert "error" not in row, row
        assert row["photos"] == 3
        assert row["position"] < row["start_position"]


def steps_of(study: Matched) -> int:
    """Return the steps of all cells at the paper's counts."""
    steps: dict[Any, int] = {}
    for scene, ratio, method in product(study.scenes, study.ratios, study.methods):
        count = scene.expects.get("prior", 1_000_000)
        counts = round_counts(count, round(count / ratio), fold=study.fold)
        legs = method.legs({"paper": len(counts), "pup": 2}.get(method.rounds, 1))
        for budget, seed in product(study.budgets(method) if method.recovers else (), study.seeds):
            released = method.released_steps or 0
            early = ROUND_STEPS if method.rounds == "paper" else released
            if budget.kind == "steps":
                released = round(legs[-1].share * budget.amount)
                early = round(legs[0].share * budget.amount)
            cell = (scene.name, ratio, method.reduce)
            shared = () if method.shared_start else (method.name, budget, seed)
            steps[*cell, "early", *shared] = early * (len(legs) - 1)
            steps[*cell, "final", method.name, budget, seed] = released + study.adapt_steps
    return sum(steps.values())


def test_the_hours_follow_the_studies() -> None:
    page = " ".join(
        (ROOT / "docs/datasets.md").read_text(encoding="utf-8").split("## Hours")[1].split()
    )
    seconds = float(re.findall(r"([\d.]+) CPU seconds", page)[0])
    studies = {name: read_study(DEFINITIONS / "paper" / f"{name}.toml") for name in PAPER}
    matched_studies = {name: study for name, study in studies.items() if isinstance(study, Matched)}
    hours = {name: steps_of(study) * seconds / 3600 for name, study in matched_studies.items()}
    low, high = min(hours, key=lambda name: hours[name]), max(hours, key=lambda name: hours[name])
    assert f"{hours[low]:.0f} CPU hours for `{low}` to {hours[high]:.0f} for `{high}`" in page


def test_the_page_lists_every_study() -> None:
    page = (ROOT / "docs/g2ard-and-the-paper.md").read_text(encoding="utf-8")
    assert [name for name in PAPER if f"paper/{name}.toml" not in page] == []
