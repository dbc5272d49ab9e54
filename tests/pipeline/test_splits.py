"""No held-out view ever trains: splits travel with views through every command that reads or writes them."""

import importlib
import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.study import DEFINITIONS, SceneSpec, read_study
from benchmarks.workspace import Workspace
from g2ard.errors import InputError
from g2ard.io import read_view_set, write_splats, write_views
from g2ard.io.splits import for_scores, for_training, not_held_out, split_mask, splits_of
from helpers.commands import CommandLine, Printed, refused, succeeds
from helpers.photos import cloud_of, photos_of
from helpers.scenes import around, checkered_ball

Program = Callable[..., Printed]
BALL = checkered_ball(1500)
VIEWS = around(16)
TEST = {"001.png", "005.png", "009.png", "013.png"}
"""None of these is an eighth name: a command that falls back to the rule trains on all four."""
TRAIN = {f"{i:03d}.png" for i in range(16)} - TEST


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A scene, its photos with a split.json beside them, and a cloud."""
    write_splats(tmp_path / "ball.ply", BALL)
    write_splats(tmp_path / "small.ply", checkered_ball(200))
    cloud_of(tmp_path / "cloud.ply", BALL)
    photos_of(tmp_path / "photos", scene=BALL, count=16)
    split = {"train": sorted(TRAIN), "test": sorted(TEST)}
    (tmp_path / "photos" / "split.json").write_text(json.dumps(split))
    return tmp_path


@pytest.fixture
def g2ard(folder: Path, command_line: CommandLine) -> Program:
    """The program in the folder."""
    return partial(succeeds, command_line, folder)


@dataclass
class Watch:
    """Names of the views that each stage used."""

    trained: list[set[str]] = field(default_factory=list)
    looked: list[set[str]] = field(default_factory=list)
    scored: list[set[str]] = field(default_factory=list)


@pytest.fixture
def watch(monkeypatch: pytest.MonkeyPatch) -> Watch:
    import g2ard.jobs.levels
    import g2ard.jobs.recover
    import g2ard.jobs.scoring
    import g2ard.pipeline.dense
    import g2ard.pipeline.steps
    import g2ard.stages.evaluate

    importlib.import_module("g2ard.report.distilled")  # its pictures call `evaluate`, unwatched
    seen = Watch()

    def watched(module: Any, name: str, argument: int, into: list[set[str]]) -> None:
        stage = getattr(module, name)

        def told(*args: Any, **options: Any) -> Any:
            given = args[argument]
            into.append(set(getattr(given, "cameras", given).names))
            return stage(*args, **options)

        monkeypatch.setattr(module, name, told)

    watched(g2ard.jobs.recover, "optimize", 1, seen.trained)
    watched(g2ard.pipeline.steps, "recover", 1, seen.trained)
    watched(g2ard.pipeline.dense, "visibility_source", 0, seen.looked)
    for module in (
        g2ard.stages.evaluate,
        g2ard.jobs.scoring,
        g2ard.jobs.levels,
        g2ard.jobs.recover,
    ):
        watched(module, "evaluate", 1, seen.scored)
    return seen


def test_select_chooses_training_views_and_keeps_the_rest(folder: Path, g2ard: Program) -> None:
    g2ard(
        "select",
        "ball.ply",
        "--views",
        "photos",
        "-k",
        6,
        "-o",
        "chosen.json",
        "--json",
        "said.json",
    )
    said = json.loads((folder / "said.json").read_text())
    order = [view["name"] for view in said["views"]]
    found = read_view_set(folder / "chosen.json")
    assert found.cameras.names[:6] == tuple(order)
    assert set(order) <= TRAIN
    assert set(found.cameras.names[6:]) == TEST
    assert found.splits == ("train",) * 6 + ("test",) * 4
    train = read_view_set(folder / "chosen.json", split="train")
    np.testing.assert_allclose(train.weights, [view["weight"] for view in said["views"]])
    written = json.loads((folder / "chosen.json").read_text())["views"]
    assert all("weight" not in view for view in written[6:])
    source = read_view_set(folder / "photos", split="test").cameras
    test = read_view_set(folder / "chosen.json", split="test").cameras
    assert test.names == source.names
    np.testing.assert_array_equal(test.viewmats, source.viewmats)


def test_select_out_of_a_selection_and_out_of_other_splits(folder: Path, g2ard: Program) -> None:
    g2ard("select", "ball.ply", "--views", "photos", "-k", 8, "-o", "a.json")
    g2ard("select", "ball.ply", "--views", "a.json", "-k", 3, "-o", "b.json")
    again = read_view_set(folder / "b.json")
    assert again.splits == ("train",) * 3 + ("test",) * 4
    assert set(again.cameras.names[:3]) <= set(read_view_set(folder / "a.json").cameras.names[:8])
    g2ard("select", "ball.ply", "--views", "photos", "-k", 16, "--split", "all", "-o", "all.json")
    whole = read_view_set(folder / "all.json")
    stated = dict(zip(whole.cameras.names, whole.splits, strict=True))
    assert stated == {name: "test" if name in TEST else "train" for name in TRAIN | TEST}
    g2ard("select", "ball.ply", "--views", "photos", "-k", 2, "--split", "test", "-o", "test.json")
    assert read_view_set(folder / "test.json").splits == ("test",) * 4


def test_no_command_trains_on_what_a_selection_holds_out(
    folder: Path, g2ard: Program, watch: Watch
) -> None:
    g2ard("select", "ball.ply", "--views", "photos", "-k", 6, "-o", "chosen.json")
    chosen = set(read_view_set(folder / "chosen.json").cameras.names[:6])
    g2ard("simplify", "ball.ply", "-n", 300, "--views", "chosen.json", "-o", "simplified.ply")
    g2ard("recover", "small.ply", "--views", "chosen.json", "--steps", 4, "-o", "recovered.ply")
    g2ard("adapt", "small.ply", "--views", "chosen.json", "--steps", 4, "-o", "adapted.ply")
    g2ard("distill", "ball.ply", "-n", 200, "--views", "chosen.json", "--steps", 4, "-o", "run")
    assert watch.trained == [chosen] * 3
    assert watch.looked == [chosen] * 2
    assert watch.scored == [TEST] * 4  # of recover and distill, before and after
    g2ard("evaluate", "small.ply", "--views", "chosen.json")
    assert watch.scored[4:] == [TEST]
    g2ard("render", "small.ply", "--views", "chosen.json", "--split", "test", "-o", "renders")
    assert {p.name for p in (folder / "renders").iterdir()} == TEST


def test_no_command_trains_on_what_a_split_file_holds_out(
    folder: Path, g2ard: Program, watch: Watch
) -> None:
    g2ard("recover", "small.ply", "--views", "photos", "--steps", 4, "-o", "recovered.ply")
    few = ("-n", 200, "--views", "photos", "--steps", 4)
    g2ard("distill", "ball.ply", *few, "-o", "run", "--set", "views_count=5")
    g2ard("distill", "cloud.ply", *few, "-o", "lifted")
    assert len(watch.trained) == 3
    assert set().union(*watch.trained, *watch.looked) <= TRAIN
    assert set().union(*watch.scored) == TEST


def test_views_and_held_out_views_given_together(
    folder: Path, g2ard: Program, watch: Watch
) -> None:
    g2ard("select", "ball.ply", "--views", "photos", "-k", 6, "-o", "chosen.json")
    chosen = set(read_view_set(folder / "chosen.json").cameras.names[:6])
    ask = ("distill", "ball.ply", "-n", 200, "--steps", 4)
    g2ard(*ask, "--views", "chosen.json", "--held-out", "photos", "-o", "run")
    assert watch.trained == [chosen]
    assert watch.scored[:2] == [TEST] * 2
    assert all(
        name.startswith("near_") for part in watch.scored[2:] for name in part
    )  # made, no photo's pose
    score = {"test": str(folder / "photos")}
    scene = SceneSpec("ball", str(folder / "ball.ply"), str(folder / "chosen.json"), score)
    place = Workspace(folder / "work", read_study(DEFINITIONS / "recover-curves.toml"), scene)
    assert [set(part.names) for part in (place.train_cameras, place.scored["test"])] == [
        chosen,
        TEST,
    ]
    g2ard(*ask, "--held-out", "photos", "-o", "pool")
    assert [part for part in watch.scored if part == TEST] == [TEST] * 4
    # only held-out views have photos
    pool = read_view_set(folder / "pool" / "views.json", unpictured=True)
    assert set(pool.splits) == {"train", "test"}


def test_a_held_out_view_never_trains(folder: Path, g2ard: Program, watch: Watch) -> None:
    whole = read_view_set(folder / "photos").cameras
    write_views(folder / "bare.json", whole)  # states no splits
    ask = ("distill", "ball.ply", "-n", 200, "--steps", 4, "--photos", "--held-out", "photos")
    g2ard(*ask, "--views", "bare.json", "-o", "run")
    assert watch.trained == [set(whole.names) - TEST]
    held_out = whole.take([name in TEST for name in whole.names])
    assert not_held_out(held_out, whole).sum() == 0
    elsewhere = replace(held_out, image_paths=(None,) * len(TEST))
    assert not_held_out(elsewhere, whole).sum() == 0  # by pose alone
    moved = elsewhere.recentred([0.0, 0.0, 1.0])
    assert not_held_out(moved, whole).all()


def test_pools_state_their_splits(folder: Path, g2ard: Program, watch: Watch) -> None:
    # of something else
    (folder / "split.json").write_text(json.dumps({"train": ["a"], "test": ["b"]}))
    g2ard("poses", "ball.ply", "-k", 24, "-o", "poses.json")
    g2ard("distill", "ball.ply", "-n", 200, "--steps", 4, "--size", 64, "-o", "run")
    for path, count in ((folder / "poses.json", 24), (folder / "run" / "views.json", 48)):
        found = read_view_set(path)
        assert found.splits.count("test") == count // 8
        if path.stem == "poses":
            assert found.splits == splits_of(None, found.cameras.names)
    assert watch.trained[0].isdisjoint(watch.scored[0])
    g2ard("select", "ball.ply", "--views", "poses.json", "-k", 4, "-o", "chosen.json")
    assert read_view_set(folder / "chosen.json").splits == ("train",) * 4 + ("test",) * 3


def test_a_split_that_is_not_stated_is_one_line(command_line: CommandLine, folder: Path) -> None:
    write_views(folder / "train.json", VIEWS, splits=["train"] * 16)
    look = ("--views", "train.json", "--teacher", "ball.ply")
    for ask in (
        ("evaluate", "small.ply", *look),
        ("recover", "small.ply", *look, "--split", "test", "-o", "out.ply"),
        (
            "select",
            "ball.ply",
            "--views",
            "train.json",
            "-k",
            2,
            "--split",
            "test",
            "-o",
            "out.json",
        ),
        ("distill", "ball.ply", "-r", 10, "--views", "train.json", "-o", "run"),
    ):
        status, _, error = command_line(*ask, cwd=folder)
        assert status == 1
        assert (
            error.strip().splitlines()[-1] == "g2ard: train.json: no split 'test' (there are train)"
        )
    ask = (
        "distill",
        "ball.ply",
        "-r",
        10,
        "--views",
        "photos",
        "--held-out",
        "train.json",
        "-o",
        "run",
    )
    assert "train.json: all of its 16 views are for training" in refused(
        command_line, folder, *ask, status=1
    )


def test_training_on_test_views_is_noted(command_line: CommandLine, folder: Path) -> None:
    look = ("--views", "photos", "--steps", 4, "-o")
    for command in ("recover", "adapt"):
        for split, words in (("all", "4 of the 16"), ("test", "4 of the 4"), ("train", None)):
            output = f"{command}-{split}.ply"
            error = succeeds(
                command_line, folder, command, "small.ply", *look, output, "--split", split
            ).err
            said = f"split {split}: {words} views trained on are test views"
            assert (said in error) if words else ("test views" not in error)


def test_splits_of_views() -> None:
    names = ["c", "a", "b"]
    assert splits_of(None, names) == ("train", "test", "train")
    assert splits_of(None, names, ["test", None, "val"]) == ("test", None, "val")
    assert for_training(None, names).all()
    assert for_scores(None, names).all()
    assert for_training(None, names, ["test", None, "train"]).tolist() == [False, False, True]
    assert for_scores(None, names, ["test", None, "train"]).tolist() == [True, True, False]


def test_a_name_in_both_splits_is_refused(tmp_path: Path) -> None:
    (tmp_path / "split.json").write_text(
        json.dumps({"train": ["a", "b.jpg"], "test": ["b"], "ood": ["a"]})
    )
    for ask in (
        lambda: split_mask(tmp_path, ["a", "b"], "train"),
        lambda: splits_of(tmp_path, ["a", "b"]),
    ):
        with pytest.raises(InputError, match=r"split\.json lists 'b' as both train and test"):
            ask()
    (tmp_path / "split.json").write_text(
        json.dumps({"train": ["a"], "test": ["b"], "ood": ["a", "c"]})
    )
    assert splits_of(tmp_path, ["a", "b", "c", "d"]) == ("train", "test", "ood", None)


def test_simplifiers_are_given_training_views_alone(folder: Path) -> None:
    names = [f"{i:03d}.png" for i in range(16)]
    (folder / "photos" / "split.json").write_text(
        json.dumps({"train": names[:6], "val": names[6:9], "test": names[9:13]})
    )
    study, ball = read_study(DEFINITIONS / "simplify.toml"), str(folder / "ball.ply")
    place = Workspace(folder / "work", study, SceneSpec("ball", ball, str(folder / "photos")))
    assert set(place.scored["test"].names) == set(names[9:13])
    written = read_view_set(place.train)
    assert (written.cameras.names, set(written.splits)) == (tuple(names[:6]), {"train"})
    place = Workspace(folder / "work", study, SceneSpec("pool", ball))
    found = read_view_set(place.folder / "pool.json") if place.train else None
    assert found.splits == splits_of(None, found.cameras.names)
    assert set(place.train_cameras.names).isdisjoint(place.scored["test"].names)
