"""--device: GPU kernels agree with the CPU's within a stated tolerance; if one fails, the CPU continues."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import g2ard._core as _core
from g2ard.cli.run import Run
from g2ard.io import read_splats, write_splats, write_views
from g2ard.poses import make_pool
from g2ard.rendering.metrics import psnr
from g2ard.rendering.renderer import RasterSettings, Renderer
from g2ard.rendering.targets import TeacherRenders
from g2ard.rendering.visibility import visibility_source
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats
from g2ard.stages.recover.config import RecoverConfig
from g2ard.stages.recover.optimize import recover
from g2ard.stages.select import surface, visible_cells
from g2ard.stages.simplify import Simplified, simplify
from g2ard.system import devices
from helpers.commands import CommandLine, refused, succeeds
from helpers.gpus import skip_without_gpu
from helpers.project import ROOT
from helpers.realdata import real
from helpers.scenes import around, assert_same_bits, checkered_ball
from helpers.simplify_cases import flag

SEEN_ALIKE = 0.999
"""Share of (view, cell) that must agree."""

DECIBELS = 0.05
"""PSNR (dB) that a scene made on a GPU may lose against one made on the CPU."""


@pytest.fixture
def gpu() -> Iterator[None]:
    """Use the GPU, software ones too. Skip without one, unless the environment requires it."""
    skip_without_gpu()
    devices.use("gpu")
    yield
    devices.use("cpu")


def served() -> int:
    """Return how many kernels ran on the GPU; check that none failed."""
    assert devices.notes() == []
    return devices.state().served


def assert_same(a: Simplified, b: Simplified) -> None:
    for name in ("means", "quats", "scales", "logit_opacities", "sh0", "shN"):
        np.testing.assert_array_equal(getattr(a.splats, name), getattr(b.splats, name))
    np.testing.assert_array_equal(a.parents, b.parents)


def assert_close(there: Simplified, here: Simplified, prior: Splats, cameras: Cameras) -> None:
    """The same count exactly, and renders as near to the prior's."""
    assert len(there.splats) == len(here.splats)
    quality = []
    for splats in (there.splats, here.splats, prior):
        renderer = Renderer(splats)
        quality.append(np.concatenate([renderer.image(camera) for camera in cameras]))
    a, b = (psnr(images, quality[2]) for images in quality[:2])
    assert abs(a - b) <= DECIBELS


def cells_in(seen: tuple[np.ndarray, np.ndarray], view: int) -> set[int]:
    starts, cells = seen
    return set(cells[slice(*starts[view : view + 2])].tolist())


def seen_alike(splats: Splats, cameras: Cameras, cells: int) -> tuple[float, float]:
    """The share of (view, cell) that CPU and GPU agree on: of all, and of those that either sees."""
    prior = surface(splats, cells)
    devices.use("cpu")
    want = visible_cells(splats, prior, cameras)
    devices.use("gpu")
    got = visible_cells(splats, prior, cameras)
    assert served() == 1
    pairs = [(cells_in(want, view), cells_in(got, view)) for view in range(len(cameras))]
    differ = sum(len(a ^ b) for a, b in pairs)
    either = sum(len(a | b) for a, b in pairs)
    assert either > 0
    return 1 - differ / (len(cameras) * len(prior.centers)), 1 - differ / either


@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (691234.5, 5334567.25, 512.0)])
def test_the_papers_policy_makes_nearly_the_same_scene(
    offset: tuple[float, float, float], gpu: None
) -> None:
    ball = checkered_ball(2000)
    prior = Splats.create(
        ball.means.astype(np.float64) + offset,
        quats=ball.quats,
        scales=ball.scales,
        logit_opacities=ball.logit_opacities,
        sh0=ball.sh0,
        shN=ball.shN,
    )
    there = simplify(prior, 300, method="paper")
    assert served() > 10
    assert_same(simplify(prior, 300, method="paper"), there)
    flags = flag(prior, 300)
    devices.use("cpu")
    cameras = around(4, (96, 72)).recentred([-x for x in offset])
    assert_close(simplify(prior, 300, method="paper"), there, prior, cameras)
    assert np.mean(flag(prior, 300) == flags) >= 0.99


def test_views_see_the_same_cells(gpu: None) -> None:
    every, seen = seen_alike(checkered_ball(3000), around(12, (120, 90)), 1500)
    assert min(every, seen) >= SEEN_ALIKE


def test_a_real_scene_is_nearly_the_same(gpu: None) -> None:
    prior = read_splats(real("taebak_park", "0_4"))
    prior = prior.take(np.argsort(prior.means[:, 0], kind="stable")[:40_000])
    there = simplify(prior, 4000, method="paper")
    assert served() > 10
    devices.use("cpu")
    views = make_pool(prior, 6).resized(192)
    assert_close(simplify(prior, 4000, method="paper"), there, prior, views)
    assert min(seen_alike(prior, views, 10_000)) >= SEEN_ALIKE


def test_looks_of_the_default_method_run_on_the_gpu(gpu: None) -> None:
    """Σ αT² within 10⁻⁴ of its sum; the budget exactly, and renders as good."""
    ball, views = checkered_ball(1500), around(20, (80, 60))
    there = visibility_source(views)(ball)
    assert served() == 2  # two rounds of views
    again = visibility_source(views)(ball)
    np.testing.assert_array_equal(there.weight, again.weight)
    made = simplify(ball, 300, visibility=visibility_source(views))
    devices.use("cpu")
    here = visibility_source(views)(ball)
    np.testing.assert_array_equal(there.pixel_size, here.pixel_size)
    assert np.abs(there.weight - here.weight).sum() <= 1e-4 * here.weight.sum()
    assert_close(
        made, simplify(ball, 300, visibility=visibility_source(views)), ball, views.take(range(4))
    )


IMAGES = [
    RasterSettings(),
    RasterSettings(antialiased=True, near=2.5),
    RasterSettings(alpha_max=0.999, near=0.2),
]


@pytest.mark.parametrize("settings", IMAGES, ids=["plain", "antialiased", "older"])
@pytest.mark.parametrize("offset", [0.0, 600_000.0])
def test_images_are_drawn_on_the_gpu(settings: RasterSettings, offset: float, gpu: None) -> None:
    ball, views = checkered_ball(2000), around(3, (75, 50)).recentred([-offset, 0.0, 0.0])
    ball = replace(ball, means=ball.means + np.array([offset, 0.0, 0.0]))
    background = (0.1, 0.2, 0.3)
    devices.use("cpu")
    here = Renderer(ball, background=background, settings=settings)
    want = [here.image(view) for view in views]
    devices.use("gpu")
    there = Renderer(ball, background=background, settings=settings)
    got = [there.image(view) for view in views]
    assert served() == 1
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-5)
    np.testing.assert_array_equal([there.image(view) for view in views], got)
    assert np.std(got) > 0.01


def test_what_the_gpu_does_not_draw_is_the_cpus(gpu: None) -> None:
    """Depths and panoramas, also after an image of the GPU's, and INRIA's convention."""
    ball, view = checkered_ball(500), around(1, (48, 40))[0]
    made = []
    for device in ("cpu", "gpu"):
        devices.use(device)
        renderer, inria = (
            Renderer(ball),
            Renderer(ball, settings=RasterSettings(convention="inria")),
        )
        around_it = renderer.panorama(view, width=32).image
        renderer.image(view)
        rendered = renderer.render(view, median=True)
        made.append(
            [around_it, rendered.image, rendered.depth, rendered.median, inria.image(view)],
        )
    assert served() == 1
    for here, there in zip(*made, strict=True):
        np.testing.assert_array_equal(here, there)


@pytest.mark.parametrize(
    "most", [64, 40_000, 200_000], ids=["to open", "for a scene", "for a view"]
)
def test_images_are_the_cpus_if_a_gpu_has_no_room(most: int, gpu: None) -> None:
    ball, views = checkered_ball(600), around(3, (160, 120))
    devices.use("cpu")
    want = [Renderer(ball).image(view) for view in views]
    _core.set_device("gpu", most)
    renderer = Renderer(ball)
    np.testing.assert_array_equal([renderer.image(view) for view in views], want)
    assert len(devices.notes()) == 1
    np.testing.assert_array_equal(Renderer(ball).image(views[0]), want[0])
    assert devices.notes() == []


def test_threads_share_a_renderer_on_the_gpu(gpu: None) -> None:
    renderer, views = Renderer(checkered_ball(500)), around(6, (48, 36))
    want = [renderer.image(view) for view in views]
    with ThreadPoolExecutor(3) as pool:
        np.testing.assert_array_equal(list(pool.map(renderer.image, views)), want)
    assert served() == 1


COMMANDS = {
    "simplify a.ply -n 100 --views v.json -o out.ply": 1,
    "simplify a.ply -r 10 --method paper -o out.ply": 11,
    "select a.ply --views v.json -k 3 --policy directional --set cells=300 -o out.json": 1,
    "render a.ply --views v.json -o out": 1,
    "evaluate b.ply --views v.json --teacher a.ply --split all": 1,
    "compare a.ply b.ply --views v.json": 1,
    "recover b.ply --views v.json --teacher a.ply --steps 4 -o out.ply": 3,
    "adapt b.ply --views v.json --teacher a.ply --steps 4 -o out.ply": 3,
}
"""Command → the fewest kernels that it runs on a GPU."""


@pytest.mark.parametrize("words", COMMANDS)
def test_commands_say_what_the_gpu_did(
    words: str, tmp_path: Path, command_line: CommandLine, gpu: None
) -> None:
    write_splats(tmp_path / "a.ply", checkered_ball(500))
    write_splats(tmp_path / "b.ply", checkered_ball(200))
    write_views(tmp_path / "v.json", around(4, (48, 36)))
    ask, made = (*words.split(), "-w", "-v", "--json", "-", "--device"), set()
    for device in ("cpu", "gpu") if words.startswith(("simplify", "select")) else ("gpu",):
        out, told = succeeds(command_line, tmp_path, *ask, device)
        if not words.startswith("render"):
            assert ("kernels on" in told) == (device == "gpu")
        assert "on the CPU" not in told
        if (tmp_path / "out.ply").exists():
            made.add(len(read_splats(tmp_path / "out.ply")))
        used = json.loads(out).get("device")
        if device == "cpu":
            assert used is None
        else:
            assert used["adapter"] == devices.adapters()[0].name  # type: ignore[index]
            assert used["kernels"] >= COMMANDS[words]
            assert used["uploaded_bytes"] > 10_000
    assert len(made) <= 1


def test_failures_are_reported_at_once(capsys: pytest.CaptureFixture, gpu: None) -> None:
    common = dict.fromkeys(("overwrite", "verbose", "quiet", "json", "config")) | {
        "seed": 0,
        "threads": 0,
    }
    run = Run("simplify", {**common, "device": "gpu"}, {})
    _core.set_device("gpu", 64)  # too small for a row
    simplify(checkered_ball(60), 20, method="paper")
    run.progress("simplify", 1, 2)
    assert capsys.readouterr().err.startswith("GPU: ")
    run.progress("simplify", 2, 2)
    assert "GPU" not in capsys.readouterr().err


@pytest.mark.parametrize(
    "most", [64, 40_000, 200_000], ids=["to open", "for a scene", "for a view"]
)
def test_recovery_continues_on_the_cpu_if_a_gpu_has_no_room(most: int, gpu: None) -> None:
    ball = checkered_ball(300)
    targets, config = TeacherRenders(ball, around(4)), RecoverConfig(steps=5)
    devices.use("cpu")
    want = recover(ball, targets, config)
    _core.set_device("gpu", most)
    found = recover(ball, targets, config)
    notes = devices.notes()
    assert 1 <= len(notes) <= 2  # of steps and of images
    assert all(note.endswith("goes on on the CPU") for note in notes)
    assert_same_bits(want.splats, found.splats)
    assert want.report.loss == found.report.loss


@pytest.mark.parametrize("kilobytes", [600_000, 3_000_000])
def test_little_address_space_ends_on_the_cpu(kilobytes: int, tmp_path: Path, gpu: None) -> None:
    """Drivers that run out of it end the process, so they are not asked."""
    if sys.platform != "linux":
        pytest.skip("only Linux tells how much is left")
    write_splats(tmp_path / "a.ply", checkered_ball(1000))
    command = f'ulimit -v {kilobytes}; exec "$0" -m g2ard simplify a.ply -r 10 --method paper "$@"'
    outputs = []
    for device in ("cpu", "gpu"):
        name = f"{device}.ply"
        done = subprocess.run(
            ["sh", "-c", command, sys.executable, "-o", name, "--device", device, "--threads", "2"],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            timeout=300,
        )
        assert done.returncode == 0, done.stderr
        outputs.append((tmp_path / name).read_bytes())
        notes = [line for line in done.stderr.splitlines() if "goes on on the CPU" in line]
        if device == "gpu" and kilobytes < 1_000_000:
            assert len(notes) == 1
            assert "MB of address space" in notes[0]
    if kilobytes < 1_000_000:
        assert outputs[0] == outputs[1]


def test_lists_devices(tmp_path: Path, command_line: CommandLine) -> None:
    out, told = succeeds(command_line, tmp_path, "info", "--devices", "--json", "-")
    assert told.splitlines()[0].strip() == "What --device takes"
    assert "--device gpu" in told
    assert "┡" not in told  # what ends a header
    found = json.loads(out)
    names = [a["name"] for a in found["adapters"]]
    assert found["used"]["gpu"] == (names[0] if names else None)
    assert all(a["kind"] != "cpu" or a["name"] != found["used"]["auto"] for a in found["adapters"])
    out = succeeds(command_line, tmp_path, "info", "--devices").out
    assert all(name in out for name in names or ["the CPU"])
    for wrong in ((), ("a.ply", "--devices")):
        assert "give a file, or --devices" in refused(command_line, tmp_path, "info", *wrong)


def test_without_an_adapter_one_line_and_the_cpu(
    tmp_path: Path, command_line: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    if devices.adapters() is None:
        pytest.skip("no GPU kernels in this build")
    for name in ("VK_ICD_FILENAMES", "VK_DRIVER_FILES"):
        monkeypatch.setitem(os.environ, name, str(tmp_path / "none.json"))
    write_splats(tmp_path / "a.ply", checkered_ball(500))
    paper = ("simplify", "a.ply", "-r", "5", "--method", "paper", "-w")
    status, _, told = command_line(*paper, "-o", "gpu.ply", "--device", "gpu", cwd=tmp_path)
    if "no adapter" not in told:
        pytest.skip("this machine's driver is not Vulkan's")
    assert status == 0
    lines = told.splitlines()
    # before the summary
    assert [line for line in lines if "goes on on the CPU" in line] == [lines[0]]
    assert lines[1].startswith("gpu.ply")
    told = succeeds(command_line, tmp_path, *paper, "-o", "cpu.ply", "--device", "auto").err
    assert "GPU" not in told
    assert (tmp_path / "cpu.ply").read_bytes() == (tmp_path / "gpu.ply").read_bytes()
    out = succeeds(command_line, tmp_path, "info", "--devices", "--json", "-").out
    assert json.loads(out) == {**json.loads(out), "adapters": []}


def test_nothing_to_do_is_reported(tmp_path: Path, command_line: CommandLine) -> None:
    write_splats(tmp_path / "a.ply", checkered_ball(500))
    fast = ("simplify", "a.ply", "-r", "5", "--method", "fast", "-o", "b.ply", "--device", "gpu")
    told = succeeds(command_line, tmp_path, *fast).err
    assert "--device gpu: not used" in told


def test_a_software_gpu_is_reported(command_line: CommandLine, folder: Path, gpu: None) -> None:
    found = devices.adapters()
    assert found
    if found[0].kind != "cpu":
        pytest.skip("a real GPU comes first")
    ask = ("simplify", "ball.ply", "-r", 2, "--method", "paper", "-o", "s.ply", "--device", "gpu")
    error = succeeds(command_line, folder, *ask).err
    assert error.count(f"--device gpu: {found[0].name} is a software renderer") == 1
