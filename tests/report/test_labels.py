"""Labels of scenes."""

from pathlib import Path

import pytest

from g2ard.io import Source
from g2ard.report.labels import label_scenes, name_scenes
from helpers.photos import cloud_of
from helpers.scenes import checkered_ball

GENERIC = [
    *(
        "scene.ply",
        "scene.sog",
        "scene.compressed.ply",
        "point_cloud.ply",
        "points3D.bin",
        "model.splat",
    ),
    *("0_0", "0", "7.ply", "lod-meta.json", "iteration_7000", "Output.PLY", "simplified"),
]


@pytest.mark.parametrize("name", GENERIC)
def test_names_that_say_nothing_carry_their_folder(name: str) -> None:
    assert name_scenes([Path("park") / name]) == [f"park/{name}"]
    assert name_scenes([Path("park", "point_cloud", name)]) == [f"park/point_cloud/{name}"]


@pytest.mark.parametrize("name", ["garden.ply", "run", "taebak_park", "robot_0.sog", "scenery.ply"])
def test_other_names_stand_alone_unless_they_repeat(name: str) -> None:
    assert name_scenes([Path("a") / name]) == [name]
    assert name_scenes([Path("a") / name, Path("b") / name]) == [f"a/{name}", f"b/{name}"]
    assert name_scenes([Path("a") / name, Path("a") / name]) == [name, name]


def test_the_folder_of_work_has_a_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "bridge").mkdir()
    monkeypatch.chdir(tmp_path / "bridge")
    assert name_scenes([Path()]) == ["bridge"]
    assert name_scenes([Path("scene.ply")]) == ["bridge/scene.ply"]
    assert name_scenes([Path("/")]) == ["/"]


def test_clouds_have_points(tmp_path: Path) -> None:
    cloud = tmp_path / "cloud.ply"
    cloud_of(cloud, checkered_ball(20))
    assert label_scenes([Source(cloud), "small"], [20, 5], ["dense scene", "result"]) == [
        f"dense scene: {tmp_path.name}/cloud.ply, 20 points",
        "result: small, 5 Gaussians",
    ]
