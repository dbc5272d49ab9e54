"""LPIPS against a naive numpy twin, with weights of the true names and small random widths."""

from pathlib import Path

import numpy as np
import pytest
import torch

from g2ard.errors import InputError
from g2ard.rendering.metrics import Lpips, load_lpips
from g2ard.rendering.targets import TeacherRenders
from g2ard.stages.evaluate import evaluate
from helpers.lpips_weights import ALEX, weights
from helpers.scenes import around, checkered_ball


def conv(x: np.ndarray, w: np.ndarray, b: np.ndarray, stride: int, pad: int) -> np.ndarray:
    x = np.pad(x, ((0, 0), (pad, pad), (pad, pad)))
    k = w.shape[-1]
    rows, columns = (x.shape[1] - k) // stride + 1, (x.shape[2] - k) // stride + 1
    out = np.zeros((len(w), rows, columns))
    for i in range(rows):
        for j in range(columns):
            patch = x[:, i * stride : i * stride + k, j * stride : j * stride + k]
            out[:, i, j] = (w * patch).sum((1, 2, 3)) + b
    return np.maximum(out, 0)


def pool(x: np.ndarray) -> np.ndarray:
    rows, columns = (x.shape[1] - 3) // 2 + 1, (x.shape[2] - 3) // 2 + 1
    out = np.zeros((len(x), rows, columns))
    for i in range(rows):
        for j in range(columns):
            out[:, i, j] = x[:, 2 * i : 2 * i + 3, 2 * j : 2 * j + 3].max((1, 2))
    return out


def maps(image: np.ndarray, backbone: dict) -> list[np.ndarray]:
    shift, scale = np.array([-0.030, -0.088, -0.188]), np.array([0.458, 0.448, 0.450])
    x = ((2 * image.astype(np.float64) - 1 - shift) / scale).transpose(2, 0, 1)
    out = []
    for i, _, _, _, stride, pad in ALEX:
        if i in (3, 6):
            x = pool(x)
        x = conv(
            x,
            backbone[f"features.{i}.weight"].numpy(),
            backbone[f"features.{i}.bias"].numpy(),
            stride,
            pad,
        )
        out.append(x)
    return out


def test_the_distance_equals_a_naive_networks() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.random((70, 66, 3), np.float32), rng.random((70, 66, 3), np.float32)
    backbone, linear = weights()
    expected = 0.0
    for k, (f, g) in enumerate(zip(maps(a, backbone), maps(b, backbone), strict=True)):
        f, g = (m / (np.sqrt((m**2).sum(0)) + 1e-10) for m in (f, g))
        w = linear[f"lin{k}.model.1.weight"].numpy().reshape(-1, 1, 1)
        expected += (w * (f - g) ** 2).sum(0).mean()
    model = Lpips("alex", backbone, linear)
    assert model(a, b) == pytest.approx(expected, rel=1e-4)
    assert model(a, a) == 0


def test_evaluate_scores_with_it() -> None:
    ball, views = checkered_ball(200), around(2)
    found = evaluate(
        ball.take(slice(100)),
        TeacherRenders(ball, views),
        lpips={"alex": Lpips("alex", *weights())},
    )
    assert found.lpips["alex"] > 0
    assert found.as_dict()["lpips"] == found.lpips
    assert evaluate(ball, TeacherRenders(ball, views)).as_dict()["lpips"] is None


def test_weights_are_read_from_a_folder_only(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no LPIPS weights"):
        load_lpips(tmp_path)
    backbone, linear = weights()
    torch.save(backbone, tmp_path / "alexnet-owt-7be5be79.pth")
    torch.save(linear, tmp_path / "alex.pth")
    assert list(load_lpips(tmp_path)) == ["alex"]
    torch.save({}, tmp_path / "alex.pth")
    with pytest.raises(InputError, match="lin0"):
        load_lpips(tmp_path)
    (tmp_path / "alex.pth").write_bytes(b"nothing")
    with pytest.raises(InputError, match=r"alex\.pth"):
        load_lpips(tmp_path)
