"""A SHA-256 for every array that the stages return on a few small scenes.

A change that should alter no result alters no line of it. Run before and after such a change, and compare:

    python tests/stress/results.py > before.txt

The lines hold for one processor: instruction sets differ in their last bits. Real scenes, where `G2ARD_DATA`
names them, are subsampled; an argument names the scenes to run.
"""

import hashlib
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).resolve().parents[1]), str(Path(__file__).resolve().parents[2])]

import numpy as np
from numpy.typing import NDArray

from g2ard import _core, io
from g2ard.config.choices import METHODS
from g2ard.rendering import visibility
from g2ard.rendering.renderer import RasterSettings, Renderer, arrays_of, view_of
from g2ard.rendering.targets import TeacherRenders
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats
from g2ard.stages.recover import RecoverConfig, recover
from g2ard.stages.recover.anchors import REGULARIZERS
from g2ard.stages.select import CoverageOptions, select
from g2ard.stages.simplify import flag, simplify
from helpers.scenes import around, checkered_ball

__all__ = ["lines", "random_scene"]

Arrays = Iterator[tuple[str, NDArray[Any]]]

_PARTS = ("means", "quats", "scales", "logit_opacities", "sh0", "shN", "offset")

_FILES = {
    "guitar": "format_samples/guitar.compressed.ply",
    "paljassaare": "paljassaare/0_0",
    "taebak": "taebak_park/0_0",
}

_ROWS = 30_000
"""Gaussians of a real scene."""


def random_scene(seed: int, count: int, *, degree: int = 1, kind: type = np.float32) -> Splats:
    """Discs of very different sizes about three places, some of them transparent, some stated opaque."""
    rng = np.random.default_rng(seed)
    places = rng.normal(0, 2, (3, 3))
    means = places[rng.integers(3, size=count)] + rng.normal(size=(count, 3)) * [1, 1, 0.1]
    logits = rng.normal(0, 3, count)
    logits[:: max(1, count // 20)] = np.inf
    offset = (4e5, 4e6, 100) if kind is np.float64 else (0, 0, 0)
    return Splats.create(
        means.astype(kind),
        quats=rng.normal(size=(count, 4)),
        scales=np.exp(rng.normal([-3, -3, -5], 0.8, (count, 3))),
        logit_opacities=logits,
        sh0=rng.normal(size=(count, 1, 3)),
        shN=rng.normal(0, 0.2, (count, (degree + 1) ** 2 - 1, 3)),
        offset=offset,
    )


def _scenes() -> dict[str, Callable[[], Splats]]:
    found: dict[str, Callable[[], Splats]] = {
        "ball": lambda: checkered_ball(2_000),
        "discs": lambda: random_scene(1, 6_000, degree=3),
        "map": lambda: random_scene(2, 3_000, degree=0, kind=np.float64),
    }
    root = Path(os.environ.get("G2ARD_DATA", ""))
    for name, file in _FILES.items():
        if "G2ARD_DATA" in os.environ and (root / file).exists():
            found[name] = lambda path=root / file: _subsampled(io.read_splats(path))  # type: ignore[misc]
    return found


def _subsampled(scene: Splats) -> Splats:
    return scene.take(np.arange(0, len(scene), -(-len(scene) // _ROWS)))


def _views(scene: Splats) -> Cameras:
    """Ten cameras around the scene, 160 × 120 pixels."""
    world = scene.means.astype(np.float64)
    middle = np.median(world, axis=0)
    radius = float(np.median(np.linalg.norm(world - middle, axis=1)))
    views = around(10, distance=3 * radius, size=(160, 120))
    return views.recentred(-(middle + scene.offset))


def _simplified(scene: Splats, views: Cameras) -> Arrays:
    budget = len(scene) // 10
    rng = np.random.default_rng(3)
    protected = rng.random(len(scene)) < 0.1
    yield "flags", flag(scene, budget)
    for method in METHODS:
        out = simplify(scene, budget, method=method, protected=protected)
        yield from _named(method, out.splats, parents=out.parents, protected=out.protected)
        if method == "paper":
            continue
        seen = visibility.visibility_source(views, longest=80)
        out = simplify(scene, budget, method=method, visibility=seen)
        yield from _named(f"{method} with views", out.splats, parents=out.parents)


def _selected(scene: Splats, views: Cameras) -> Arrays:
    for policy in ("auto", "directional", "coverage", "pose-diverse"):
        out = select(scene, views, 5, policy=policy, options=CoverageOptions(cells=2_000))
        for part in ("order", "gains", "weights", "curve", "refused"):
            yield f"{policy} {part}", getattr(out, part)


def _recovered(scene: Splats, views: Cameras) -> Arrays:
    small = simplify(scene, len(scene) // 5).splats
    targets = TeacherRenders(scene, views)
    regularizers = replace(REGULARIZERS["noisy"], period=2)
    for engine in ("fused", "torch"):
        config = RecoverConfig(steps=8, regularizers=regularizers, engine=engine)  # type: ignore[arg-type]
        yield from _named(engine, recover(small, targets, config).splats)


def _rendered(scene: Splats, views: Cameras) -> Arrays:
    for settings in (
        RasterSettings(),
        RasterSettings(convention="inria"),
        RasterSettings(antialiased=True, alpha_max=0.999),
    ):
        renderer = Renderer(scene, settings=settings)
        name = f"{settings.convention}{' antialiased' * bool(settings.antialiased)}"
        for view in (0, 7):
            out = renderer.render(views[view], median=True)
            for part in ("image", "alpha", "depth", "median"):
                yield f"{name} {view} {part}", getattr(out, part)
    here, settings = views.recentred(scene.offset), RasterSettings(antialiased=False)
    for isa in _core.instruction_sets():
        raster = _core.Rasterizer(isa)
        arrays, view = arrays_of(scene), view_of(here, 0, settings)
        image, alpha, depth, _ = raster.forward(arrays, view, settings, [0.1, 0.2, 0.3])
        assert depth is not None
        grads = raster.backward(arrays, image, alpha, depth)
        yield from ((f"{isa} gradient {i}", g) for i, g in enumerate(grads))


def _seen(scene: Splats, views: Cameras) -> Arrays:
    out = visibility.visibility(scene, views)
    for part in ("weight", "transmittance", "hits", "dominant", "peak", "pixel_size"):
        yield part, getattr(out, part)
    sampled = visibility.visibility_source(views, longest=80)(scene)
    yield "sampled weight", sampled.weight
    yield "sampled pixel_size", sampled.pixel_size


def _named(name: str, scene: Splats, **others: NDArray[Any]) -> Arrays:
    yield from ((f"{name} {part}", getattr(scene, part)) for part in _PARTS)
    yield from ((f"{name} {part}", array) for part, array in others.items())


def lines(name: str, scene: Splats) -> Iterator[str]:
    """One line for each array of each stage: scene, stage, array, dtype, shape, SHA-256."""
    views = _views(scene)
    stages = {
        "simplify": _simplified,
        "select": _selected,
        "recover": _recovered,
        "render": _rendered,
        "visibility": _seen,
    }
    for stage, run in stages.items():
        for part, array in run(scene, views):
            whole = np.ascontiguousarray(array)
            digest = hashlib.sha256(whole.tobytes()).hexdigest()
            yield f"{name}/{stage}/{part} {whole.dtype} {whole.shape} {digest}"


def main() -> int:
    wanted = sys.argv[1:]
    for name, make in _scenes().items():
        if not wanted or name in wanted:
            for line in lines(name, make()):
                print(line, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
