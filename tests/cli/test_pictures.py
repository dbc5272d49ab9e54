"""Turntables and animations of `render`, and `compare`."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from g2ard.io import write_splats, write_views
from g2ard.jobs.run_views import orbit
from helpers.commands import CommandLine, refused, succeeds
from helpers.scenes import around, checkered_ball


def test_an_orbit_keeps_its_distance_and_turns_by_equal_angles() -> None:
    views = orbit(checkered_ball(800), 8, size=(64, 48), up=(0, 0, 1))
    positions = views.positions
    middle = positions.mean(0)
    np.testing.assert_allclose(positions[:, 2], positions[0, 2], atol=1e-9)
    spokes = positions - middle
    assert np.ptp(np.linalg.norm(spokes, axis=1)) < 1e-9
    turns = [
        float(a @ b) / float(a @ a) for a, b in zip(spokes, np.roll(spokes, -1, 0), strict=True)
    ]
    np.testing.assert_allclose(turns, np.cos(np.pi / 4), atol=1e-9)
    meets = views.viewmats @ np.append(middle, 1)  # the axis passes the middle of every image
    np.testing.assert_allclose(meets[:, 0], 0, atol=1e-9)


@pytest.mark.parametrize("name", ["turn.gif", "turn.webp"])
def test_render_writes_an_animation(tmp_path: Path, command_line: CommandLine, name: str) -> None:
    write_splats(tmp_path / "ball.ply", checkered_ball(800))
    ask = ("render", "ball.ply", "--orbit", 5, "--size", 64, "--fps", 10, "-o", name)
    assert "estimated; --up X,Y,Z sets it" in succeeds(command_line, tmp_path, *ask).err
    assert (
        "estimated"
        not in succeeds(command_line, tmp_path, *ask[:-1], "up.gif", "--up", "0,0,1").err
    )
    with Image.open(tmp_path / name) as found:
        assert (found.n_frames, found.size) == (5, (64, 48))
        found.seek(1)
        found.load()
        assert found.info["duration"] == 100
    assert "exists" in refused(command_line, tmp_path, *ask, status=1)


@pytest.mark.parametrize(
    ("given", "size"),
    [("96", (96, 72)), ("1000", (1000, 750)), ("96x54", (96, 54)), ("30x50", (30, 50))],
)
@pytest.mark.parametrize("views", [("--orbit", 1), ("-k", 1), ("--views", "made")])
def test_generated_views_have_the_size_that_is_asked_for(
    tmp_path: Path,
    command_line: CommandLine,
    views: tuple[object, ...],
    given: str,
    size: tuple[int, int],
) -> None:
    write_splats(tmp_path / "ball.ply", checkered_ball(300))
    few = ("--split", "test") if "made" in views else ()
    succeeds(
        command_line, tmp_path, "render", "ball.ply", *views, *few, "--size", given, "-o", "out"
    )
    for path in (tmp_path / "out").iterdir():
        with Image.open(path) as found:
            assert found.size == size


def test_a_shape_is_for_generated_views(tmp_path: Path, command_line: CommandLine) -> None:
    write_splats(tmp_path / "ball.ply", checkered_ball(300))
    write_views(tmp_path / "views.json", around(2))
    ask = ("render", "ball.ply", "--views", "views.json", "-o", "out", "--size")
    assert "given views keep their shape" in refused(command_line, tmp_path, *ask, "96x54")
    assert "1920x1080" in refused(command_line, tmp_path, *ask, "12")
    assert "wide as high" in refused(
        command_line, tmp_path, *ask[:2], "--panorama", *ask[4:], "96x54"
    )


def test_a_shape_keeps_pixels_square_and_all_in_frame() -> None:
    view = around(1)
    sized = view.sized(192, 54)
    assert sized.Ks[0, 0, 0] == pytest.approx(sized.Ks[0, 1, 1])
    assert sized.Ks[0, 1, 1] / 54 == pytest.approx(view.Ks[0, 1, 1] / view.heights[0])
    assert sized.Ks[0, :2, 2].tolist() == pytest.approx([96, 27])


def test_an_mp4_without_ffmpeg_says_so(
    tmp_path: Path, command_line: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", "")
    write_splats(tmp_path / "ball.ply", checkered_ball(100))
    told = refused(
        command_line, tmp_path, "render", "ball.ply", "--orbit", 2, "-o", "a.mp4", status=1
    )
    assert "ffmpeg" in told


def test_compare_prints_scores_and_opens_at_a_typical_view(
    tmp_path: Path, command_line: CommandLine
) -> None:
    ball = checkered_ball(800)
    write_splats(tmp_path / "a.ply", ball)
    write_splats(tmp_path / "b.ply", ball.take(np.arange(800) % 2 == 0))
    ask = ("compare", "a.ply", "b.ply", "-k", 4, "--size", 64)
    out = succeeds(command_line, tmp_path, *ask, "--json", "-", "-o", "page.html").out
    found = json.loads(out)
    assert len(found["views"]) == 4
    assert found["psnr"] == pytest.approx(np.mean([view["psnr"] for view in found["views"]]))
    assert found["psnr"] < 40
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    titles = re.findall(r'"title": "([^"]+)"', page)
    worst = sorted(found["views"], key=lambda view: view["psnr"])[:3]
    assert [title.split(":")[0] for title in titles] == ["typical", "worst 1", "worst 2", "worst 3"]
    assert titles[1:] == [
        f"worst {i}: {v['name']}, {v['psnr']:.1f} dB" for i, v in enumerate(worst, 1)
    ]
    assert worst[0]["name"] not in titles[0]
    assert "worst: " in succeeds(command_line, tmp_path, *ask).out
    same = json.loads(
        succeeds(command_line, tmp_path, "compare", "a.ply", "a.ply", *ask[3:], "--json", "-").out
    )
    assert same["psnr"] == 100
