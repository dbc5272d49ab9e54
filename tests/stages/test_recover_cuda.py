"""--device cuda: the gsplat engine, on a GPU where there is one, and its wiring everywhere."""

import sys
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from g2ard import io
from g2ard.cli.frame import Run
from g2ard.cli.options import choose_engine
from g2ard.errors import InputError, MissingDependencyError
from g2ard.rendering import cuda
from g2ard.rendering.cuda import renderer_on
from g2ard.rendering.renderer import RasterSettings, Renderer
from g2ard.rendering.targets import TeacherRenders
from g2ard.stages.evaluate import evaluate
from g2ard.stages.recover import RecoverConfig, recover, torch_engine
from g2ard.stages.recover.losses import l1_ssim, l1_ssim_anywhere
from g2ard.stages.simplify import simplify
from helpers.commands import CommandLine, refused
from helpers.raster_cases import gsplat_rasterization
from helpers.scenes import around, checkered_ball

BALL = checkered_ball(1200)
TARGETS = TeacherRenders(BALL, around(6, (40, 30)))


def ready() -> str | None:
    """Return why the GPU tests cannot run here."""
    if not torch.cuda.is_available():
        return "torch finds no CUDA device"
    return None if find_spec("gsplat") else "gsplat is not installed"


@pytest.mark.skipif(ready() is not None, reason=ready() or "")
def test_gsplat_recovers_like_the_cpu() -> None:
    student = simplify(BALL, 300, method="paper").splats
    scores = [
        recover(student, TARGETS, RecoverConfig(steps=60, engine=engine)).report.psnr
        for engine in ("torch", "gsplat")
    ]
    assert scores[0].before == scores[1].before
    assert scores[1].after == pytest.approx(scores[0].after, abs=0.3)


def test_the_engine_passes_gsplats_documented_arguments(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace(rasterization=gsplat_rasterization))
    monkeypatch.setattr(torch_engine, "check_cuda", lambda: None)
    monkeypatch.setattr(torch_engine.GsplatEngine, "device", torch.device("cpu"))
    student = simplify(BALL, 60, method="paper").splats
    reports = [
        recover(student, TARGETS, RecoverConfig(steps=4, engine=engine, background=(0.2, 0.4, 0.1))).report
        for engine in ("torch", "gsplat")
    ]
    assert reports[1].loss == pytest.approx(reports[0].loss, abs=1e-4)


def test_scores_on_the_gpu_are_those_of_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace(rasterization=gsplat_rasterization))
    monkeypatch.setattr(cuda, "DEVICE", "cpu")
    small = simplify(BALL, 60, method="paper").splats
    found = [evaluate(small, TARGETS, device=device).psnr for device in ("cpu", "cuda")]
    assert found[1] == pytest.approx(found[0], abs=1e-3)
    assert isinstance(renderer_on("cuda", small, (0, 0, 0), RasterSettings(convention="inria")), Renderer)


def test_the_loss_in_plain_torch_is_the_fused_one() -> None:
    torch.manual_seed(0)
    target = torch.rand(37, 53, 3)
    gradients = []
    for loss in (l1_ssim, l1_ssim_anywhere):
        image = (
            0.7 * target + 0.3 * torch.rand(37, 53, 3, generator=torch.Generator().manual_seed(1))
        ).requires_grad_()
        value = loss(image, target, 0.3)
        value.backward()
        gradients.append((value.detach(), image.grad))
    assert torch.allclose(gradients[0][0], gradients[1][0], atol=1e-6)
    assert torch.allclose(gradients[0][1], gradients[1][1], atol=1e-8, rtol=1e-3)  # type: ignore[arg-type]


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_without_cuda_the_error_is_one_line(tmp_path: Path, command_line: CommandLine) -> None:
    with pytest.raises(InputError, match="torch finds no CUDA device"):
        recover(BALL, TARGETS, RecoverConfig(steps=1, engine="gsplat"))
    io.write_splats(tmp_path / "b.ply", BALL)
    io.write_views(tmp_path / "v.json", TARGETS.cameras)
    asked = ("recover", "b.ply", "--views", "v.json", "--teacher", "b.ply", "-o", "o.ply", "--device", "cuda")
    error = refused(command_line, tmp_path, *asked, status=1)
    assert "--device: torch finds no CUDA device; " in error
    assert "and gsplat; --device cpu needs none" in error
    error = refused(command_line, tmp_path, *asked[:-2], "--engine", "gsplat", status=1)
    assert "--engine: torch finds no CUDA device; " in error
    assert "and gsplat; --engine fused needs none" in error
    assert not (tmp_path / "o.ply").exists()


@pytest.mark.parametrize("device", ["cuda", "cpu"])
@pytest.mark.parametrize("engine", [None, "gsplat", "fused"])
def test_cuda_warns_that_the_cpu_is_usually_faster(
    device: str, engine: str | None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr(cuda, "check_cuda", lambda asked: None)
    common = dict.fromkeys(("overwrite", "verbose", "quiet", "json", "config")) | {"seed": 0, "threads": 0}
    run = Run("recover", {**common, "device": device}, {})
    settings = {} if engine is None else {"recover.engine": engine}
    choose_engine(run, settings, "recover.engine")
    told = capsys.readouterr().err
    if settings.get("recover.engine") == "gsplat":
        flag = "--device cuda" if engine is None else "--engine gsplat"
        assert told.startswith(f"warning: {flag}: the CPU is usually faster")
        assert told.count("\n") == 1
    else:
        assert told == ""


def test_a_missing_gsplat_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(cuda, "find_spec", lambda name: None)
    with pytest.raises(MissingDependencyError, match=r"pip install gsplat"):
        cuda.check_cuda()
