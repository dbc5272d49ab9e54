"""Exposures and white balances of photos: estimated during recovery, undone, and fitted for scores."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import g2ard
from g2ard.pipeline.adapt import AdaptConfig, adapt
from g2ard.rendering.exposure import Moments, exposures_of, rendered, unexposed
from g2ard.rendering.targets import Exposed, Photos, PhotosOrRenders, Subset
from g2ard.scene.cameras import Cameras
from g2ard.scene.samples import evenly_spaced
from g2ard.stages.evaluate import evaluate
from g2ard.stages.recover.config import RecoverConfig
from g2ard.stages.recover.engine import FusedEngine
from g2ard.stages.recover.optimize import recover
from helpers.commands import CommandLine, succeeds
from helpers.photos import photographed
from helpers.scenes import around, assert_same_bits, checkered_ball

VIEWS = around(12, (48, 36))
BALL = checkered_ball(800)
RENDERS = [g2ard.Renderer(BALL).clipped(view) for view in VIEWS]
GAINS = 2 ** (0.8 * np.sin(2.3 * np.arange(12)))
KINDS: dict[str, Any] = {
    "exposure": np.tile(GAINS[:, None], 3),
    "white balance": 2 ** np.random.default_rng(1).uniform(-0.6, 0.6, (12, 3)),
    "one dark photo": np.where(np.arange(12)[:, None] == 5, 0.4, np.ones((12, 3))),
}


def start() -> g2ard.Splats:
    """The ball with noise, half as bright: what all photos have in common is no difference."""
    rng = np.random.default_rng(0)
    moved = BALL.means + rng.normal(0, 0.01, BALL.means.shape).astype(np.float32)
    return replace(BALL, means=moved, sh0=BALL.sh0 - np.float32(0.3))


def photos(gains: Any, offset: Any = 0.0, **more: Any) -> Photos:
    """Photos of half the ball's brightness, so that none is saturated."""
    taken = [
        np.rint(255 * np.clip(0.5 * image * gain + offset, 0, 1)).astype(np.uint8)
        for image, gain in zip(RENDERS, gains, strict=True)
    ]
    return Photos(VIEWS, taken, **more)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("engine", ["fused", "torch"])
def test_photos_that_differ_are_matched(
    kind: str, engine: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if engine == "torch":
        pytest.importorskip("torch")
    targets = photos(KINDS[kind])
    config = RecoverConfig(steps=150, engine=engine)  # type: ignore[arg-type]
    done = recover(start(), targets, config)
    found = done.report.exposure
    assert found is not None
    fits = np.array([found.photos[name] for name in VIEWS.names])
    np.testing.assert_allclose(np.log(fits[..., 0]).mean(0), 0, atol=1e-12)
    np.testing.assert_allclose(fits[..., 1].mean(0), 0, atol=1e-12)
    brightness = np.log2(fits @ [0.3, 1.0] / 0.3)
    wanted = np.log2(KINDS[kind])
    np.testing.assert_allclose(brightness - brightness.mean(0), wanted - wanted.mean(0), atol=0.4)
    monkeypatch.setattr("g2ard.stages.recover.loop.exposures_of", lambda *_, **__: None)
    ignored = recover(start(), targets, config)
    scores = [evaluate(each.splats, Exposed(targets)).psnr for each in (ignored, done)]
    assert scores[1] > scores[0] + 0.3, scores


def test_photos_that_agree_change_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    config = RecoverConfig(steps=80)
    looked = recover(start(), photos(np.ones(12)), config)
    monkeypatch.setattr("g2ard.stages.recover.loop.exposures_of", lambda *_, **__: None)
    assert_same_bits(looked.splats, recover(start(), photos(np.ones(12)), config).splats)
    assert "exposure" not in looked.report.as_dict()


def test_offsets_masks_and_alpha_are_respected() -> None:
    """Only pixels that mask and alpha show are fitted and corrected."""
    alphas = [g2ard.render(BALL, view).alpha[..., None] for view in VIEWS]
    white = g2ard.Renderer(BALL, background=(1, 1, 1))
    gains, offsets = 0.6 + 0.03 * np.arange(12), 0.01 * np.arange(12) - 0.05
    taken = []
    for image, alpha, gain, offset in zip(RENDERS, alphas, gains, offsets, strict=True):
        colour = gain * image / np.maximum(alpha, 1e-3) + offset
        taken.append(np.concatenate([colour.clip(0, 1), alpha], 2).astype(np.float32))
    targets = Photos(VIEWS, taken, background=(1, 1, 1))
    found = exposures_of(BALL.with_sh_degree(0), targets, (1, 1, 1), decided=True)
    assert found is not None
    common = np.exp(np.log(gains).mean())
    np.testing.assert_allclose(found[:, 0, 0], gains / common, atol=0.04)
    for view in range(12):
        image, mask = unexposed(
            targets, view, np.array([[gains[view], offsets[view]]] * 3), (1, 1, 1)
        )
        shown = np.ones(image.shape[:2], bool) if mask is None else mask
        inside = shown & (taken[view][..., :3].min(2) > 0) & (taken[view][..., :3].max(2) < 1)
        np.testing.assert_allclose(image[inside], white.image(VIEWS[view])[inside], atol=0.01)
        score = rendered(white, Exposed(targets), view)
        np.testing.assert_allclose(score[inside], targets[view][inside], atol=0.03)


def test_saturated_pixels_of_bright_photos_do_not_count() -> None:
    taken = [np.full((36, 48, 3), 0.4, np.float32) for _ in VIEWS]
    taken[3][:10] = 1.0
    image, mask = unexposed(Photos(VIEWS, taken), 3, np.array([[2.0, 0.0]] * 3), (0, 0, 0))
    assert mask is not None
    assert not mask[:10].any()
    assert mask[10:].all()
    np.testing.assert_allclose(image[10:], 0.2, atol=1e-6)
    assert unexposed(Photos(VIEWS, taken), 3, np.array([[0.5, 0.0]] * 3), (0, 0, 0))[1] is None


def test_renders_among_photos_keep_their_exposure(tmp_path: Path) -> None:
    pictured = photographed(tmp_path, BALL, VIEWS.take(range(6)), gain=0.6)
    paths = (*pictured.image_paths, *[None] * 6)
    targets = PhotosOrRenders(replace(VIEWS, image_paths=paths), BALL)
    found = exposures_of(BALL, targets, (0, 0, 0), decided=True)
    assert found is not None
    np.testing.assert_array_equal(found[6:], np.tile([1.0, 0.0], (6, 3, 1)))


def test_commands_say_what_was_undone(tmp_path: Path, command_line: CommandLine) -> None:
    def taken(folder: str, gains: Any) -> Cameras:
        (tmp_path / folder).mkdir()
        made = [
            photographed(tmp_path / folder, BALL, VIEWS.take([i]), gain=0.5 * float(g))
            for i, g in enumerate(gains)
        ]
        return replace(VIEWS, image_paths=tuple(views.image_paths[0] for views in made))

    g2ard.save(tmp_path / "scene.ply", start())
    for name, gains in (("equal", np.ones(12)), ("unequal", GAINS)):
        g2ard.save_views(tmp_path / f"{name}.json", taken(name, gains))
    recovered = ["recover", "scene.ply", "--steps", "100", "-o"]
    adapted = ["adapt", "scene.ply", "--steps", "100", "-o"]
    distilled = ["distill", "scene.ply", "-n", "700", "--steps", "100", "--no-page", "-o"]
    for command in (recovered, adapted, distilled):
        told = []
        for name in ("equal", "unequal"):
            output = f"{command[0]}-{name}{'.ply' * (command[0] != 'distill')}"
            printed = succeeds(command_line, tmp_path, *command, output, "--views", f"{name}.json")
            told.append("".join(printed))
        assert "exposure" not in told[0]
        assert "the photos differ in exposure" in told[1]
    report = (tmp_path / "distill-unequal/report.json").read_text()
    assert '"exposure"' in report
    assert "differ in exposure" in (tmp_path / "distill-unequal/report.html").read_text()


@pytest.mark.parametrize("kind", ["equal", "exposure"])
def test_all_figures_of_an_adaptation_are_measured_alike(kind: str) -> None:
    """After a fit of exposures if photos differ, and without one if they agree."""
    targets: Any = photos(KINDS.get(kind, np.ones(12)))
    config = AdaptConfig(steps=160, first_stretch=80, tolerance=0, prior_views=0)
    done = adapt(start(), targets, config)
    assert (done.report.exposure is not None) == (kind == "exposure")
    if done.report.exposure is not None:
        assert done.report.as_dict()["exposure"]["photos"].keys() == set(VIEWS.names)
    some = Subset(targets, evenly_spaced(12, 8))
    shown = Exposed(some) if kind == "exposure" else some
    scores = [evaluate(splats, shown).psnr for splats in (start(), done.splats)]
    told = done.report.psnr
    np.testing.assert_allclose([told.before, told.after], scores, atol=1e-3)
    np.testing.assert_allclose(done.report.stretches[-1].psnr, told.after, atol=1e-3)


@pytest.mark.parametrize(("gain", "differ"), [(0.97, False), (0.75, True)])
def test_gains_that_hardly_differ_are_not_fitted(gain: float, differ: bool) -> None:
    """However much of a small error they explain."""
    scene, views = checkered_ball(600).with_sh_degree(0), around(8, (48, 36))
    renderer = g2ard.Renderer(scene)
    images = [renderer.clipped(camera) * gain ** (row % 2) for row, camera in enumerate(views)]
    found = exposures_of(scene, Photos(views, images), (0.0, 0.0, 0.0))
    assert (found is not None) == differ


def test_exposures_that_explain_little_of_the_error_are_not_fitted() -> None:
    """However much they differ: here each pixel is wrong by far more."""
    scene, rng = BALL.with_sh_degree(0), np.random.default_rng(0)
    images = [
        np.clip(
            g2ard.Renderer(scene).clipped(camera) * 0.6 * (0.75 + 0.5 * (row % 2)) + noise, 0, 1
        )
        for row, camera in enumerate(VIEWS)
        for noise in [rng.uniform(0, 0.4, (36, 48, 3)).astype(np.float32)]
    ]
    assert exposures_of(scene, Photos(VIEWS, images), (0, 0, 0), decided=True) is not None
    assert exposures_of(scene, Photos(VIEWS, images), (0, 0, 0)) is None


def test_masked_pixels_have_no_exposure() -> None:
    """Targets of other classes may show something there."""

    class Masked:
        cameras = VIEWS

        def __getitem__(self, view: int) -> Any:
            image = RENDERS[view] * np.float32(0.5)
            image[:, ::2] = RENDERS[view][:, ::2] * (0.3 + 0.3 * (view % 3))
            return image

        def mask(self, view: int) -> Any:
            return np.broadcast_to(np.arange(48) % 2 == 1, (36, 48))

        def against(self, view: int) -> str:
            return "photo"

    found = exposures_of(BALL.with_sh_degree(0), Masked(), (0, 0, 0), decided=True)
    assert found is not None
    np.testing.assert_allclose(found[..., 0], 1, atol=0.05)


def test_a_target_that_a_device_may_keep_never_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    step, kept = FusedEngine.step, dict[int, Any]()
    changing = []

    def watched(self: FusedEngine, view: int, target: Any, *more: Any, **named: Any) -> float:
        if named["fixed"]:
            np.testing.assert_array_equal(kept.setdefault(view, np.array(target)), target)
        changing.append(not named["fixed"])
        return step(self, view, target, *more, **named)

    monkeypatch.setattr(FusedEngine, "step", watched)
    assert (
        recover(start(), photos(KINDS["exposure"]), RecoverConfig(steps=100)).report.exposure
        is not None
    )
    assert not changing[0]
    assert changing[-1]


@pytest.mark.parametrize("tone", [0.0, 1.0], ids=["black", "saturated"])
def test_pixels_at_the_ends_of_the_range_tell_no_exposure(tone: float) -> None:
    """Half of every second photo is cut off; what remains alone has its gain."""
    targets = photos(np.where(np.arange(12) % 2, 0.7, 1.3))
    cut = [np.array(targets[view]) for view in range(12)]
    for image in cut[::2]:
        image[:, ::2] = tone
    found = exposures_of(BALL.with_sh_degree(0), Photos(VIEWS, cut), (0, 0, 0), decided=True)
    assert found is not None
    gains = found @ [0.3, 1.0]
    np.testing.assert_allclose(gains[1::2].mean() / gains[::2].mean(), 0.7 / 1.3, atol=0.06)


def test_background_beyond_a_photo_with_alpha_has_no_exposure() -> None:
    """Dim only the scene's own light on a white background."""
    thin = replace(BALL, logit_opacities=np.full(len(BALL), -1.5, np.float32)).with_sh_degree(0)
    gains, white = np.array([0.5, 1.0] * 6), g2ard.Renderer(thin, background=(1, 1, 1))
    drawn, taken = [white.render(view) for view in VIEWS], []
    for one, gain in zip(drawn, gains, strict=True):
        alpha = one.alpha[..., None]
        own = (one.image - (1 - alpha)) / np.maximum(alpha, 1e-3)
        taken.append(np.concatenate([(gain * own).clip(0, 1), alpha], 2).astype(np.float32))
    targets = Photos(VIEWS, taken, background=(1, 1, 1))
    np.testing.assert_allclose(rendered(white, Exposed(targets), 0), targets[0], atol=0.05)


def test_a_photo_that_is_the_negative_has_the_least_gain() -> None:
    """So that no photo is divided by nothing, or turned over."""
    negative = [0.9 - 0.8 * image for image in RENDERS]
    found = exposures_of(BALL.with_sh_degree(0), Photos(VIEWS, negative), (0, 0, 0), decided=True)
    assert found is not None
    assert (found[..., 0] > 0).all()
    made, _ = unexposed(Photos(VIEWS, negative), 0, found[0], (0, 0, 0))
    assert np.isfinite(made).all()
    fit = Moments(
        np.tile(np.diag([1.0, 9.0]), (3, 1, 1)), np.tile([-3.0, 0.0], (3, 1)), np.ones(3), 100
    ).fit()
    np.testing.assert_array_equal(fit[:, 0], 0.05)


def test_masked_and_lost_pixels_are_zero_and_transparent_ones_are_not_lost() -> None:
    taken = [np.full((36, 48, 4), 0.4, np.float32) for _ in VIEWS]
    taken[2][..., 3] = 1
    taken[2][:4, :, 3] = 0  # transparent, and white behind
    taken[2][8:12, :, :3] = 1  # saturated
    image, mask = unexposed(
        Photos(VIEWS, taken, background=(1, 1, 1)), 2, np.array([[2.0, 0.0]] * 3), (1, 1, 1)
    )
    assert mask is not None
    assert mask[:8].all()
    assert not mask[8:12].any()
    assert not image[8:12].any()
    np.testing.assert_allclose(image[:4], 1, atol=1e-6)
    np.testing.assert_allclose(image[12:], 0.2, atol=1e-6)
