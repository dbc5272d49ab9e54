"""Points without colours take those of the photos that see them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from g2ard.io.types import Points
from g2ard.jobs.start import _as_cloud
from g2ard.progress import unsaid
from g2ard.scene.cameras import Camera, Cameras
from g2ard.stages.photo_points.colors import colored, median_colors


def view(folder: Path, number: int, colour: tuple[int, int, int], eye: list[float]) -> Camera:
    path = folder / f"{number}.png"
    Image.new("RGB", (64, 48), colour).save(path)
    return replace(
        Camera.facing(eye, [0, 0, 0], width=64, height=48, name=path.name), image_path=path
    )


@pytest.mark.parametrize(("seed", "every"), [(0, None), (1, None), (0, 4)])
def test_each_side_has_the_median_colour_of_its_own_photos(
    tmp_path: Path, seed: int, every: int | None
) -> None:
    """A wall's two sides are seen by two groups of photos; one photo of each shows something else.

    Of a cloud in blocks, some points hide others.
    """
    rng = np.random.default_rng(seed)
    wall = rng.uniform(-1, 1, (6000, 3)) * (1, 0, 1)
    front, back = (wall + np.array([0, y, 0]) for y in (-0.3, 0.3))
    colours = {-4.0: (200, 40, 10), 4.0: (20, 90, 220)}
    cameras = []
    for y, colour in colours.items():
        for x in (-0.3, 0.0, 0.3):
            shown = (0, 255, 0) if x == 0 else colour
            cameras.append(view(tmp_path, len(cameras), shown, [x, y, 0.1]))
    positions = np.concatenate([front, back, [[0, 50.0, 0]]])
    wanted = np.ones(len(positions), bool)
    wanted[1::5] = False
    hiding = None if every is None else positions[::every]
    found, seen = median_colors(positions, wanted, Cameras.of(cameras), hiding=hiding)
    assert len(found) == wanted.sum()
    side = positions[wanted, 1]
    for y, near in ((-4.0, side < 0), (4.0, (side > 0) & (side < 1))):
        right = np.abs(255 * found[near] - colours[y]).max(1) < 1
        assert seen[near].mean() > 0.9
        assert right[seen[near]].mean() > 0.95
    assert not seen[-1]


def test_black_points_are_those_without_a_colour(tmp_path: Path) -> None:
    """White ones have one, and black ones that no photo sees take the usual colour."""
    views = [
        view(tmp_path, row, (200, 40, 10), [x, -4.0, 0.1])
        for row, x in enumerate((-0.3, 0.0, 0.3, 0.1))
    ]
    rng = np.random.default_rng(0)
    positions = np.concatenate(
        [rng.uniform(-1, 1, (900, 3)) * (1, 0, 1), [[0, 50.0, 0], [0.05, 0, 0.05]]]
    )
    colors = np.zeros((902, 3), np.float32)
    colors[-1] = 1
    cloud = _as_cloud(Points(positions, colors))
    found = colored(cloud, Cameras.of(views), "cloud", say=unsaid).colors
    np.testing.assert_array_equal(found[-1], 1)
    np.testing.assert_allclose(
        found[:-1], np.tile(np.divide((200, 40, 10), 255), (901, 1)), atol=1e-3
    )
