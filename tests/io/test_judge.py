"""Tests that opacities, scales and colours of .ply, .glb and USD scenes are judged alike."""

from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from g2ard.io.judge import choose_white, full_scales, judge_storage
from g2ard.scene.splats import SH_C0
from helpers.opened import read_scene

RNG = np.random.default_rng(5)
COUNT = 400
SCALES = np.exp(RNG.normal(-4, 1, (COUNT, 3)))
ALPHAS = np.concatenate([[1.0], RNG.uniform(0.05, 0.98, COUNT - 1)])
LOGITS = np.log(ALPHAS[1:] / (1 - ALPHAS[1:]))
RGB = np.rint(RNG.uniform(0.1, 1, (COUNT, 3)) * 255) / 255
BASE = (RGB - 0.5) / SH_C0


def sigmoid(logits):
    with np.errstate(over="ignore"):
        return 1 / (1 + np.exp(-np.asarray(logits, np.float64)))


@pytest.mark.parametrize("logs", [True, False])
@pytest.mark.parametrize(
    ("kind", "top"), [("u1", 255), ("u2", 65535), ("u2", 255), ("f4", 255), ("f4", 65535)]
)
def test_whole_numbers_are_parts_of_their_range(kind: str, top: int, logs: bool) -> None:
    stored, colors = np.rint(ALPHAS * top).astype(kind), np.rint(RGB * top).astype(kind)
    read = judge_storage(np.log(SCALES) if logs else SCALES, stored, colors, logs=logs)
    np.testing.assert_allclose(sigmoid(read.opacity_logits(stored)), ALPHAS, atol=0.5 / 255)
    np.testing.assert_allclose(read.sh0(colors), BASE, atol=0.01)
    assert [note.code for note in read.notes] == ["opacities", "base_colors"]


def test_linear_opacities_a_little_past_1_stay_opaque() -> None:
    stored = np.minimum(ALPHAS * 1.0001 + 1e-7, 1.0000001)
    stored[3] = -1e-4
    read = judge_storage(SCALES, stored, BASE, logs=False)
    np.testing.assert_allclose(sigmoid(read.opacity_logits(stored)), np.clip(stored, 0, 1))
    assert read.notes == ()
    stored[7] = 3
    read = judge_storage(SCALES, stored, BASE, logs=False)
    assert sigmoid(read.opacity_logits(stored))[7] == 1
    assert [(note.code, note.count) for note in read.notes] == [("opacities", 1)]


@pytest.mark.parametrize("shift", [0.0, 8.0])  # also if all are positive
def test_logits_and_logarithms_where_linear_ones_are_defined(shift: float) -> None:
    logs = np.log(SCALES[1:])
    read = judge_storage(logs, LOGITS + shift, BASE[1:], logs=False)
    assert (read.log_scales, read.opaque) == (True, None)
    np.testing.assert_array_equal(read.opacity_logits(LOGITS), LOGITS)
    assert {note.code for note in read.notes} == {"log_scales", "opacities"}


@pytest.mark.parametrize(
    ("scales", "opacities", "base", "words"),
    [
        (np.log(SCALES), np.ones(COUNT), BASE, ["opacities"]),
        (np.log(SCALES), ALPHAS, BASE, ["opacities"]),
        (np.log(SCALES), np.append(ALPHAS[1:], 1.7), BASE, ["opacities"]),
        (SCALES, np.append(LOGITS, 2), BASE, ["scales"]),
        (np.log(SCALES), np.append(LOGITS, 2), RGB, ["base colours"]),
        (SCALES, ALPHAS, RGB, ["scales", "opacities", "base colours"]),
        (np.log(SCALES), np.append(LOGITS, 2), BASE, []),
        (np.log(SCALES), np.zeros(COUNT), BASE, []),  # opacity 0.5, as of lifted points
    ],
)
def test_activated_values_in_a_ply_are_noted(
    scales: np.ndarray, opacities: np.ndarray, base: np.ndarray, words: list[str]
) -> None:
    read = judge_storage(scales, opacities, base, logs=True)
    text = " ".join(note.text for note in read.notes)
    assert [
        word for word in ("scales", "opacities", "base colours") if f"{word} (" in text
    ] == words
    assert (read.log_scales, read.opaque, read.white) == (True, None, None)


def test_a_ply_of_bytes(tmp_path: Path) -> None:
    """Quaternions of bytes are around 128."""
    quats = RNG.normal(size=(COUNT, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    names = [f"rot_{i}" for i in range(4)]
    columns = dict(zip("xyz", RNG.normal(size=(3, COUNT)), strict=True))
    columns |= {f"scale_{i}": np.log(SCALES[:, i]) for i in range(3)}
    small = dict(zip(names, np.rint(quats.T * 127 + 128), strict=True)) | {"opacity": ALPHAS * 255}
    small |= dict(zip(("red", "green", "blue"), RGB.T * 255, strict=True))
    rows = np.empty(COUNT, [(name, "f4") for name in columns] + [(name, "u1") for name in small])
    for name, values in (columns | small).items():
        rows[name] = np.rint(values) if name in small else values
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(tmp_path / "a.ply"))
    found = read_scene(tmp_path / "a.ply").splats
    np.testing.assert_allclose(found.opacities, ALPHAS, atol=0.5 / 255)
    np.testing.assert_allclose(found.colors, RGB, atol=1e-5)
    own = found.quats / np.linalg.norm(found.quats, axis=1, keepdims=True)
    assert np.abs((own * quats).sum(1)).min() > 0.999


def test_black_tells_nothing_of_white() -> None:
    """A cloud without colours has the full range of its type; one that is mostly black that of the rest."""
    sixteen = full_scales(np.dtype("u2"))
    assert choose_white(np.zeros((99, 3)), sixteen) == 65535
    mostly = np.zeros((9000, 3))
    mostly[:60] = 200
    assert choose_white(mostly, sixteen) == 255


@pytest.mark.parametrize(
    ("low", "high", "logits"),
    [
        (0.1, 1.05, False),
        (0.1, 1.2, True),
        (-0.05, 0.9, False),
        (-0.2, 0.9, True),
        (-7.0, -1.0, True),
    ],
)
def test_linear_opacities_are_logits_if_they_leave_their_range(
    low: float, high: float, logits: bool
) -> None:
    """A tenth beyond 0 or 1 is noise."""
    read = judge_storage(SCALES, np.linspace(low, high, COUNT), BASE, logs=False)
    assert (read.opaque is None) == logits


@pytest.mark.parametrize(("least", "logs"), [(-0.5, True), (0.0, False)])
def test_linear_scales_are_logarithms_if_they_are_below_0(least: float, logs: bool) -> None:
    scales = np.linspace(least, 2, 3 * COUNT).reshape(COUNT, 3)
    assert judge_storage(scales, ALPHAS, BASE, logs=False).log_scales == logs


@pytest.mark.parametrize(("low", "white_at"), [(0, 255), (-40, None)])
def test_whole_numbers_below_0_are_no_colours(low: int, white_at: float | None) -> None:
    colors = np.tile(np.arange(low, 256.0), (3, 1)).T
    count = len(colors)
    assert judge_storage(SCALES[:count], ALPHAS[:count], colors, logs=False).white == white_at
