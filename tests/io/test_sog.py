"""SOG: built here byte by byte, then compared with an independent decoder on real scenes."""

import importlib.util
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from g2ard.errors import InputError
from g2ard.io import kind, read_splats
from g2ard.io.sanitize import LOGIT_LIMIT
from helpers.faults import check_fault, faulty
from helpers.opened import read_scene
from helpers.realdata import real
from helpers.scenes import assert_same_bits
from helpers.sog_files import folder, parts, square, webp, zipped


def decoded(files: dict[str, bytes], name: str, count: int) -> np.ndarray:
    return (
        np.asarray(Image.open(io.BytesIO(files[name])).convert("RGBA"))
        .reshape(-1, 4)[:count]
        .astype(float)
    )


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("bands", [0, 1, 2, 3])
def test_decodes_every_field(tmp_path: Path, version: int, bands: int) -> None:
    count = 10
    files = parts(count, bands, seed=bands, version=version)
    splats = read_splats(folder(tmp_path / "scene", files))
    low, high, scales, quats, sh0 = (
        decoded(files, f"{name}.webp", count) for name in ("low", "high", "scales", "quats", "sh0")
    )
    meta = json.loads(files["meta.json"])
    assert splats.sh_degree == bands
    for i in range(count):
        for axis in range(3):
            lo, hi = meta["means"]["mins"][axis], meta["means"]["maxs"][axis]
            log = lo + (hi - lo) * (low[i, axis] + 256 * high[i, axis]) / 65535
            assert splats.means[i, axis] == pytest.approx(
                np.sign(log) * (np.exp(abs(log)) - 1), abs=1e-6
            )
            if version == 2:
                log_scale = -9 + 8 * scales[i, axis] / 255
                color = -3 + 6 * sh0[i, axis] / 255
            else:
                log_scale = (-9 + axis) + (8 - 2 * axis) * scales[i, axis] / 255
                color = (-3 + axis) * (1 - 2 * sh0[i, axis] / 255)
            assert np.log(splats.scales[i, axis]) == pytest.approx(log_scale, abs=1e-5)
            assert splats.sh0[i, 0, axis] == pytest.approx(color, abs=1e-6)
        alpha = sh0[i, 3] / 255
        logit = np.log(alpha / (1 - alpha)) if version == 2 else -5 + 10 * alpha
        assert splats.logit_opacities[i] == pytest.approx(logit, abs=1e-5)
        left_out = int(quats[i, 3]) - 252
        others = [k for k in range(4) if k != left_out]
        expected = (quats[i, :3] / 255 - 0.5) * np.sqrt(2)
        np.testing.assert_allclose(splats.quats[i, others], expected, atol=1e-6)
        assert splats.quats[i, left_out] == pytest.approx(
            np.sqrt(max(0, 1 - (expected**2).sum())), abs=1e-6
        )
    if bands:
        rest = splats.shN.shape[1]
        palette = np.asarray(
            Image.open(io.BytesIO(files["shN_centroids.webp"])).convert("RGB")
        ).astype(float)
        labels = decoded(files, "shN_labels.webp", count)[:, :2] @ [1, 256]
        for i, label in enumerate(labels.astype(int)):
            column = (label % 64) * rest
            entry = palette[label // 64, column : column + rest] / 255 * 2 - 1
            np.testing.assert_allclose(splats.shN[i], entry, atol=1e-6)


@pytest.mark.parametrize("prefix", ["", "scene/"])
def test_zipped(tmp_path: Path, prefix: str) -> None:
    files = parts()
    plain = read_splats(folder(tmp_path / "plain", files))
    assert_same_bits(plain, read_splats(zipped(tmp_path / "a.sog", files, prefix)))
    assert kind(tmp_path / "a.sog") == kind(tmp_path / "plain") == "splats"
    np.testing.assert_array_equal(read_splats(tmp_path / "plain" / "meta.json").means, plain.means)


def test_chunks_make_one_scene_of_the_finest_level(tmp_path: Path) -> None:
    for i, name in enumerate(["0_0", "0_10", "0_2", "1_0", "env"]):
        folder(tmp_path / name, parts(count=5 + i, bands=i % 2, seed=i))
    found = read_scene(tmp_path)
    assert len(found.splats) == 5 + 6 + 7
    assert found.splats.sh_degree == 1
    second = read_splats(tmp_path / "0_2")
    np.testing.assert_array_equal(found.splats.means[5:12], second.means)  # 0_2 before 0_10
    assert not found.splats.shN[:5].any()
    assert [(n.code, n.count) for n in found.notes] == [("ignored_chunks", 2)]


def test_lod_meta_lists_the_chunks(tmp_path: Path) -> None:
    names = ["b/meta.json", "a/meta.json", "coarse/meta.json"]
    for i, name in enumerate(names):
        folder((tmp_path / name).parent, parts(count=4 + i, seed=i))
    leaf = [{"lods": {"0": {"file": i}, "1": {"file": 2}}} for i in (1, 0)]
    index = {"lodLevels": 2, "filenames": names, "tree": {"children": [{"children": leaf}]}}
    (tmp_path / "lod-meta.json").write_text(json.dumps(index))
    splats = read_splats(tmp_path)
    assert len(splats) == 4 + 5
    np.testing.assert_array_equal(splats.means[:4], read_splats(tmp_path / "b").means)
    index["filenames"] = ["b/meta.json", "gone/meta.json", "coarse/meta.json"]
    (tmp_path / "lod-meta.json").write_text(json.dumps(index))
    with pytest.raises(InputError, match=r"is gone/meta\.json") as caught:
        read_splats(tmp_path)
    check_fault(caught.value, tmp_path / "lod-meta.json", ("filenames[1]", None))


@pytest.mark.parametrize("slash", ["/", "\\"])
def test_names_of_windows_in_indexes(tmp_path: Path, slash: str) -> None:
    folder(tmp_path / "a", parts(count=4))
    index = {
        "version": 1,
        "filenames": [f"a{slash}meta.json"],
        "tree": {"lods": {"0": {"file": 0}}},
    }
    (tmp_path / "lod-meta.json").write_text(json.dumps(index))
    assert len(read_splats(tmp_path)) == 4
    (tmp_path / "lod-meta.json").write_text(json.dumps({**index, "version": 2}))
    with pytest.raises(InputError, match="'version' is 2, which is not supported"):
        read_splats(tmp_path)


def test_full_opacity_is_kept_and_counted(tmp_path: Path) -> None:
    files = parts(count=3)
    files["sh0.webp"] = webp(square(np.array([[1, 2, 3, 255], [1, 2, 3, 0], [1, 2, 3, 128]])))
    found = read_scene(folder(tmp_path / "s", files))
    np.testing.assert_allclose(found.splats.logit_opacities[:2], [LOGIT_LIMIT, -LOGIT_LIMIT])
    assert [(n.code, n.count) for n in found.notes] == [("clamped_logits", 2)]


def test_unknown_quaternion_mode_becomes_identity(tmp_path: Path) -> None:
    files = parts(count=2)
    files["quats.webp"] = webp(square(np.array([[1, 2, 3, 7], [1, 2, 3, 252]])))
    found = read_scene(folder(tmp_path / "s", files))
    np.testing.assert_array_equal(found.splats.quats[0], [1, 0, 0, 0])
    assert [(n.code, n.count) for n in found.notes] == [("zero_quats", 1)]


def edit(files: dict[str, bytes], **changes: Any) -> dict[str, bytes]:
    return files | {"meta.json": json.dumps(json.loads(files["meta.json"]) | changes).encode()}


def within(files: dict[str, bytes], part: str, key: str, value: Any) -> dict[str, bytes]:
    return edit(files, **{part: json.loads(files["meta.json"])[part] | {key: value}})


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (lambda f: {k: v for k, v in f.items() if k != "scales.webp"}, "scales.webp: no such file"),
        (lambda f: f | {"quats.webp": f["quats.webp"][:40]}, "quats.webp: cannot be decoded"),
        (lambda f: edit(f, count=17), "16 pixels for 17 Gaussians"),
        (lambda f: f | {"meta.json": b"{"}, "is not JSON"),
        (lambda f: f | {"shN_labels.webp": webp(square(np.full((10, 2), 200)))}, "of 128"),
    ],
)
def test_broken_files_are_named(tmp_path: Path, change: Any, fault: str) -> None:
    path = folder(tmp_path / "scene", change(parts()))
    with pytest.raises(InputError) as caught:
        read_splats(path)
    assert caught.value.path is not None
    assert path in (caught.value.path, caught.value.path.parent)
    check_fault(caught.value, caught.value.path, fault)


@pytest.mark.filterwarnings("error")
def test_a_gap_in_a_codebook_drops_what_names_it(tmp_path: Path) -> None:
    files = parts(count=3)
    files["scales.webp"] = webp(square(np.array([[1, 2, 3], [1, 9, 3], [1, 2, 3]])))
    book = [-3.0] * 256
    found = read_scene(
        folder(tmp_path / "s", within(files, "scales", "codebook", [*book[:9], None, *book[10:]]))
    )
    assert len(found.splats) == 2
    assert [(n.code, n.count) for n in found.notes] == [("dropped_rows", 1)]


@pytest.mark.parametrize("part", ["scales", "sh0", "shN"])
def test_a_codebook_holds_each_number_that_is_named(tmp_path: Path, part: str) -> None:
    files = parts()
    codes = webp(square(3 * np.arange(40).reshape(10, 4) % 8))
    files |= {"scales.webp": codes, "sh0.webp": codes}
    files["shN_centroids.webp"] = webp(np.arange(2 * 64 * 3 * 3).reshape(2, 64 * 3, 3) % 8)
    book = np.linspace(-1, 1, 8).tolist()
    assert len(read_splats(folder(tmp_path / "whole", within(files, part, "codebook", book)))) == 10
    path = folder(tmp_path / "short", within(files, part, "codebook", book[:7]))
    with faulty(path / "meta.json", (f"{part}.codebook", None)):
        read_splats(path)


def test_an_archive_without_a_scene_is_named(tmp_path: Path) -> None:
    zipped(tmp_path / "b.sog", {"other.txt": b"x"})
    with pytest.raises(InputError, match=r"no meta\.json"):
        read_splats(tmp_path / "b.sog")


def independent(chunk: Path) -> np.ndarray:
    """The columns x y z, f_dc, f_rest, opacity, scale, rot that sog2ply.py decodes."""
    spec = importlib.util.spec_from_file_location("sog2ply", real("sog2ply.py"))
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.decode(str(chunk))[0]


def test_equals_the_independent_decoder() -> None:
    splats = read_splats(real("taebak_park", "0_0"))
    table = independent(real("taebak_park", "0_0"))
    rest = 3 * splats.shN.shape[1]
    np.testing.assert_array_equal(splats.means, table[:, :3])
    np.testing.assert_array_equal(splats.sh0[:, 0], table[:, 3:6])
    channel_major = splats.shN.transpose(0, 2, 1).reshape(len(splats), -1)
    np.testing.assert_array_equal(channel_major, table[:, 6 : 6 + rest])
    alpha = 1 / (1 + np.exp(-table[:, 6 + rest].astype(float)))
    np.testing.assert_allclose(splats.opacities, alpha, atol=2e-6)  # it clips opacities at 1e-6
    np.testing.assert_allclose(splats.log_scales, table[:, 7 + rest : 10 + rest], atol=2e-6)
    np.testing.assert_array_equal(splats.quats, table[:, 10 + rest : 14 + rest])
