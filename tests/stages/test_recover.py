"""The recovery loop: it recovers, both engines agree, it resumes to the same bits, it holds the anchors."""

import itertools
import math
import re
import signal
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from g2ard.errors import DeviceError, InputError
from g2ard.rendering.renderer import Renderer
from g2ard.rendering.targets import Photos, Subset, TeacherRenders
from g2ard.rendering.visibility import visibility
from g2ard.scene.samples import evenly_spaced
from g2ard.scene.splats import Splats, unit_quats
from g2ard.stages.evaluate import evaluate
from g2ard.stages.recover import checkpoint as checkpoint_module
from g2ard.stages.recover import loop, probe, trials
from g2ard.stages.recover.anchors import REGULARIZERS, Anchors
from g2ard.stages.recover.config import TUNED, RecoverConfig
from g2ard.stages.recover.engine import FusedEngine
from g2ard.stages.recover.guard import Guard, blend
from g2ard.stages.recover.optimize import recover
from g2ard.stages.recover.report import describe_outcome, describe_time_limit
from g2ard.stages.simplify import SimplifyConfig, simplify
from g2ard.system import devices
from helpers.gpus import skip_without_gpu
from helpers.interruptions import press_ctrl_c_at
from helpers.scenes import around, assert_same_bits, checkered_ball, under_a_sky
from helpers.threads import on_threads

VIEWS = around()
TEACHER = checkered_ball()
NARROW = SimplifyConfig(surface_depth=math.inf, max_growth=1.25)
"""Settings of starts whose gaps recovery has to close."""
UNEVEN = np.linspace(0, 3, len(VIEWS)) ** 2
"""Weights of views."""


@pytest.fixture(scope="module")
def targets() -> TeacherRenders:
    return TeacherRenders(TEACHER, VIEWS)


@pytest.fixture(scope="module")
def photos(targets: TeacherRenders) -> Photos:
    """The same images as photos, for which rates are tried."""
    return Photos(targets.cameras, [targets[view] for view in range(len(targets.cameras))])


@pytest.fixture(scope="module")
def student() -> Splats:
    # leaves recovery more to do than the default
    return simplify(TEACHER, 500, method="paper").splats


@pytest.fixture
def engine(request: pytest.FixtureRequest) -> Iterator[str]:
    """An engine by its name, or "gpu": the fused engine's on the GPU."""
    if request.param != "gpu":
        yield request.param
        return
    skip_without_gpu()
    devices.use("gpu")
    yield "fused"
    notes = devices.notes()
    devices.use("cpu")
    assert notes == []


def test_recovery_lifts_unseen_views(student: Splats, targets: TeacherRenders) -> None:
    result = recover(student, targets, RecoverConfig(steps=150))
    unseen = TeacherRenders(TEACHER, around(7, (80, 60), 2.5))
    assert len(result.splats) == len(student)
    assert evaluate(result.splats, unseen).psnr > evaluate(student, unseen).psnr + 3
    assert result.report.psnr.after > result.report.psnr.before + 3
    assert len(result.report.loss) == 100
    assert [point.step for point in result.report.geometry] == [15 * k for k in range(1, 11)]
    assert result.report.geometry[-1].drift95 == result.report.drift95
    assert result.report.regularizers.steps == 1


@pytest.mark.parametrize(
    ("engine", "reach"), [("fused", None), ("fused", 0.02), ("gpu", None)], indirect=["engine"]
)
def test_engines_take_the_same_steps(
    student: Splats, targets: TeacherRenders, engine: Any, reach: float | None
) -> None:
    """Also where some Gaussians are held back, and for as many steps of each Gaussian."""
    counts: dict[str, NDArray[Any]] = {}

    def recovered(engine: Any) -> Any:
        config = RecoverConfig(schedule=replace(TUNED, reach=reach), steps=30, engine=engine)
        count = lambda step, info, scene: counts.update({engine: scene.__self__.counts})  # noqa: E731
        return recover(student, targets, config, watch=count)

    fused, torch = recovered(engine), recovered("torch")
    assert abs(fused.report.psnr.after - torch.report.psnr.after) < 0.005
    assert counts[engine].max() == 30
    assert (counts[engine] != counts["torch"]).mean() < 0.01
    for name in ("means", "scales", "logit_opacities", "sh0", "shN"):
        ours, theirs = getattr(fused.splats, name), getattr(torch.splats, name)
        moved = np.linalg.norm(ours - getattr(student.with_sh_degree(fused.splats.sh_degree), name))
        assert np.linalg.norm(ours - theirs) < 1e-2 * moved, name


@pytest.mark.parametrize("engine", ["gpu"], indirect=True)
def test_the_gpu_recovers_like_the_cpu(
    student: Splats, targets: TeacherRenders, engine: Any
) -> None:
    config = RecoverConfig(steps=25, regularizers=replace(REGULARIZERS["noisy"], period=10))
    there = recover(student, targets, config)
    assert devices.state().served > 1  # the steps, and images to score
    again = recover(student, targets, config)
    assert_same_bits(there.splats, again.splats)
    devices.use("cpu")
    here = recover(student, targets, config)
    assert abs(here.report.psnr.before - there.report.psnr.before) < 1e-5
    assert abs(here.report.psnr.after - there.report.psnr.after) < 0.02


@pytest.mark.parametrize("call", [4, 70, 140], ids=["in a trial", "early", "late"])
@pytest.mark.parametrize("saved", [False, True])
def test_if_a_device_fails_the_steps_since_the_last_checkpoint_are_repeated(
    student: Splats,
    photos: Photos,
    saved: bool,
    call: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    config = RecoverConfig(steps=110)
    calls, step = [0], FusedEngine.step

    def counted(self: FusedEngine, *args: Any, **kwargs: Any) -> float:
        calls[0] += 1
        if calls[0] == call:
            raise DeviceError("the device was lost")
        return step(self, *args, **kwargs)

    monkeypatch.setattr(FusedEngine, "step", counted)
    monkeypatch.setattr(checkpoint_module, "PERIOD", 0.0)
    checkpoint = tmp_path / "c.npz" if saved else None
    found = recover(student, photos, config, checkpoint=checkpoint)
    failed, call, calls[0] = calls[0], 0, 0
    whole = recover(student, photos, config)
    assert_same_bits(whole.splats, found.splats)
    assert whole.report.loss == found.report.loss
    assert found.report.resumed is None
    assert found.report.geometry == whole.report.geometry
    in_trial = failed - calls[0] <= 25
    assert in_trial if saved else failed > calls[0]


@pytest.mark.parametrize("read", ["splats", "counts"])
def test_a_device_may_fail_while_the_result_is_read(
    student: Splats, targets: TeacherRenders, read: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = RecoverConfig(steps=12, schedule=replace(TUNED, multiplier=1.0))
    others = TeacherRenders(TEACHER, around(3, (40, 30), 2.0))
    whole = recover(student, targets, config, validation=others)
    reader, reads = getattr(FusedEngine, read), []

    def lost(self: FusedEngine) -> Any:
        reads.append(read)
        if len(reads) == 1:
            raise DeviceError("the device was lost")
        return reader(self) if read == "splats" else reader.fget(self)

    monkeypatch.setattr(FusedEngine, read, lost if read == "splats" else property(lost))
    found = recover(student, targets, config, validation=others)
    assert len(reads) > 1
    assert_same_bits(whole.splats, found.splats)


def test_same_bits_from_run_to_run_and_for_any_threads(
    student: Splats, targets: TeacherRenders
) -> None:
    config = RecoverConfig(steps=25, regularizers=replace(REGULARIZERS["noisy"], period=10))
    first, *others = on_threads(lambda: recover(student, targets, config).splats)
    for other in others:
        assert_same_bits(first, other)


@pytest.mark.parametrize(
    ("engine", "steps", "weights"),
    [("fused", 110, None), *((engine, 24, UNEVEN) for engine in ("fused", "torch", "gpu"))],
    indirect=["engine"],
)
def test_an_interrupted_run_resumes_to_the_same_bits(
    student: Splats, photos: Photos, engine: Any, steps: int, weights: Any, tmp_path: Path
) -> None:
    config = RecoverConfig(
        steps=steps, engine=engine, regularizers=replace(REGULARIZERS["lift"], period=10)
    )
    run = partial(recover, student, photos, config, weights=weights)
    whole = run()
    checkpoint = tmp_path / "c.npz"
    with pytest.raises(KeyboardInterrupt):
        run(checkpoint=checkpoint, progress=press_ctrl_c_at("recover", 17))
    assert checkpoint.exists()
    resumed = run(checkpoint=checkpoint)
    assert_same_bits(whole.splats, resumed.splats)
    assert whole.report.loss == resumed.report.loss
    assert whole.report.resumed is None
    assert resumed.report.resumed is not None
    assert 0 < resumed.report.resumed < resumed.report.seconds
    assert whole.report.trials == resumed.report.trials
    assert whole.report.regularizers.steps == resumed.report.regularizers.steps
    assert bool(whole.report.trials) == (steps >= 100)
    assert whole.report.geometry == resumed.report.geometry


def test_an_interrupt_during_trials_is_kept(
    photos: Photos, student: Splats, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Even if what runs at that moment hides it."""
    learn = loop.Loop._learn

    def interrupted(*arguments: Any, **options: Any) -> float:
        with suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        return learn(*arguments, **options)

    monkeypatch.setattr(loop.Loop, "_learn", interrupted)
    told, config = [], RecoverConfig(steps=150)
    with pytest.raises(KeyboardInterrupt):
        recover(student, photos, config, progress=lambda stage, done, *_: told.append(done))
    assert told == [0]


def test_resume_refuses_other_options(
    student: Splats, targets: TeacherRenders, tmp_path: Path
) -> None:
    checkpoint = tmp_path / "c.npz"
    config = RecoverConfig(steps=40)
    moved = replace(student, means=student.means + 1)
    with pytest.raises(KeyboardInterrupt):
        recover(
            student, targets, config, checkpoint=checkpoint, progress=press_ctrl_c_at("recover", 5)
        )
    ask = {"student": student, "targets": targets, "config": config, "checkpoint": checkpoint}
    for other in (
        {"config": replace(config, seed=1)},
        {"targets": TeacherRenders(student, VIEWS)},
        {"anchors": Anchors.of(moved)},
        {"weights": UNEVEN},
        {"frozen": np.arange(len(student)) < 250},
        {"validation": TeacherRenders(TEACHER, around(3))},
        {"student": replace(student, sh0=student.sh0 + np.float32(0.1))},
        {"targets": Subset(targets, range(len(VIEWS) - 1))},
    ):
        with pytest.raises(InputError, match="other options"):
            recover(**ask | other)
    checkpoint.write_bytes(checkpoint.read_bytes()[:100])
    with pytest.raises(InputError, match="not a checkpoint"):
        recover(**ask)


def test_trials_choose_rates_that_suit_the_scene(
    student: Splats, targets: TeacherRenders, photos: Photos
) -> None:
    report = recover(student, photos, RecoverConfig(steps=100)).report
    most = max(trial.psnr for trial in report.trials) - report.psnr.before
    good = [t for t in report.trials if t.psnr - report.psnr.before >= 0.96 * most]
    assert report.multiplier == max(trial.multiplier for trial in good)
    assert len(report.trials) >= 2
    # nothing to gain: small steps
    nearly = recover(TEACHER, targets, RecoverConfig(steps=100)).report
    assert nearly.multiplier < 0.34
    # of renders the error says enough
    rough = recover(student, targets, RecoverConfig(steps=100)).report
    assert 1 / 3 < rough.multiplier == loop.guess_multiplier(10 ** (-rough.psnr.before / 20))
    assert not rough.trials
    assert nearly.trials
    fixed = RecoverConfig(schedule=replace(TUNED, multiplier=0.7), steps=100)
    report = recover(student, targets, fixed).report
    assert (report.multiplier, report.trials) == (0.7, ())


def test_layers_as_wide_as_the_sky_do_not_shake_the_image() -> None:
    targets = TeacherRenders(under_a_sky(TEACHER), around(12, (160, 120)))
    start = under_a_sky(simplify(TEACHER, 1500, config=NARROW).splats)
    held, free = (
        recover(
            start,
            targets,
            RecoverConfig(
                schedule=replace(TUNED, multiplier=1.0, reach=reach, momentum=0.9), steps=150
            ),
        )
        for reach in (None, math.inf)
    )
    assert (held.report.reach, free.report.reach) == (pytest.approx(0.0252, rel=1e-2), None)
    assert held.report.psnr.after > free.report.psnr.after + 0.5
    moved = [np.abs(done.splats.means - start.means)[-300:].max() for done in (held, free)]
    assert moved[0] < 0.01 * moved[1]


@pytest.mark.parametrize("engine", ["fused", "torch", "gpu"], indirect=True)
def test_gaussians_behind_a_mask_do_not_change(student: Splats, engine: Any) -> None:
    kept = 20  # columns that count

    class Masked(TeacherRenders):
        def mask(self, view: int) -> Any:
            height, width, _ = self[view].shape
            return np.tile(np.arange(width) < kept, (height, 1))

    views = VIEWS.take(np.arange(2))
    config = RecoverConfig(
        steps=12, engine=engine, schedule=replace(TUNED, multiplier=1.0, reach=math.inf)
    )
    after = recover(student, Masked(TEACHER, views), config).splats
    strip = replace(views, widths=np.full_like(views.widths, kept))
    drawn, counted = (visibility(student, v).hits > 0 for v in (views, strip))
    alone = drawn & ~counted
    assert alone.sum() > 30
    assert counted.sum() > 30
    for name in ("means", "logit_opacities", "sh0"):
        moved = (
            (getattr(after, name) != getattr(student, name)).reshape(len(student), -1).any(axis=1)
        )
        assert not moved[alone].any(), name
        assert moved[counted].mean() > 0.5, name


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """A clock that advances by 10 ms per call on any machine."""
    ticks = itertools.count()
    for module in (loop, trials):
        monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: next(ticks) / 100))


@pytest.mark.usefixtures("clock")
def test_a_recovery_time_sets_the_horizon(student: Splats, targets: TeacherRenders) -> None:
    short = recover(student, targets, RecoverConfig(recovery_time=0.05)).report
    assert (short.trials, short.seconds < 0.3) == ((), True)  # no time to try rates
    report = recover(student, targets, RecoverConfig(recovery_time=6.0)).report
    assert 50 < report.steps < 600
    assert 6.0 <= report.seconds < 6.1
    assert report.psnr.after > report.psnr.before + 1


@pytest.mark.usefixtures("clock")
def test_a_recovery_that_time_ends_says_what_it_missed(
    student: Splats, targets: TeacherRenders
) -> None:
    seen: dict[int, tuple[float, Splats]] = {}
    config = RecoverConfig(recovery_time=6.0)

    def watch(step: int, seconds: float, scene: Callable[[], Splats]) -> None:
        seen[step] = seconds, scene()

    done = recover(student, targets, config, watch=watch).report
    planned = config.final_steps(student, targets.cameras, of_photos=False)
    assert done.steps < planned == done.planned
    looked = 1 + min(step for step, (seconds, _) in seen.items() if seconds >= 0.75 * 6.0)
    before, after = (
        probe.Probe(targets, config.background).score(seen[step][1])
        for step in (looked, done.steps)
    )
    assert done.pace == pytest.approx(100 * (after - before) / (done.steps - looked))
    gaining = (
        f"it was still gaining {done.pace:.1f} dB"
        if done.pace >= 0.05
        else "it gained under 0.05 dB"
    )
    told = f"time ended recovery at step {done.steps} of {planned:,}; {gaining} per 100 steps"
    assert describe_time_limit(done) == told
    long_enough = replace(config, schedule=replace(TUNED, steps=20))
    assert describe_time_limit(recover(student, targets, long_enough).report) is None
    unlimited = recover(student, targets, RecoverConfig(steps=20)).report
    assert (unlimited.planned, unlimited.pace) == (None, None)


def test_progress_figures(
    student: Splats, targets: TeacherRenders, monkeypatch: pytest.MonkeyPatch
) -> None:
    for share in ("_SCORING_TIME_SHARE", "_FIRST_SCORING_SHARE"):
        monkeypatch.setattr(probe, share, 1e9)  # after every step, however long one takes
    seen: list[Any] = []
    scenes: dict[int, Splats] = {}
    recover(
        student,
        targets,
        RecoverConfig(steps=60),
        progress=lambda *a: seen.append(a) if a[0] == "recover" and a[1] else None,
        watch=lambda step, _, splats: scenes.update({step: splats()}),
    )
    assert [a[1] for a in seen] == list(range(1, 61))
    assert set(seen[-2][3]) == {"loss", "PSNR", "steps/s"}
    assert "PSNR" not in seen[-1][3]  # that of an earlier step would pass for the result's
    shown = {tuple(re.findall(r"[\d.]+", figures["PSNR"])) for *_, figures in seen[:-1]}
    assert len(shown) > 2
    for value, step in shown:  # each is of the step it names
        want = probe.Probe(targets, (0.0, 0.0, 0.0)).score(scenes[int(step)])
        assert float(value) == pytest.approx(want, abs=0.0051)


def test_a_start_that_cannot_be_bettered_is_kept(targets: TeacherRenders) -> None:
    ball = checkered_ball(1500)
    grain = np.random.default_rng(0).normal(0, 1e-3, ball.sh0.shape).astype(np.float32)
    start = replace(ball, sh0=ball.sh0 + grain)
    there = TeacherRenders(ball, targets.cameras)
    done = recover(start, there, RecoverConfig(schedule=replace(TUNED, multiplier=3**0.5), steps=5))
    assert done.report.kept_start
    np.testing.assert_array_equal(done.splats.means, start.means)
    np.testing.assert_array_equal(done.splats.sh0, start.sh0)
    assert done.report.psnr.after == done.report.psnr.before < 100
    calm = recover(start, there, RecoverConfig(steps=100)).report
    assert calm.multiplier < 0.3


WILD = replace(TUNED, multiplier=20.0, reach=math.inf)
"""Rates that no scene bears."""


def test_steps_that_lose_are_undone_and_made_smaller(targets: TeacherRenders) -> None:
    start = simplify(TEACHER, 1500).splats
    done = recover(start, targets, RecoverConfig(schedule=WILD, steps=100)).report
    assert [found.step for found in done.backed_off][:2] == [10, 30]
    assert done.multiplier == pytest.approx(20 / 3 ** len(done.backed_off))
    assert done.psnr.after > done.psnr.before + 1
    assert not done.kept_start
    told = describe_outcome(done)
    assert told.startswith(f"recovery fell to {done.backed_off[0].psnr:.2f} dB (start ")


def test_a_resume_after_undone_steps_gives_the_same_bits(
    targets: TeacherRenders, tmp_path: Path
) -> None:
    start = simplify(TEACHER, 1500).splats
    config = RecoverConfig(schedule=replace(WILD, multiplier=6.0), steps=60)
    whole = recover(start, targets, config)
    assert whole.report.backed_off
    for step in (9, 35, 58):
        checkpoint = tmp_path / f"{step}.npz"
        with pytest.raises(KeyboardInterrupt):
            recover(
                start,
                targets,
                config,
                checkpoint=checkpoint,
                progress=press_ctrl_c_at("recover", step),
            )
        resumed = recover(start, targets, config, checkpoint=checkpoint)
        assert_same_bits(whole.splats, resumed.splats)
        for key in ("backed_off", "multiplier", "psnr", "stopped", "blend"):
            assert getattr(whole.report, key) == getattr(resumed.report, key), key


def test_a_hopeless_recovery_stops_early_and_says_so(targets: TeacherRenders) -> None:
    grain = np.random.default_rng(0).normal(0, 1e-3, TEACHER.sh0.shape).astype(np.float32)
    start = replace(TEACHER, sh0=TEACHER.sh0 + grain)
    done = recover(start, targets, RecoverConfig(schedule=WILD, steps=100))
    assert done.report.kept_start
    assert done.report.steps == done.report.stopped == 75
    assert_same_bits(done.splats, replace(start, quats=unit_quats(start.quats)))
    told = describe_outcome(done.report)
    assert told.startswith("kept the start: recovery fell to ")
    assert told.endswith("given up at step 75")


def test_a_change_that_ends_too_low_is_cut_back() -> None:
    ball = checkered_ball(50)
    end = replace(ball, means=ball.means + 4, quats=-ball.quats, scales=ball.scales * 16)
    half = blend(ball, end, 0.5)
    np.testing.assert_allclose(half.means, ball.means + 2, rtol=1e-5)
    np.testing.assert_allclose(half.scales, ball.scales * 4, rtol=1e-5)
    norm = np.linalg.norm(ball.quats, axis=1, keepdims=True)
    np.testing.assert_allclose(np.abs(half.quats), np.abs(ball.quats / norm), atol=1e-6)

    def score(scene: Splats) -> float:  # best at a third of the way
        return -abs(float(scene.means.mean()) - float(ball.means.mean()) - 4 / 3)

    guard = Guard(score, ball, score(ball))
    part, value, way = guard.choose_by_training(end)
    assert way == 0.5
    np.testing.assert_array_equal(part.means, half.means)
    assert value > guard.before
    assert Guard(score, ball, 0.0).choose_by_training(end)[0] is ball


def test_validation_views_scale_back_harmful_changes() -> None:
    start = checkered_ball(4)
    end = replace(start, means=start.means + 1)
    views = np.array([1.0, 5.0, 20.0, 400.0])

    def way(scene: Splats) -> NDArray[np.float64]:
        return (scene.means - start.means).mean(1).astype(np.float64)

    def guard(training: float, others: Callable[[Splats], float]) -> Guard:
        def by_kind(scene: Splats) -> dict[str, float]:
            return {"near": others(scene)}

        return Guard(lambda scene: training * float(way(scene).mean()), start, 0.0, by_kind)

    def doubtful(scene: Splats) -> float:  # what one view has seen costs, what many have pays
        return float(way(scene) @ [-3, 0.5, 1, 1])

    part, k = guard(10.0, doubtful).choose_by_validation(end, views, 9)
    assert k == 5
    np.testing.assert_allclose(way(part), views / (views + 5), atol=1e-5)
    gaining = guard(10.0, lambda scene: float(way(scene).mean()))
    assert gaining.choose_by_validation(end, views, 9) == (end, 0.0)
    harm = guard(10.0, lambda scene: -float(way(scene).mean()))
    assert harm.choose_by_validation(end, views, 9) == (start, math.inf)
    half = guard(
        10.0, lambda scene: -abs(float(way(scene)[0]) - 0.25) - abs(float(way(scene)[3]) - 0.25)
    )
    part, k = half.choose_by_validation(end, views, 9)
    assert k is None
    np.testing.assert_allclose(way(part), 0.25, atol=1e-5)
    looks = [found["psnr"]["near"] for found in half.validation]
    assert looks == pytest.approx([-0.5, -1.5, 0.0], abs=1e-5)
    alone = Guard(lambda scene: 0.0, start, 0.0)
    assert alone.choose_by_validation(end, views, 9) == (end, 0.0)


def test_training_views_vote_on_which_changes_were_harmful() -> None:
    """The sums of light times change equal those of renders in which one Gaussian alone is white."""
    start = simplify(TEACHER, 50, config=NARROW).splats
    colours = np.random.default_rng(1).normal(0, 0.7, start.sh0.shape).astype(np.float32)
    end = replace(start, sh0=start.sh0 + colours)
    black = replace(end, sh0=np.full_like(end.sh0, -0.5 / 0.28209479177387814))
    nine = around(9, (64, 48), 2.0)
    chosen = nine.take(evenly_spaced(9, 5))
    training, asked, validation = (
        TeacherRenders(TEACHER, views) for views in (nine, chosen, around(5, (64, 48), 2.0))
    )

    def sums(targets: TeacherRenders) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Over all views, and over those that lost."""
        total = np.zeros((2, len(start)))
        for camera, target in zip(targets.cameras, targets, strict=True):
            old, new = (
                (Renderer(scene).clipped(camera).astype(np.float64) - target) ** 2
                for scene in (start, end)
            )
            change = (new - old).mean(axis=2) / (old.mean() * len(target) * target.shape[1])
            for row in range(len(start)):
                white = black.sh0.copy()
                white[row] *= -1
                light = Renderer(replace(black, sh0=white)).clipped(camera)[..., 0]
                total[:, row] += (light * change).sum() * np.array(
                    [1, 10 * np.log10(new.mean() / old.mean()) > 1]
                )
        return total[0], total[1]

    alone, losing = sums(validation)
    together = alone + sums(asked)[0]
    found = probe.find_harmful_changes(start, end, validation, training, (0, 0, 0))
    assert found is not None
    clear = np.minimum(abs(losing), abs(together)) > 1e-3
    np.testing.assert_array_equal(found[clear], ((losing > 0) & (together > 0))[clear])
    assert (clear & ~found & (losing > 0) & (alone > 0)).any()
    assert probe.find_harmful_changes(end, end, validation, training, (0, 0, 0)) is None


def test_a_recovery_that_only_harms_validation_views_stops_at_half(targets: TeacherRenders) -> None:
    """The validation views show another scene."""
    start = simplify(TEACHER, 1500, config=NARROW).splats
    elsewhere = TeacherRenders(checkered_ball(500), around(5, (64, 48), 2.0))
    done = recover(start, targets, RecoverConfig(steps=100), validation=elsewhere)
    assert done.report.stopped == done.report.steps == 50
    assert done.report.kept_start
    assert_same_bits(done.splats, start)
    looks = done.report.validation.looks
    assert [found.step for found in looks] == [0, 50, 50, 50]
    told = describe_outcome(done.report)
    assert told.startswith("kept the start: every step made validation views worse (")


def test_other_views_gain_where_training_views_can_spare_it(
    student: Splats, tmp_path: Path
) -> None:
    cap = around(40).take(np.arange(8))  # from above alone
    kinds = ("near",) * 3 + ("anywhere",) * 3
    targets, near = (
        TeacherRenders(TEACHER, views)
        for views in (cap, replace(around(6, (64, 48), 2.0), kinds=kinds))
    )
    config = RecoverConfig(steps=100)
    plain = recover(student, targets, config)
    held = recover(student, targets, config, validation=near)
    assert plain.report.validation is None
    gains = [
        evaluate(held.splats, views).psnr - evaluate(plain.splats, views).psnr
        for views in (targets, near)
    ]
    assert gains[0] > -0.3
    assert gains[1] >= -min(0.0, gains[0])
    last = held.report.validation.looks[-1].psnr
    of = {kind: Subset(near, [row for row in range(6) if kinds[row] == kind]) for kind in kinds}
    assert last == {
        k: pytest.approx(evaluate(held.splats, views).psnr, abs=1e-3) for k, views in of.items()
    }
    checkpoint = tmp_path / "c.npz"
    stop = press_ctrl_c_at("recover", 60)
    with pytest.raises(KeyboardInterrupt):
        recover(student, targets, config, validation=near, checkpoint=checkpoint, progress=stop)
    with pytest.raises(InputError, match="other options"):
        recover(student, targets, config, checkpoint=checkpoint)
    resumed = recover(student, targets, config, validation=near, checkpoint=checkpoint)
    assert_same_bits(held.splats, resumed.splats)
    assert held.report.validation == resumed.report.validation


def test_the_guard_goes_by_the_kind_of_view_that_loses_most() -> None:
    start = checkered_ball(4)
    end = replace(start, means=start.means + 1)

    def way(scene: Splats) -> float:
        return float((scene.means - start.means).mean())

    def guard(near: float, anywhere: float) -> Guard:
        def others(scene: Splats) -> dict[str, float]:
            return {
                "near": 30 + near * way(scene),
                "anywhere": 20 - anywhere * (way(scene) - 0.25) ** 2,
            }

        return Guard(lambda scene: way(scene), start, 0.0, others)

    seen = np.full(4, 2.0)
    # loses 8 dB at the end, nothing halfway
    part, k = guard(5, 16).choose_by_validation(end, seen, 9)
    assert (k, way(part)) == (2.0, pytest.approx(0.5, abs=1e-5))
    part, k = guard(99, 16).choose_by_validation(end, seen, 9)  # the mean gains, but a kind loses
    assert (k, way(part)) == (None, pytest.approx(0.25, abs=1e-5))
    assert guard(5, 0).choose_by_validation(end, seen, 9) == (end, 0.0)
    losing = guard(5, 16)
    assert losing.look(end, 0.5, 50) == "stop"
    assert losing.lost == pytest.approx((8 - 5) / 2)  # the mean over the kinds
    assert guard(99, 16).look(end, 0.5, 50) == "on"


def test_invalid_options_are_named() -> None:
    for wrong in (
        {"steps": 0},
        {"recovery_time": 0.0},
        {"recovery_time": math.nan},
        {"ssim_weight": 2.0},
    ):
        with pytest.raises(InputError, match=next(iter(wrong))):
            RecoverConfig(**wrong)  # type: ignore[arg-type]


def test_scenes_that_no_view_sees_are_refused(student: Splats, targets: TeacherRenders) -> None:
    with pytest.raises(InputError, match="0 Gaussians"):
        recover(student.take(slice(0, 0)), targets)
    ahead = VIEWS.take([0])
    behind = replace(TEACHER, means=(TEACHER.means - 99 * ahead.forwards[0]).astype(np.float32))
    with pytest.raises(InputError, match="none of 1 view sees the scene"):
        recover(behind, TeacherRenders(TEACHER, ahead), RecoverConfig(steps=2))


def test_after_the_score_changes_the_best_scene_is_scored_anew() -> None:
    """Otherwise a later scene is measured against a score of another kind."""
    start, better = checkered_ball(50), checkered_ball(50, seed=1)
    scores = {id(start): 20.0, id(better): 25.0}
    guard = Guard(lambda scene: scores[id(scene)], start, 20.0)
    guard.look(better, 0.1, 1)
    assert (guard.best, guard.best_score) == (better, 25.0)
    scores |= {id(start): 30.0, id(better): 34.0}
    guard.before = 30.0
    guard.rescore()
    assert guard.best_score == 34.0
    guard.best = start
    guard.rescore()
    assert guard.best_score == 30.0


@pytest.mark.parametrize("known", [False, True])
def test_exposures_that_are_found_change_all_scores(
    known: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Weights that are known from the start change nothing."""
    told: list[str] = []
    running = SimpleNamespace(
        exposures=np.ones((4, 3)) if known else None,
        done=9,
        targets=SimpleNamespace(cameras=around(4)),
        config=SimpleNamespace(background=(0.0, 0.0, 0.0)),
        guard=SimpleNamespace(rescore=lambda: told.append("best")),
        _score_exposed=lambda: told.append("start"),
    )
    monkeypatch.setattr(loop, "exposures_of", lambda *_, **__: np.full((4, 3), 2.0))
    loop.Loop._look_at_exposures(running, checkered_ball(9), 0.5)  # type: ignore[arg-type]
    assert told == ([] if known else ["start", "best"])
    assert (running.exposures == 2).all()


def test_hardly_better_is_not_worth_to_take_changes_back() -> None:
    """A shrinkage that gains 0.02 dB leaves the result as it is; one that gains 0.2 dB is taken."""
    start = checkered_ball(2)
    end = replace(start, means=start.means + 1)
    views = np.array([2.0, 2.0])

    def way(scene: Splats) -> float:
        return float((scene.means - start.means).mean())

    for worth, chosen in ((0.08, 0.0), (0.8, 2.0)):

        def others(scene: Splats, worth: float = worth) -> dict[str, float]:
            # best at half of the way, which k = 2 goes
            return {"near": 5.0 - worth * abs(way(scene) - 0.5)}

        guard = Guard(lambda scene: 10 * min(way(scene), 0.5), start, 0.0, others)
        assert guard.choose_by_validation(end, views, 9)[1] == chosen


@pytest.mark.parametrize(("loss", "decision"), [(0.4, "on"), (0.6, "stop")])
def test_validation_stops_runs_that_lose_half_a_decibel(loss: float, decision: str) -> None:
    start, later = checkered_ball(2), checkered_ball(3)
    guard = Guard(
        lambda scene: 1.0, start, 0.0, lambda scene: {"near": 9.0 - loss * (scene is later)}
    )
    assert guard.look(later, 0.5, 40) == decision
    assert guard.stopped == (40 if decision == "stop" else None)
