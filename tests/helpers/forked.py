"""Every kind of kernel on a small scene, for processes that compare what they return."""

import hashlib
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

import g2ard._core as _core
from g2ard.config.choices import Method
from g2ard.rendering.renderer import RasterSettings, Renderer, arrays_of, view_of
from g2ard.rendering.visibility import visibility, visibility_source
from g2ard.scene.prepared import finite_rows_of
from g2ard.stages.lift import lift
from g2ard.stages.recover.config import Rates
from g2ard.stages.select import select
from g2ard.stages.simplify import SimplifyConfig, simplify
from helpers.scenes import around, checkered_ball
from helpers.simplify_cases import flag


def _results() -> Iterator[NDArray[Any]]:
    ball, views = checkered_ball(600), around(6, (48, 40))
    yield flag(ball, 60)
    for method in get_args(Method):
        yield simplify(ball, 60, method=method).splats.means
    yield simplify(ball, 60, visibility=visibility_source(views)).splats.means
    scene, _ = finite_rows_of(ball)
    config = SimplifyConfig().resolved()
    frame = _core.TileFrame.of_sample(scene.core, config)
    yield np.array(frame.values())
    yield _core.TileMerging(scene.core, frame, config).run_costs(2.0)
    yield lift(ball.means, np.full((len(ball), 3), 0.5)).scales
    yield select(ball, views, 3).order
    yield visibility(ball, views).weight
    renderer = Renderer(ball)
    image = renderer.image(views[0])
    yield image
    arrays, settings = arrays_of(ball), RasterSettings(antialiased=False)
    raster, view = _core.Rasterizer(), view_of(views, 0, settings)
    raster.forward(arrays, view, settings, [0.0, 0.0, 0.0])
    yield from raster.backward(arrays, image)
    objective: Any = SimpleNamespace(settings=settings, background=(0.0, 0.0, 0.0), ssim_weight=0.2)
    trainer = _core.Trainer(arrays, objective)
    trainer.step(view, np.clip(image, 0, 1), Rates(1e-4, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4))
    yield from trainer.arrays()
    values = [np.ones(90, np.float32) for _ in range(4)]
    _core.adam_rows([(*values, 0.1, None)], np.zeros(30, np.int64), 0.9)
    yield values[0]
    yield _core.codebook(ball.sh0.ravel(), 8)
    yield _core.palette(ball.sh0[:, 0], 8, 2)[0]
    yield np.array([_core.psnr(image, 0.9 * image), _core.ssim(image, 0.9 * image)])
    steps = np.ones(27, np.int8)
    yield _core.cast_rays(steps, [3, 3, 3], [0, 0, 0], 1.0, np.zeros((4, 3)), np.eye(4, 3))


def digests() -> list[str]:
    """Return a hash of what each kernel returns."""
    return [
        hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest() for array in _results()
    ]


def gpu_digest() -> str:
    """Return a hash of a result that a GPU may compute."""
    means = simplify(checkered_ball(2000), 200, method="paper").splats.means
    return hashlib.sha256(np.ascontiguousarray(means).tobytes()).hexdigest()


def renderer_of_a_ball() -> Renderer:
    """Return a renderer of a scene that is always the same."""
    return Renderer(checkered_ball(500))


def image_digest(renderer: Renderer) -> str:
    """Return a hash of an image that a GPU may draw."""
    return hashlib.sha256(renderer.image(around(1)[0]).tobytes()).hexdigest()
