"""Moving and cropping scenes."""

from dataclasses import replace

import numpy as np
import pytest

from g2ard.errors import InputError
from g2ard.rendering.renderer import render
from g2ard.scene.transform import in_box, in_sphere, rotate_harmonics, similarity, transform
from helpers.scenes import around
from helpers.similarities import directional, matrix, turn


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_moved_scene_looks_the_same_from_moved_cameras(degree: int) -> None:
    splats, views = directional(degree), around(4)
    move = matrix(2.5, turn(), [3, -7, 2])
    there = transform(splats, move)
    viewmats = views.viewmats @ np.linalg.inv(move)
    viewmats[:, :3] *= 2.5  # rigid: distances grow, the image does not
    after = replace(views, viewmats=viewmats)
    for i in range(4):
        a, b = render(splats, views[i]), render(there, after[i])
        assert np.abs(a.image - b.image).max() < 2e-3
    wrong = replace(there, shN=splats.shN)
    if degree:  # harmonics that stay behind show
        assert np.abs(render(wrong, after[0]).image - render(splats, views[0]).image).max() > 0.05


def test_three_thirds_of_a_turn_are_the_identity() -> None:
    splats, third = directional(), turn(1)
    a, b = turn(2), turn(3)
    rest = np.linalg.inv(third @ b @ a)
    shN = splats.shN
    for step in (a, b, third, rest):
        shN = rotate_harmonics(shN, step)
    np.testing.assert_allclose(shN, splats.shN, atol=3e-6)


def test_offsets_move_along() -> None:
    splats = replace(directional(), offset=np.array([443_000.0, 5_411_000, 100]))
    moved = transform(splats, matrix(2, turn(), [1, 2, 3]))
    world = splats.means.astype(float) + splats.offset
    np.testing.assert_allclose(
        moved.means + moved.offset, 2 * world @ turn().T + [1, 2, 3], rtol=0, atol=1e-5
    )
    far = transform(directional(), matrix(1, np.eye(3), [443_000, 0, 0]))
    np.testing.assert_array_equal(far.offset, [443_000, 0, 0])
    np.testing.assert_array_equal(far.means, directional().means)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (np.eye(3), "4×4"),
        (np.diag([1, 1, -1, 1]), "mirrors"),
        (np.diag([1, 2, 1, 1]), "differently along"),
        (np.diag([0, 0, 0, 1]), "flattens"),
    ],
)
def test_matrices_that_are_not_similarities_are_rejected(given: np.ndarray, message: str) -> None:
    with pytest.raises(InputError, match=message):
        similarity(given)


def test_crops_are_in_world_coordinates() -> None:
    splats = replace(directional(), offset=np.array([10.0, 0, 0]))
    x = splats.means[:, 0] + 10
    np.testing.assert_array_equal(in_box(splats, [10, -9, -9], [11, 9, 9]), (x >= 10) & (x <= 11))
    near = np.linalg.norm(splats.means - [0, 0, 1], axis=1) <= 0.5
    np.testing.assert_array_equal(in_sphere(splats, [10, 0, 1], 0.5), near)
    with pytest.raises(InputError, match="holds nothing"):
        in_box(splats, [1, 0, 0], [0, 1, 1])
