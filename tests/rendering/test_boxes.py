"""Scenes drawn box by box against the whole scene, and against a float64 oracle."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from g2ard.errors import InputError
from g2ard.io import read_splats
from g2ard.rendering.boxes import FAINT, Canvas, front_to_back, reaching
from g2ard.rendering.renderer import RasterSettings, Rendered, Renderer, settings_for
from g2ard.scene.cameras import Camera, Cameras, look_at
from g2ard.scene.kdtree import KdTree, cut_tree
from g2ard.scene.splats import Splats
from helpers.raster_cases import VARIANTS, camera, scene, splats_of
from helpers.realdata import real
from helpers.scenes import under_a_sky, views_at
from helpers.threads import on_threads
from reference import raster as reference

BOXES = st.integers(2, 64)
NO_CUT = np.array([[-np.inf] * 3, [np.inf] * 3])


def cut(splats: Splats, boxes: int) -> KdTree:
    return cut_tree(splats.means, 1.0, -(-len(splats) // boxes))


def drawn(
    splats: Splats, tree: KdTree, view: Camera, settings: RasterSettings | None = None
) -> Canvas:
    """Draw every box from the rows that reach it."""
    settings = settings_for(splats.means, settings)
    canvas = Canvas.blank(view)
    boxes = tree.boxes()
    for leaf in front_to_back(tree, view.position):
        rows = reaching(splats, Cameras.of([view]), boxes[leaf])
        canvas.draw(Renderer(splats.take(rows), settings=settings), boxes[leaf])
    return canvas


def assert_same_image(canvas: Canvas, want: Rendered) -> None:
    np.testing.assert_allclose(
        canvas.finished(), np.dstack([want.image, want.alpha]), rtol=0, atol=1e-5
    )


def poses(rng: np.random.Generator, tree: KdTree) -> list[NDArray[np.float64]]:
    """Poses inside a box, on a face, along a face, on an edge of two, and far away."""
    at = tree.at
    on = np.array([rng.normal(), rng.normal(), rng.normal()])
    on[tree.axis] = at
    along = on + np.eye(3)[(tree.axis + 1) % 3]
    second = tree.below if tree.below and tree.below.below else tree.above
    edge = on.copy()
    if second and second.below:
        edge[second.axis] = second.at
    out = rng.normal(size=3)
    far = 40 * out / np.linalg.norm(out)
    return [
        look_at(0.3 * rng.normal(size=3), rng.normal(size=3)),
        look_at(on, rng.normal(size=3)),
        look_at(on, along),
        look_at(edge, rng.normal(size=3)),
        look_at(far, [0, 0, 0]),
    ]


@given(seed=st.integers(0, 10_000), boxes=BOXES, variant=st.sampled_from(sorted(VARIANTS)))
@settings(max_examples=25, deadline=None)
def test_boxes_draw_what_the_whole_scene_draws(seed: int, boxes: int, variant: str) -> None:
    rng = np.random.default_rng(seed)
    size, spread = float(rng.choice([0.01, 0.1, 0.5])), float(rng.choice([0.3, 1.0, 3.0]))
    splats = splats_of(scene(seed, 400, 1, size=size, spread=spread))
    if seed % 3 == 0:
        splats = under_a_sky(splats, 20, seed).narrowed()
    tree = cut(splats, boxes)
    focal = float(rng.uniform(20, 90))
    for view in views_at(poses(rng, tree), (49, 35), focal):
        whole = Renderer(splats, settings=VARIANTS[variant]).render(view)
        canvas = drawn(splats, tree, view, VARIANTS[variant])
        assert_same_image(canvas, whole)
        np.testing.assert_array_equal(canvas.color, whole.image)  # nothing is rounded twice


@pytest.mark.parametrize("seed", range(6))
def test_a_box_is_the_oracle_s(seed: int) -> None:
    rng = np.random.default_rng(seed)
    p = scene(seed, 120, 1, size=[0.05, 0.3][seed % 2])
    cameras = camera(48, 36, seed=seed, distance=[1.0, 4.0, 12.0][seed % 3])
    low = rng.uniform(-1, 0, 3)
    box = np.stack([low, low + rng.uniform(0.6, 2, 3)])
    box[1, rng.integers(3)] = np.inf
    front = rng.uniform(0, 1, (36, 48)).astype(np.float32)
    front[rng.random((36, 48)) < 0.2] = 1e-5
    canvas = replace(Canvas.blank(cameras[0]), light=front.copy())
    canvas.draw(Renderer(splats_of(p), settings=RasterSettings(near=0.01)), box)
    double = [
        torch.from_numpy(p[name].astype(np.float64))
        for name in ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN")
    ]
    want = reference.render(
        *double,
        viewmat=torch.from_numpy(cameras.viewmats[0]),
        K=torch.from_numpy(cameras.Ks[0]),
        width=48,
        height=36,
        box=(torch.from_numpy(box[0]), torch.from_numpy(box[1])),
        light=torch.from_numpy(front.astype(np.float64)),
    )
    sure = ~want.doubtful.numpy()
    assert sure.mean() > 0.9
    assert want.weight.count_nonzero() > 50
    expected = np.dstack([want.image.numpy(), want.alpha.numpy()])
    error = np.abs(canvas.finished() - expected)[sure]
    assert error.max() < 1e-5 * max(1.0, np.abs(expected).max())


def playbot() -> Splats:
    return read_splats(real("playbot", "0_0", "meta.json"))


@pytest.mark.parametrize("boxes", [2, 9, 64])
def test_boxes_of_playbot_draw_the_whole(boxes: int) -> None:
    splats = playbot()
    splats = splats.take(np.arange(0, len(splats), 16))
    tree = cut(splats, boxes)
    middle, size = (
        np.median(splats.means, axis=0),
        np.ptp(np.percentile(splats.means, [5, 95], axis=0), axis=0),
    )
    on_face = middle.astype(np.float64)
    on_face[tree.axis] = tree.at
    eyes = [middle + 0.05 * size, on_face, middle + [1.5, 0.4, 0.3] * size, middle + 20 * size]
    views = views_at([look_at(eye, middle + 0.01 * size) for eye in eyes], (160, 120), 150.0)
    lit = 0
    for view in views:
        whole = Renderer(splats).render(view)
        canvas = drawn(splats, tree, view)
        assert_same_image(canvas, whole)
        lit += (whole.alpha > 0.5).mean() > 0.01
    assert lit >= 3


def test_the_rows_that_reach_a_box_are_all_it_needs() -> None:
    """Draw boxes of all rows, and of those that are named; images are equal, and not all rows are named."""
    splats = splats_of(scene(3, 2000, 0, size=0.02))
    views = views_at(
        [look_at([0, -6, 0], [0, 0, 0]), look_at([0.1, 0, 0], [1, 1, 0])], (64, 48), 55.0
    )
    tree = cut(splats, 8)
    for box in tree.boxes():
        some = reaching(splats, views, box)
        inside = ((splats.means >= box[0]) & (splats.means < box[1])).all(1)
        assert some[inside & (splats.opacities > FAINT)].all()
        assert some.mean() < 0.5
        for view in views:
            images = []
            for rows in (some, slice(None)):
                canvas = Canvas.blank(view)
                canvas.draw(Renderer(splats.take(rows), settings=RasterSettings(near=0.01)), box)
                images.append(canvas)
            for name in ("color", "light"):
                np.testing.assert_array_equal(getattr(images[0], name), getattr(images[1], name))


def wall_and_ball() -> tuple[Splats, KdTree, Camera]:
    """A wall in front of a camera, and what it hides."""
    y, z = np.meshgrid(np.linspace(-4, 4, 30), np.linspace(-4, 4, 30))
    wall = np.stack([np.zeros(900), y.ravel(), z.ravel()], 1)
    behind = np.random.default_rng(0).normal(size=(100, 3)) * 0.3 + [3, 0, 0]
    splats = Splats.create(
        np.concatenate([wall, behind]),
        scales=np.full((1000, 3), 0.3),
        logit_opacities=np.full(1000, 6.0),
        sh0=np.random.default_rng(1).normal(size=(1000, 1, 3)),
    )
    tree = KdTree(0, 1.5, KdTree(), KdTree())
    return splats, tree, views_at([look_at([-5, 0, 0], [0, 0, 0])], (64, 48), 100.0)[0]


def test_light_on_hidden_boxes_is_less_than_faint() -> None:
    splats, tree, view = wall_and_ball()
    canvas = Canvas.blank(view)
    near, far = tree.boxes()
    assert canvas.light_on(far) == 1
    renderer = Renderer(splats)
    canvas.draw(renderer, near)
    left = canvas.light_on(far)
    assert left < FAINT
    before = canvas.color.copy()
    canvas.draw(renderer, far)
    assert np.abs(canvas.color - before).max() <= FAINT * np.abs(splats.colors).max() + 1e-6
    assert left > 0 or np.array_equal(canvas.color, before)
    aside = np.array([[-7.0, -1, -1], [-6, 1, 1]])  # behind the camera
    assert Canvas.blank(view).light_on(aside) == 0


def test_boxes_give_the_same_bits_on_any_number_of_threads() -> None:
    splats = splats_of(scene(2, 3000, 1, size=0.05))
    tree = cut(splats, 5)
    view = views_at([look_at([0.2, -3, 0.4], [0, 0, 0])], (150, 110), 100.0)[0]

    def everything() -> list[Any]:
        canvas = drawn(splats, tree, view)
        return [canvas.color, canvas.light]

    first, *others = on_threads(everything)
    for other in others:
        for a, b in zip(first, other, strict=True):
            np.testing.assert_array_equal(a, b)


def test_bad_boxes_and_planes_are_named() -> None:
    splats = splats_of(scene(0, 5, 0))
    view = views_at([look_at([0, -3, 0], [0, 0, 0])])[0]
    renderer, canvas = Renderer(splats), Canvas.blank(view)
    for corner in (np.nan, 2.0):
        box = np.array([[corner] * 3, [1.0] * 3])
        for act in (canvas.light_on, lambda b: canvas.draw(renderer, b)):
            with pytest.raises(InputError, match="box"):
                act(box)
    small = replace(canvas, light=np.ones((4, 4), np.float32))
    with pytest.raises(InputError, match="light"):
        small.draw(renderer, NO_CUT)
    with pytest.raises(InputError, match="light"):
        small.light_on(NO_CUT)
