"""Packed formats as written: read back within each attribute's quantum, by us and by other readers."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import g2ard._core as _core
from g2ard.errors import InputError, OutputError
from g2ard.io import check_scene_output, read_splats, write_splats
from g2ard.io.glb import EXTENSION, SPZ_EXTENSION
from g2ard.io.packing import packing_order, unit_quats
from g2ard.io.scene_formats import lost_in
from g2ard.io.sog_write import nearest, palette_size, sog_files
from g2ard.io.spz import fraction_bits
from g2ard.jobs.convert import convert
from g2ard.scene.splats import Splats
from g2ard.scene.transform import transform
from helpers.glb_files import glb_parts, write_glb
from helpers.packed_files import saved
from helpers.peers import adobe_spz, gltf_report, splat_transform
from helpers.scenes import checkered_ball
from helpers.threads import on_threads
from reference.rotations import covariances

FORMATS = ("sog", "spz", "glb", "compressed.ply", "splat", "ply", "folder/meta.json")


def scene(count: int = 700, degree: int = 2, seed: int = 0) -> Splats:
    """Random attributes in the range of every format; quaternions of any sign and length."""
    rng = np.random.default_rng(seed)
    return Splats.create(
        rng.normal(0, 3, (count, 3)).astype(np.float32),
        quats=rng.normal(size=(count, 4)) * rng.uniform(0.1, 5, (count, 1)),
        scales=np.exp(rng.uniform(-8, 1, (count, 3))),
        logit_opacities=rng.uniform(-5, 5, count),
        sh0=rng.uniform(-1.7, 1.7, (count, 1, 3)),
        shN=rng.uniform(-0.9, 0.9, (count, (degree + 1) ** 2 - 1, 3)),
    )


def in_order(splats: Splats) -> Splats:
    return splats.take(packing_order(splats.means))


def turned(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the largest difference of a component of two unit quaternions, up to their sign."""
    a, b = unit_quats(a), unit_quats(b)
    return np.abs(a - b * np.sign((a * b).sum(1, keepdims=True))).max(1)


# ── every format ─────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("name", FORMATS)
def test_equal_scenes_give_equal_bytes_on_any_threads(tmp_path: Path, name: str) -> None:
    def written() -> list[bytes]:
        path = saved(tmp_path, name, scene(3000), overwrite=True)
        files = sorted(path.parent.iterdir()) if name.endswith("meta.json") else [path]
        return [file.read_bytes() for file in files]

    first, *others = on_threads(written)
    assert others == [first] * 2


@pytest.mark.parametrize("name", FORMATS)
def test_odd_scenes(tmp_path: Path, name: str) -> None:
    one = Splats.create([[1.0, 2, 3]], scales=[[0.1, 0.2, 0.3]], quats=[[0, 0, 0, 0]])
    far = 16 if name == "ply" else np.inf  # .ply refuses infinities
    same = Splats.create(
        np.ones((9, 3)), scales=np.zeros((9, 3)), logit_opacities=[far, -far, *[0] * 7]
    )
    for splats in (one, same, one.with_sh_degree(3)):
        path = tmp_path / f"{len(list(tmp_path.iterdir()))}"
        path.mkdir()
        found = read_splats(saved(path, name, splats))
        assert len(found) == len(splats)
        np.testing.assert_allclose(found.means, splats.means, atol=2e-4)


@pytest.mark.parametrize("name", FORMATS)
def test_unwritable_values_are_one_line(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match="the scene has no Gaussians"):
        saved(tmp_path, name, scene().take(slice(0, 0)))
    broken = scene()
    broken.means[7, 1] = np.nan
    with pytest.raises(InputError, match=r"Gaussian 7 is not finite"):
        saved(tmp_path, name, broken)
    assert not [p for p in tmp_path.rglob("*") if p.is_file()]


@pytest.mark.parametrize("name", ["a.sog", "a/meta.json", "a.spz", "a.usda"])
def test_packing_reports_its_progress(tmp_path: Path, name: str) -> None:
    """Telling changes no byte; the last call says that all is done."""
    scene, told = checkered_ball(5000), []
    for folder, how in (
        ("quiet", {}),
        ("told", {"progress": lambda *report: told.append(report[:3])}),
    ):
        (tmp_path / folder / "a").mkdir(parents=True)
        write_splats(tmp_path / folder / name, scene, overwrite=True, **how)
    files = [path for path in (tmp_path / "told").rglob("*") if path.is_file()]
    for path in files:
        assert (
            path.read_bytes()
            == (tmp_path / "quiet" / path.relative_to(tmp_path / "told")).read_bytes()
        )
    (stage, done, total), counts = told[-1], [report[1] for report in told]
    assert files
    assert done == total > 1, stage
    assert counts == sorted(counts)
    assert {report[2] for report in told} == {total}


def test_names_and_options(tmp_path: Path) -> None:
    for name in ("B.SOG", "b.Spz", "b.GLB", "b.Compressed.PLY", "b.PLY", "b.SPLAT"):
        write_splats(tmp_path / name, scene(50, 0))
        assert len(read_splats(tmp_path / name)) == 50
    for name in ("b.ksplat", "b", "meta.txt"):
        with pytest.raises(OutputError, match=r"scenes are written as .*\.sog"):
            write_splats(tmp_path / name, scene(5))
    with pytest.raises(OutputError, match=r"\.sog has no option 'spz_version'"):
        write_splats(tmp_path / "c.sog", scene(5), spz_version=3)
    with pytest.raises(OutputError, match="exists"):
        check_scene_output(tmp_path / "b.PLY")
    write_splats(tmp_path / "room" / "meta.json", scene(5))
    with pytest.raises(OutputError, match="exists"):
        check_scene_output(tmp_path / "room" / "meta.json")


@pytest.mark.parametrize("name", FORMATS)
def test_offsets_are_kept(tmp_path: Path, name: str) -> None:
    """A .splat, which has no place for one, holds what is far relative to it, and what is near as it is."""
    utm = (443_000.0, 5_411_000.5, 120.25)
    splats = replace(scene(300, 1), offset=np.array(utm))
    if name == "splat":
        with pytest.warns(
            UserWarning, match=r"--translate=443000,5411000\.5,120\.25` puts them back"
        ):
            found = read_splats(saved(tmp_path, name, splats))
        np.testing.assert_allclose(found.means.mean(0), splats.means.mean(0), atol=1e-3)
        near = replace(splats, offset=np.array([3.0, 4, 5]))
        found = read_splats(saved(tmp_path / "near", name, near))
        assert not found.offset.any()
        np.testing.assert_allclose(found.means.mean(0), near.means.mean(0) + near.offset, atol=1e-3)
        return
    found = read_splats(saved(tmp_path, name, splats))
    np.testing.assert_array_equal(found.offset, utm)
    np.testing.assert_allclose(found.means.mean(0), splats.means.mean(0), atol=2e-2)


# ── quanta, by each format's formula ─────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("name", ["sog", "folder/meta.json"])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_sog(tmp_path: Path, name: str, degree: int) -> None:
    truth = in_order(scene(700, degree))
    found = read_splats(saved(tmp_path, name, truth))
    assert found.sh_degree == degree
    logs = np.sign(truth.means) * np.log1p(np.abs(truth.means.astype(float)))
    half = (logs.max(0) - logs.min(0)) / 65535 / 2
    slope = 1 + np.abs(truth.means.astype(float))  # d v / d log
    assert (np.abs(found.means - truth.means) <= half * slope * 1.01 + 1e-6).all()
    assert turned(found.quats, truth.quats).max() <= 3 * math.sqrt(2) / 255 / 2 + 1e-6
    np.testing.assert_allclose(found.opacities, truth.opacities, atol=0.5 / 255 + 1e-6)
    files = sog_files(truth)
    meta = json.loads(files["meta.json"])
    for values, back, book in (
        (truth.log_scales, found.log_scales, meta["scales"]["codebook"]),
        (truth.sh0, found.sh0, meta["sh0"]["codebook"]),
    ):
        assert len(book) == 256
        least = np.abs(values.astype(float)[..., None] - np.array(book)).min(-1)
        np.testing.assert_allclose(np.abs(back - values), least, atol=2e-6)
    if degree:
        assert meta["shN"]["count"] == 512 == palette_size(700)
        spread = ((truth.shN - truth.shN.mean(0)) ** 2).sum()
        # 512 entries for 700 random rows
        assert ((found.shN - truth.shN) ** 2).sum() < 0.35 * spread


@pytest.mark.parametrize("version", [2, 3, 4])
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_spz(tmp_path: Path, version: int, degree: int) -> None:
    truth = in_order(scene(700, degree))
    path = saved(tmp_path, "spz", truth, spz_version=version)
    found = read_splats(path)
    fine = np.percentile(np.sort(truth.scales, axis=1)[:, 1], 1)
    # half of a step of fine / 4
    np.testing.assert_allclose(found.means, truth.means, atol=fine / 8 + 1e-6)
    np.testing.assert_allclose(found.log_scales, truth.log_scales, atol=0.5 / 16 + 1e-5)
    np.testing.assert_allclose(found.opacities, truth.opacities, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(found.sh0, truth.sh0, atol=0.5 / 255 / 0.15 + 1e-6)
    np.testing.assert_allclose(found.shN, np.clip(truth.shN, -1, 127 / 128), atol=0.5 / 128 + 1e-6)
    if version == 2:  # w follows from x y z: near 0 their half step becomes its square root
        assert turned(found.quats, truth.quats).max() <= math.sqrt(2 * 3 * 0.5 / 127.5)
    else:
        assert turned(found.quats, truth.quats).max() <= 3 / (511 * math.sqrt(2)) / 2 + 1e-6


@pytest.mark.parametrize("fine", [2e-2, 1e-3, 3e-4, 1e-4, 2e-5])
def test_spz_steps_suit_the_finest_gaussians(tmp_path: Path, fine: float) -> None:
    truth = scene(700, 0)
    scales = np.full((700, 3), 0.1, np.float32)
    scales[:14] = fine  # two in a hundred
    truth = in_order(replace(truth, means=np.clip(truth.means, -7, 7), scales=scales))
    found = read_splats(saved(tmp_path, "spz", truth))
    error = np.abs(found.means.astype(float) - truth.means).max()
    assert error <= max(min(fine / 4, 2.0**-12), 2.0**-20) / 2 + 1e-6


def test_sog_palette_favours_what_shows(tmp_path: Path) -> None:
    truth = scene(3000, 1)
    shown = np.arange(3000) < 1000
    truth = replace(
        truth,
        scales=np.where(shown[:, None], np.float32(0.5), np.float32(0.005)).repeat(3, 1),
        logit_opacities=np.where(shown, np.float32(4), np.float32(-4)),
    )
    truth = in_order(truth)
    found = read_splats(saved(tmp_path, "sog", truth))
    error = ((found.shN - truth.shN) ** 2).mean((1, 2))
    assert error[truth.opacities > 0.5].mean() < 0.5 * error[truth.opacities < 0.5].mean()


def test_spz_bits_follow_the_extent(tmp_path: Path) -> None:
    for extent in (0.01, 1.0, 3000.0, 100_000.0):
        truth = scene(400, 0)
        truth = replace(truth, means=truth.means / 10 * extent, scales=truth.scales * extent)
        bits = fraction_bits(truth.means.astype(float), truth)
        assert np.abs(truth.means).max() * 2.0**bits < 1 << 23
        found = read_splats(saved(tmp_path / "..", f"{extent}.spz", truth, overwrite=True))
        np.testing.assert_allclose(
            np.sort(found.means + found.offset, 0),
            np.sort(truth.means, 0),
            atol=0.5 / 2**bits + 1e-6 * extent,
        )
    assert fraction_bits(np.full((1, 3), 4.0), scene(400, 0)) >= 12
    fine = Splats.create([[1e7, 0, 0], [0, 0, 0]], scales=np.full((2, 3), 0.01))
    with pytest.raises(InputError, match=r"at 5e\+06 from the origin \(steps of 1\)"):
        write_splats(tmp_path / "fine.spz", fine)


def with_far(count: int, times: float, unit: float, seed: int, around: int = 400) -> Splats:
    """A dense ball of 4,000 rows, `around` rows up to 60 radii away, and `count` rows at `times` radii."""
    rng = np.random.default_rng(seed)
    ways = rng.normal(size=(4000 + around + count, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    away = [rng.uniform(0, 1, 4000), np.exp(rng.uniform(1, 4, around)), np.full(count, times)]
    means = (ways * np.concatenate(away)[:, None] * unit)[rng.permutation(len(ways))]
    sizes = 0.02 * unit * rng.uniform(0.5, 2, (len(ways), 3))
    return Splats.create(
        means.astype(np.float32), scales=sizes, logit_opacities=np.full(len(ways), 2.0)
    )


@pytest.mark.parametrize("name", ["compressed.ply", "sog", "spz", "glb", "splat"])
@pytest.mark.parametrize(
    ("count", "times", "unit"),
    [(1, 3e3, 1.0), (10, 3e3, 0.02), (10, 100.0, 30.0), (300, 1000.0, 1.0)],
)
def test_far_rows_leave_the_others_precise(
    tmp_path: Path, name: str, count: int, times: float, unit: float
) -> None:
    """Positions of three quarters of the rows keep 60 dB of the ball's size."""
    truth = with_far(count, times, unit, seed=count)
    found = read_splats(
        saved(tmp_path, name, truth, **({"compress": "spz"} if name == "glb" else {}))
    )
    near = truth.means[np.linalg.norm(truth.means, axis=1) < 0.8 * unit]
    near, stored = near[::10].astype(float), found.means.astype(float)
    off = np.linalg.norm(near[:, None] - stored, axis=2).min(axis=1)
    # of all rows
    steps = {"spz": 2.0**-12, "glb": 2.0**-12, "sog": 2 * np.log1p(times * unit) / 65535}
    assert np.sqrt((off**2).mean()) < max(1e-3 * unit, 2 * steps.get(name, 0.0))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("chunk", [1, 7, 256])
def test_packing_order_keeps_shells_apart(seed: int, chunk: int) -> None:
    """Each row occurs once; fewer rows than a chunk per shell are in chunks with rows of outer shells."""
    rng = np.random.default_rng(seed)
    means = rng.normal(size=(3000, 3)) * np.exp(rng.exponential(1 + seed, (3000, 1)))
    order = packing_order(means, chunk)
    assert sorted(order) == list(range(3000))
    away = np.linalg.norm(means - np.median(means, axis=0), axis=1)
    shells = np.floor(np.log2(np.maximum(away / np.percentile(away, 75) / 4, 0.5)))[order]
    parts = [shells[at : at + chunk] for at in range(0, 3000, chunk)]
    inner = sum(np.count_nonzero(part < part.max()) for part in parts)
    assert inner <= (chunk - 1) * (len(np.unique(shells)) - 1)
    if chunk == 1:
        assert (np.diff(shells) >= 0).all()


@pytest.mark.parametrize("name", ["a.spz", "a.glb"])
@pytest.mark.parametrize(
    ("count", "times", "shift"), [(1, 1e6, 0.0), (10, 3e5, -40.0), (600, 1e7, 7.0)]
)
def test_what_is_too_far_for_an_spz_is_named_with_a_box(
    tmp_path: Path, name: str, count: int, times: float, shift: float
) -> None:
    options = {"compress": "spz"} if name == "a.glb" else {}
    truth = with_far(count, times, 1.0, seed=count)
    truth = replace(truth, means=truth.means + np.float32(shift))
    first = np.flatnonzero(np.abs(truth.means).max(1) > 1e5)[0]
    with pytest.raises(
        InputError, match=rf"{count} Gaussians? of .* \(row {first}\b.*--box="
    ) as error:
        write_splats(tmp_path / name, truth, **options)
    box = [float(v) for v in re.search(r"--box=([-\d.,]+\d)", str(error.value))[1].split(",")]
    cropped = convert(truth, box=box)
    assert len(cropped) == len(truth) - count
    write_splats(tmp_path / name, cropped, **options)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_compressed_ply(tmp_path: Path, degree: int) -> None:
    truth = in_order(scene(700, degree))
    found = read_splats(saved(tmp_path, "compressed.ply", truth))
    for start in range(0, 700, 256):
        rows = slice(start, start + 256)
        for name, steps in (
            ("means", [2047, 1023, 2047]),
            ("log_scales", [2047, 1023, 2047]),
            ("colors", 255),
        ):
            a, b = getattr(found, name)[rows], getattr(truth, name)[rows]
            assert (np.abs(a - b) <= np.ptp(b, axis=0) / np.array(steps) / 2 + 2e-6).all(), name
    np.testing.assert_allclose(found.opacities, truth.opacities, atol=0.5 / 255 + 1e-6)
    assert turned(found.quats, truth.quats).max() <= 3 * math.sqrt(2) / 1023 / 2 + 1e-6
    np.testing.assert_allclose(found.shN, truth.shN, atol=8 / 256 / 2 + 1e-6)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_glb_loses_nothing_but_roundings(tmp_path: Path, degree: int) -> None:
    truth = scene(700, degree)
    found = read_splats(saved(tmp_path, "glb", truth))
    np.testing.assert_array_equal(found.means, truth.means)
    np.testing.assert_array_equal(found.sh0, truth.sh0)
    np.testing.assert_array_equal(found.shN, truth.shN)
    np.testing.assert_allclose(found.scales, truth.scales, rtol=1e-5)
    np.testing.assert_allclose(found.opacities, truth.opacities, atol=1e-7)
    assert turned(found.quats, truth.quats).max() < 1e-6


# ── codebooks, against a naive twin ──────────────────────────────────────────────────────────────────


def test_codebook_is_the_best_there_is() -> None:
    """Every cut of the sorted values, in float64, by the textbook's O(K·n²)."""
    rng = np.random.default_rng(3)
    for values in (
        rng.normal(size=60),
        rng.exponential(size=60),
        rng.integers(0, 9, 60).astype(float),
    ):
        values = np.sort(values.astype(np.float32)).astype(float)
        n, count = len(values), 7
        error = lambda i, j: ((values[i:j] - values[i:j].mean()) ** 2).sum()  # noqa: B023, E731
        best = [error(0, j) if j else 0.0 for j in range(n + 1)]
        for _ in range(count - 1):
            best = [
                min([best[j], *(best[i] + error(i, j) for i in range(1, j))]) for j in range(n + 1)
            ]
        book = _core.codebook(values.astype(np.float32), count)
        found = ((values - book[nearest(book, values.astype(np.float32))]) ** 2).sum()
        assert found == pytest.approx(best[n], rel=1e-5, abs=1e-9)


def test_codebook_survives_strays() -> None:
    """Two far values take two entries, and nearly nothing of the others' resolution."""
    values = np.random.default_rng(0).normal(size=20_000).astype(np.float32)
    mse = [
        ((v - book[nearest(book, v)]) ** 2)[:20_000].mean()
        for v in (values, np.append(values, np.float32([-1e4, 1e4])))
        for book in [_core.codebook(v, 256)]
    ]
    assert mse[1] < 1.1 * mse[0]


def test_palette_is_as_good_as_lloyd_by_brute_force() -> None:
    rng = np.random.default_rng(1)
    points = (rng.normal(size=(3000, 24)) @ np.diag(rng.exponential(size=24))).astype(np.float32)
    entries, labels = _core.palette(points, 200, 10)
    assert entries.shape == (200, 24)
    ours = ((points - entries[labels]) ** 2).sum()
    centres = points[rng.choice(3000, 200, replace=False)].astype(float)
    for _ in range(10):
        near = ((points[:, None].astype(float) - centres) ** 2).sum(-1).argmin(1)
        centres = np.stack(
            [points[near == k].mean(0) if (near == k).any() else centres[k] for k in range(200)]
        )
    theirs = ((points[:, None].astype(float) - centres) ** 2).sum(-1).min(1).sum()
    assert ours < 1.03 * theirs


def test_glb_keeps_the_rules(tmp_path: Path) -> None:
    truth = replace(scene(321, 3), offset=np.array([10.0, 20, 30]))
    document, binary = glb_parts(saved(tmp_path, "glb", truth))
    assert document["asset"]["version"] == "2.0"
    assert document["extensionsUsed"] == [EXTENSION]
    (primitive,) = document["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    assert primitive["extensions"][EXTENSION]["kernel"] == "ellipse"
    assert primitive["extensions"][EXTENSION]["colorSpace"] == "srgb_rec709_display"
    arrays = {}
    for name, index in primitive["attributes"].items():
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        dtype = np.dtype({5126: "<f4", 5123: "<u2"}[accessor["componentType"]])
        assert view["byteOffset"] % 4 == 0
        assert view["byteLength"] == 321 * width * dtype.itemsize
        assert view["byteOffset"] + view["byteLength"] <= len(binary)
        assert ("normalized" in accessor) == (dtype.itemsize == 2)
        arrays[name] = np.frombuffer(binary, dtype, 321 * width, view["byteOffset"]).reshape(
            321, width
        )
        if name == "POSITION":
            assert accessor["min"] == arrays[name].min(0).tolist()
            assert accessor["max"] == arrays[name].max(0).tolist()
    np.testing.assert_array_equal(arrays["POSITION"], truth.means * (-1, -1, 1))  # y up, z forward
    assert document["nodes"][0]["translation"] == [-10, -20, 30]
    shown = np.clip(truth.colors, 0, 1).astype(float)
    linear = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(arrays["COLOR_0"][:, :3] / 65535, linear, atol=0.5 / 65535 + 1e-6)
    np.testing.assert_allclose(
        arrays["COLOR_0"][:, 3] / 65535, truth.opacities, atol=0.5 / 65535 + 1e-6
    )
    np.testing.assert_allclose(
        np.linalg.norm(arrays[f"{EXTENSION}:ROTATION"], axis=1), 1, atol=1e-6
    )
    assert (arrays[f"{EXTENSION}:OPACITY"] <= 1).all()
    assert sum(name.startswith(f"{EXTENSION}:SH_DEGREE_") for name in arrays) == 16


# ── other people's readers ───────────────────────────────────────────────────────────────────────────


def about_x(splats: Splats) -> Splats:
    """Turn by 180° about x: splat-transform 3.7 reads .spz in the axes that it is stored in."""
    return transform(splats, np.diag([1.0, -1, -1, 1]))


def agree(ours: Splats, theirs: Splats, *, shape: float) -> None:
    np.testing.assert_allclose(theirs.means, ours.means, atol=2e-6, rtol=2e-6)
    np.testing.assert_allclose(theirs.log_scales, ours.log_scales, atol=2e-5)
    np.testing.assert_allclose(theirs.opacities, ours.opacities, atol=1e-6)
    np.testing.assert_allclose(theirs.sh0, ours.sh0, atol=2e-5)
    np.testing.assert_allclose(theirs.shN, ours.shN, atol=2e-5)
    a, b = (covariances(s.quats, s.scales) for s in (theirs, ours))
    assert (np.abs(a - b).max((1, 2)) <= shape * ours.scales.max(1).astype(float) ** 2).all()


@pytest.mark.parametrize("name", ["sog", "folder/meta.json", "spz", "compressed.ply", "splat"])
def test_splat_transform_reads_it_as_we_do(tmp_path: Path, name: str) -> None:
    path = saved(tmp_path, name, scene(2000, 0 if name == "splat" else 3))
    splat_transform(path, tmp_path / "peer.ply")
    ours = read_splats(path)
    shape = 2e-2 if name == "splat" else 2e-3  # it takes bytes of quaternions around 127.5, not 128
    agree(about_x(ours) if name == "spz" else ours, read_splats(tmp_path / "peer.ply"), shape=shape)


@pytest.mark.parametrize("version", [2, 3, 4])
def test_adobe_reads_spz_as_we_do(tmp_path: Path, version: int) -> None:
    path = saved(tmp_path, "spz", scene(500, 3), spz_version=version)
    ours, theirs = read_splats(path), adobe_spz(path)
    np.testing.assert_allclose(theirs["positions"].reshape(-1, 3), ours.means, atol=1e-6)
    np.testing.assert_allclose(theirs["scales"].reshape(-1, 3), ours.log_scales, atol=1e-5)
    np.testing.assert_allclose(theirs["colors"].reshape(-1, 1, 3), ours.sh0, atol=1e-5)
    np.testing.assert_allclose(theirs["sh"].reshape(-1, 15, 3), ours.shN, atol=1e-6)
    assert turned(theirs["rotations"].reshape(-1, 4)[:, [3, 0, 1, 2]], ours.quats).max() < 1e-3


@pytest.mark.parametrize("options", [{}, {"compress": "spz"}])
def test_khronos_validator_finds_no_error(tmp_path: Path, options: dict[str, str]) -> None:
    moved = replace(scene(500, 3), offset=np.array([1.0, 2, 3]))
    report = gltf_report(saved(tmp_path, "glb", moved, **options))
    ours = f"/meshes/0/primitives/0/attributes/{EXTENSION}:"  # names that only the extension allows
    found = [m for m in report["issues"]["messages"] if m["severity"] < 2]
    left = [
        m
        for m in found
        if not (m["code"].endswith("INVALID_ATTRIBUTE") and m["pointer"].startswith(ours))
    ]
    assert not left


# ── .glb with an SPZ inside, and placed by nodes ─────────────────────────────────────────────────────


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_glb_with_spz_holds_gltf_coordinates(tmp_path: Path, degree: int) -> None:
    truth = replace(in_order(scene(700, degree)), offset=np.array([443_000.0, 5_411_000.5, 120.25]))
    truth = replace(truth, render_model="antialiased")
    path = saved(tmp_path, "glb", truth, compress="spz")
    document, binary = glb_parts(path)
    (primitive,) = document["meshes"][0]["primitives"]
    splatting = primitive["extensions"][EXTENSION]
    assert splatting["extensions"][SPZ_EXTENSION] == {"bufferView": 0}
    assert (
        document["extensionsRequired"] == document["extensionsUsed"] == [EXTENSION, SPZ_EXTENSION]
    )
    accessors = {
        name: document["accessors"][index] for name, index in primitive["attributes"].items()
    }
    assert {accessor["count"] for accessor in accessors.values()} == {700}
    assert sum("SH_DEGREE" in name for name in accessors) == (degree + 1) ** 2 - 1
    assert document["nodes"][0]["matrix"][12:15] == [-443_000.0, -5_411_000.5, 120.25]
    (tmp_path / "inside.spz").write_bytes(binary[: document["bufferViews"][0]["byteLength"]])
    inside = read_splats(tmp_path / "inside.spz")  # as if of SPZ's axes: y and z changed their sign
    stored = inside.means * (1, -1, -1)
    np.testing.assert_allclose(stored, truth.means * (-1, -1, 1), atol=2.0**-13)
    np.testing.assert_allclose(stored.min(0), accessors["POSITION"]["min"], atol=1e-6)
    np.testing.assert_allclose(stored.max(0), accessors["POSITION"]["max"], atol=1e-6)
    turned_scene = transform(replace(truth, offset=np.zeros(3)), np.diag([-1.0, 1, -1, 1]))
    np.testing.assert_allclose(inside.shN, turned_scene.shN, atol=0.07)
    found = read_splats(path)
    assert found.antialiased
    np.testing.assert_array_equal(found.offset, truth.offset)
    np.testing.assert_allclose(found.means, truth.means, atol=2.0**-13)
    np.testing.assert_allclose(found.shN, truth.shN, atol=0.07)
    got, want = (covariances(s.quats, s.scales) for s in (found, truth))
    np.testing.assert_allclose(got, want, rtol=0.1, atol=0.02 * truth.scales.max() ** 2)


@pytest.mark.parametrize("compress", [None, "spz"])
def test_nodes_of_a_glb_turn_scale_and_move(tmp_path: Path, compress: str | None) -> None:
    truth = in_order(scene(60, 3))
    path = saved(tmp_path, "glb", truth, **({} if compress is None else {"compress": compress}))
    plain = read_splats(path)
    third = [0.5, 0.5, 0.5, 0.5]  # x → y → z → x
    above = {"children": [0], "rotation": third, "scale": [2, 2, 2], "translation": [1, 2, 3]}
    document, binary = glb_parts(path)
    write_glb(path, {**document, "nodes": [document["nodes"][0], above]}, binary)
    cycle, turn = np.eye(4), np.diag([-1.0, -1, 1, 1])
    cycle[:3] = [[0, 0, 2, 1], [2, 0, 0, 2], [0, 2, 0, 3]]
    wanted, found = transform(plain, turn @ cycle @ turn), read_splats(path)
    np.testing.assert_allclose(found.means + found.offset, wanted.means + wanted.offset, atol=1e-5)
    got, want = (covariances(s.quats, s.scales) for s in (found, wanted))
    np.testing.assert_allclose(got, want, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(found.shN, wanted.shN, atol=1e-5)
    write_glb(
        path, {**document, "nodes": [document["nodes"][0], above | {"scale": [1, 2, 1]}]}, binary
    )
    uneven = read_splats(path)
    moved = turn @ cycle @ np.diag([0.5, 1, 0.5, 1]) @ turn
    linear, shift = moved[:3, :3], moved[:3, 3]
    means = (plain.means + plain.offset) @ linear.T + shift
    np.testing.assert_allclose(uneven.means + uneven.offset, means, atol=1e-5)
    got, want = (covariances(s.quats, s.scales) for s in (uneven, plain))
    np.testing.assert_allclose(got, linear @ want @ linear.T, rtol=1e-4, atol=1e-6)


STORED = {"ROTATION": "quats", "SCALE": "scales", "OPACITY": "opacities"}


@pytest.mark.parametrize(
    ("name", "dtype"),
    [
        *(("ROTATION", dtype) for dtype in ("i1", "<i2")),
        *(("SCALE", dtype) for dtype in ("i1", "u1", "<i2", "<u2")),
        *(("OPACITY", dtype) for dtype in ("u1", "<u2")),
    ],
)
def test_attributes_of_a_glb_may_be_normalised_integers(
    tmp_path: Path, name: str, dtype: str
) -> None:
    path = saved(tmp_path, "glb", replace(scene(90, 1), scales=np.full((90, 3), 0.3, np.float32)))
    plain = read_splats(path)
    document, binary = glb_parts(path)
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    accessor = document["accessors"][attributes[f"{EXTENSION}:{name}"]]
    view = document["bufferViews"][accessor["bufferView"]]
    floats = np.frombuffer(binary, "<f4", view["byteLength"] // 4, view["byteOffset"]).reshape(
        90, -1
    )
    codes = np.rint(floats * np.iinfo(dtype).max).astype(dtype)
    rows = np.zeros((90, 12), "u1")
    rows[:, : codes.itemsize * codes.shape[1]] = codes.view("u1").reshape(90, -1)
    view |= {"byteOffset": len(binary), "byteLength": rows.size, "byteStride": 12}
    kind = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123}[dtype[-2:]]
    accessor |= {"componentType": kind, "normalized": True}
    write_glb(path, document, binary + rows.tobytes())
    found = read_splats(path)
    for attribute, field in STORED.items():
        step = 0.51 / np.iinfo(dtype).max if attribute == name else 1e-7
        np.testing.assert_allclose(getattr(found, field), getattr(plain, field), atol=step)


@pytest.mark.parametrize(
    ("name", "options"), [("a.spz", {}), ("a.glb", {"compress": "spz"}), ("a.glb", {})]
)
def test_a_large_spz_is_noted(
    monkeypatch: pytest.MonkeyPatch, name: str, options: dict[str, str]
) -> None:
    monkeypatch.setattr("g2ard.io.scene_formats.LARGEST_SPZ", 19)
    ball = checkered_ball(20)
    codes = [note.code for note in lost_in(name, ball, **options)]
    assert codes == ["large_spz"] * (name == "a.spz" or bool(options))
    monkeypatch.setattr("g2ard.io.scene_formats.LARGEST_SPZ", 20)
    assert lost_in(name, ball, **options) == []
