"""Registration of photos: results kept and refused, scores, and the command's contract."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import g2ard
from g2ard.errors import InputError
from g2ard.io import read_views, write_splats, write_views
from g2ard.io.images import write_png
from g2ard.jobs.register import matched, photos_of, read_poses
from g2ard.jobs.trajectory import read_ace
from g2ard.scene.cameras import Cameras
from g2ard.stages.register import RegisterConfig, pose_error, register
from helpers.commands import CommandLine, succeeds
from helpers.registration import off, result_errors
from helpers.scenes import around, checkered_ball
from helpers.view_files import quaternion

CONFIG = RegisterConfig(size=128, coarsest=32)
SIZE = (128, 96)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene, photos of it under other light, the true views, and coarse poses as ACE writes them."""
    folder = tmp_path_factory.mktemp("site")
    ball = checkered_ball(1500)
    write_splats(folder / "scene.ply", ball)
    views = around(4, SIZE, 2.5)
    renderer = g2ard.Renderer(ball)
    (folder / "photos").mkdir()
    lines = ["# name qw qx qy qz tx ty tz error"]
    for i, view in enumerate(views):
        write_png(
            folder / f"photos/{view.name}.png", np.clip(0.8 * renderer.image(view) + 0.05, 0, 1)
        )
        pose = off(view.viewmat, 0.08, 2, i)
        w, x, y, z = quaternion(pose[:3, :3])
        lines.append(" ".join(map(str, (f"{view.name}.png", w, x, y, z, *pose[:3, 3], 0.1))))
    (folder / "coarse.txt").write_text("\n".join(lines) + "\n")
    paths = tuple(folder / f"photos/{name}.png" for name in views.names)
    views = Cameras.of([Cameras.of([v])[0] for v in views])
    write_views(folder / "truth.json", views)
    write_views(
        folder / "views.json", replace(views, names=tuple(p.name for p in paths), image_paths=paths)
    )
    return folder


def test_poses_as_text_are_camera_from_world(site: Path) -> None:
    found, truth = read_ace(site / "coarse.txt"), read_poses(site / "truth.json")
    for i, (name, pose) in enumerate(found.items()):
        np.testing.assert_allclose(
            pose, off(truth[name.removesuffix(".png")], 0.08, 2, i), atol=1e-12
        )


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a 1 0 0 0 1 2", "line 1 is not a name"),
        ("a 1 0 0 0 1 2 nan", "line 1 is not a name"),
        ("a 0 0 0 0 1 2 3", "line 1 has a quaternion of length zero"),
        ("a 1 0 0 0 1 2 3\n\na 1 0 0 0 1 2 3", "line 3 repeats the name 'a'"),
        ("# nothing\n", "no poses found"),
    ],
)
def test_text_without_poses_is_rejected(text: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "p.txt").write_text(text)
    with pytest.raises(InputError, match=words):
        read_ace(tmp_path / "p.txt")


def test_names_match_whole_then_by_unambiguous_stems() -> None:
    assert matched({"a/1.png": 1, "b/1.png": 2}, ["1.png"]) == {}
    assert matched({"a/1.png": 1, "2": 2}, ["a/1.png", "x/2.jpg", "y/2.jpg"]) == {"a/1.png": 1}
    assert matched({"1": 1}, ["s/1.jpg"]) == {"s/1.jpg": 1}
    aces = {"seq2_frame1.png": 2, "seq3_frame1.png": 3}
    found = matched(aces, ["seq3/frame1.png", "seq2/frame1.png"])
    assert found == {"seq3/frame1.png": 3, "seq2/frame1.png": 2}


def test_a_broken_photo_is_one_refused_row(site: Path, tmp_path: Path) -> None:
    views = read_views(site / "views.json").take([0, 1])
    (tmp_path / "broken.png").write_bytes(b"\x89PNG nothing")
    broken = replace(views, image_paths=(views.image_paths[0], tmp_path / "broken.png"))
    truth = dict(zip(views.names, views.viewmats, strict=True))
    starts = {name: off(pose, 0.05, 1, 0) for name, pose in truth.items()}
    found = register(checkered_ball(1500), broken, starts=starts, config=CONFIG)
    good, bad = found.report.photos
    assert good.status == "registered"
    assert result_errors([good], truth)[0].position < 0.002
    assert bad.status == "refused"
    assert "not an image" in (bad.reason or "")
    assert found.cameras.names == (views.names[0],)
    assert pose_error(found.cameras.viewmats[0], views.viewmats[0])[1] < 0.1


def test_a_photo_of_something_else_is_refused(site: Path, tmp_path: Path) -> None:
    views = read_views(site / "views.json").take([0])
    noise = np.random.default_rng(0).random((12, 16, 3)).repeat(8, 0).repeat(8, 1)
    write_png(tmp_path / "other.png", noise)
    other = replace(views, image_paths=(tmp_path / "other.png",))
    starts = {views.names[0]: views.viewmats[0]}
    found = register(checkered_ball(1500), other, starts=starts, config=CONFIG, keep="uncertain")
    assert found.report.photos[0].status == "refused"
    assert "ZNCC" in (found.report.photos[0].reason or "")
    assert len(found.cameras) == 0


def test_a_pool_gives_starts_by_rank(site: Path) -> None:
    """Each photo starts from the pose nearest to it and ends at the true one."""
    views = read_views(site / "views.json")
    truth = dict(zip(views.names, views.viewmats, strict=True))
    near = [off(pose, 0.08, 2, i) for i, pose in enumerate(views.viewmats)]
    pool = Cameras.from_lists(near, views.Ks, [SIZE] * 4, [f"near {name}" for name in views.names])
    rows = register(checkered_ball(1500), views, pool=pool, config=CONFIG).report.photos
    for row, error in zip(rows, result_errors(rows, truth), strict=True):
        assert row.status == "registered", row.reason
        assert row.start == f"near {row.name}"
        assert row.rank == 1
        assert error.position < 0.002


def test_the_command_writes_views(site: Path, command_line: CommandLine, tmp_path: Path) -> None:
    common = (
        "--images",
        site / "photos",
        "--intrinsics",
        site / "truth.json",
        "--size",
        128,
        "--json",
        "-",
    )
    common = (*common, "--report", "page.html", "--set", "register.coarsest=32", "-o", "poses.json")
    arguments = ("register", site / "scene.ply", *common, "--poses", site / "coarse.txt")
    arguments = (*arguments, "--truth", site / "truth.json")
    out, err = succeeds(command_line, tmp_path, *arguments)
    result = json.loads(out)
    assert result["summary"] == {"photos": 4, "registered": 4, "uncertain": 0, "refused": 0}
    assert len(result["photos"][0]["covariance"]) == 6
    for row in result["photos"]:
        assert row["error"]["position"] < 0.01 < row["start_error"]["position"]
    assert "of 4 photos at the start" in " ".join(err.split())
    assert "4 of 4 photos" in err
    page = (tmp_path / "page.html").read_text()
    assert page.count('<section class="view">') == 4
    assert "4 registered, 0 uncertain, 0 refused" in page
    found = read_views(tmp_path / "poses.json")
    truth = read_poses(site / "truth.json")
    for view in found:
        assert pose_error(view.viewmat, truth[view.name.removesuffix(".png")])[0] < 0.005
        assert view.image_path.is_file()
    again = command_line(*arguments, "-w", "--threads", "1", cwd=tmp_path)[1]
    poses = [
        [row["camera_from_world"] for row in json.loads(text)["photos"]] for text in (out, again)
    ]
    assert poses[0] == poses[1]


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        ("--images photos --poses coarse.txt", 1, "need their intrinsics"),
        ("--images photos --focal 128", 1, "no initial pose; give --poses or --pool"),
        ("--images photos --focal 128 --poses other.txt", 1, "no pose has the name of a photo"),
        ("--images photos --intrinsics wide.json --poses coarse.txt", 1, "pass intrinsics with"),
        ("--images views.json --truth other.txt", 1, "other.txt: no pose has the name of a photo"),
        ("--images views.json --focal 100", 1, "these views state their intrinsics"),
        ("--images views.json --keep some", 2, "keep"),
        ("--images views.json --report page.txt", 1, "ends in .html"),
        ("--images empty --focal 128", 1, "neither photos nor views in this folder"),
        ("--images views.json --report scene.ply -w", 2, "is both an input and the output"),
        ("--images views.json --pool absent.json", 1, "absent.json"),
        ("--images views.json --poses away.txt", 1, "none of 4 photos was registered"),
    ],
)
def test_errors_are_one_line(
    arguments: str, status: int, words: str, site: Path, command_line: CommandLine, tmp_path: Path
) -> None:
    (site / "empty").mkdir(exist_ok=True)
    (site / "other.txt").write_text("elsewhere.png 1 0 0 0 0 0 0\n")
    (site / "away.txt").write_text("view_000.png 0 1 0 0 0 0 90\n")
    truth = read_views(site / "truth.json")
    write_views(site / "wide.json", replace(truth, widths=truth.widths * 2), overwrite=True)
    output, report = tmp_path / "poses.json", tmp_path / "report.json"
    call = ("register", "scene.ply", *arguments.split(), "-o", output, "--json", report)
    found, _, error = command_line(*call, cwd=site)
    assert (found, words in error.splitlines()[-1]) == (status, True), error
    assert not output.exists()
    if "none of 4" in words:
        rows = json.loads(report.read_text())["photos"]
        assert [row["status"] for row in rows] == ["refused"] * 4
        assert rows[1]["reason"] == "no pose to start from"


def test_a_lens_for_all_where_names_differ(site: Path, tmp_path: Path) -> None:
    one = read_views(site / "truth.json").take([0])
    write_views(tmp_path / "lens.json", one)
    taken = photos_of(site / "photos", intrinsics=tmp_path / "lens.json")
    assert taken.names == tuple(f"view_{i:03d}.png" for i in range(4))
    np.testing.assert_array_equal(taken.Ks, np.repeat(one.Ks, 4, 0))
    centred = photos_of(site / "photos", focal=100)
    assert centred.Ks[0].tolist() == [[100, 0, 64], [0, 100, 48], [0, 0, 1]]


def with_exif(path: Path, size: tuple[int, int], tags: dict[int, object]) -> None:
    exif = Image.Exif()
    exif.get_ifd(0x8769).update(tags)
    Image.new("RGB", size).save(path, exif=exif)


def test_the_focal_length_of_exif(tmp_path: Path) -> None:
    film, focal, per_unit, unit, stored = 0xA405, 0x920A, 0xA20E, 0xA210, 0xA002
    photos = tmp_path / "photos"
    photos.mkdir()
    with_exif(photos / "a.jpg", (360, 240), {film: 28})  # 28 / 36 of the longer side
    with_exif(photos / "b.jpg", (600, 400), {focal: 24.0, per_unit: 2540.0, unit: 2, stored: 3600})
    with_exif(photos / "c.jpg", (600, 400), {focal: 24.0, per_unit: 1000.0, unit: 3})
    with_exif(photos / "d.jpg", (600, 400), {focal: 24.0})
    with_exif(photos / "e.jpg", (600, 400), {film: 0, focal: float("nan"), per_unit: 1.0})
    (photos / "f.jpg").write_bytes(b"broken")
    said: list[str] = []
    taken = photos_of(photos, say=said.append)
    focals = [280, 400, 2400]
    np.testing.assert_allclose(taken.Ks[:, 0, 0], [*focals, 400, 400, 400], rtol=1e-5)
    assert "focal lengths by EXIF, 400 pixels in the median" in said[0]
    assert "3 photos without one" in said[0]
    assert photos_of(photos, focal=100).Ks[0, 0, 0] == 100


def test_photos_to_poses_to_an_adapted_scene(
    site: Path, command_line: CommandLine, tmp_path: Path
) -> None:
    """`adapt` and `recover` read the output of `register`, and the scene takes on the photos' light."""
    from g2ard.rendering.targets import Photos

    photos = ("--images", site / "photos", "--intrinsics", site / "views.json", "--size", "128")
    ask = (
        "register",
        site / "scene.ply",
        *photos,
        "--poses",
        site / "coarse.txt",
        "-o",
        "poses.json",
    )
    succeeds(command_line, tmp_path, *ask)
    views = ("--views", "poses.json", "--split", "all")
    for command, output in (("adapt", "adapted.ply"), ("recover", "recovered.ply")):
        succeeds(
            command_line,
            tmp_path,
            command,
            site / "scene.ply",
            *views,
            "--steps",
            "40",
            "-o",
            output,
        )
    targets = Photos(read_views(site / "views.json"))
    before, after = (
        g2ard.evaluate(g2ard.load(path), targets).psnr
        for path in (site / "scene.ply", tmp_path / "adapted.ply")
    )
    assert after > before + 3


def test_keep_all_writes_the_start_of_photos_without_a_pose(site: Path) -> None:
    pytest.importorskip("pycolmap")
    photos = photos_of(site / "views.json")
    starts = {name: off(pose, 0.05, 1, 3) for name, pose in read_poses(site / "views.json").items()}
    none = RegisterConfig(size=128, matcher="sift", min_inliers=10_000, fallback=False)
    scene = g2ard.load(site / "scene.ply")
    found = register(scene, photos, starts=starts, config=none, keep="all")
    assert found.report.count("refused") == 4
    assert "fewer than 10000 matches" in str(found.report.photos[0].reason)
    np.testing.assert_array_equal(
        found.cameras.viewmats, np.stack([starts[n] for n in photos.names])
    )
    assert all(row.camera_from_world for row in found.report.photos)


def test_one_pass_of_features_without_refinement(
    site: Path, command_line: CommandLine, tmp_path: Path
) -> None:
    pytest.importorskip("pycolmap")
    arguments = (
        "--images",
        site / "views.json",
        "--size",
        "128",
        "--passes",
        "1",
        "--refine",
        "none",
    )
    arguments = (*arguments, "--keep", "all", "--set", "register.fallback=false")
    arguments = (
        *arguments,
        "--poses",
        site / "coarse.txt",
        "--report",
        "page.html",
        "-o",
        "poses.json",
    )
    out = succeeds(
        command_line, tmp_path, "register", site / "scene.ply", *arguments, "--json", "-"
    ).out
    rows = json.loads(out)["photos"]
    assert all(row["passes"] <= 1 and row["camera_from_world"] for row in rows)
    assert len(read_views(tmp_path / "poses.json")) == 4
    assert (tmp_path / "page.html").read_text().count('<figure class="wide">') == sum(
        row["inliers"] > 0 for row in rows
    )


def test_python_registers_as_the_command_does(
    site: Path, command_line: CommandLine, tmp_path: Path
) -> None:
    scene, photos, poses = (site / name for name in ("scene.ply", "views.json", "coarse.txt"))
    ask = (
        "--images",
        photos,
        "--poses",
        poses,
        "--size",
        96,
        "--matcher",
        "direct",
        "-o",
        "a.json",
    )
    out = succeeds(command_line, tmp_path, "register", scene, *ask, "--json", "-")
    found = g2ard.register(scene, photos, poses=poses, settings={"size": 96, "matcher": "direct"})
    poses = [row["camera_from_world"] for row in json.loads(out.out)["photos"]]
    assert poses == [row.as_dict()["camera_from_world"] for row in found.report.photos]
    np.testing.assert_array_equal(found.cameras.viewmats, read_views(tmp_path / "a.json").viewmats)
