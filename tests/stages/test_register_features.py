"""Features: matches against a naive twin, lifted points, solved poses, and invalid matchers."""

import re
import sys
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from g2ard.errors import InputError, MissingDependencyError
from g2ard.io import read_views, write_splats, write_views
from g2ard.io.images import write_png
from g2ard.rendering.renderer import Rendered, Renderer
from g2ard.scene.cameras import Camera, Cameras
from g2ard.stages.register import PhotoReport, PoseError, pose_error, register
from g2ard.stages.register import matchers as module
from g2ard.stages.register.matchers import checked_pairs, matcher_named, mutual
from g2ard.stages.register.pose import motion_between, moved
from g2ard.stages.register.solve import information, lifted, solve_pnp
from helpers.commands import CommandLine, refused, succeeds
from helpers.feature_scenes import BALL, CONFIG, _photographed, blotched
from helpers.project import ROOT
from helpers.registration import off, result_errors
from helpers.scenes import around
from helpers.threads import on_threads


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 12), st.integers(2, 12), st.floats(0.5, 1))
def test_mutual_matches_are_the_twins(seed: int, m: int, n: int, ratio: float) -> None:
    rng = np.random.default_rng(seed)
    a, b = (rng.integers(0, 9, (k, 5)).astype(np.float32) for k in (m, n))
    far = np.linalg.norm(a[:, None].astype(np.float64) - b[None], axis=2)
    expected = [
        (i, int(far[i].argmin()))
        for i in range(m)
        if far[:, far[i].argmin()].argmin() == i
        and far[i].min() ** 2 < ratio**2 * np.sort(far[i])[1] ** 2 * (1 - 1e-9)
    ]
    i, j = mutual(a, b, ratio)
    close = [
        (x, y) for x, y in zip(i.tolist(), j.tolist(), strict=True)
        if far[x].min() ** 2 < ratio**2 * np.sort(far[x])[1] ** 2 * (1 - 1e-9)
    ]  # fmt: skip
    assert close == expected


@settings(max_examples=40, deadline=None)
@given(st.lists(st.floats(-2.5, 2.5), min_size=6, max_size=6), st.integers(0, 1000))
def test_the_motion_between_two_poses_moves_one_to_the_other(xi: list[float], seed: int) -> None:
    motion = np.array(xi)
    motion[3:] *= min(1.0, 3.0 / max(np.linalg.norm(motion[3:]), 1e-12))
    first = off(np.eye(4), 3, 100, seed)
    found = motion_between(first, moved(first, motion))
    np.testing.assert_allclose(found, motion, atol=1e-7)


def test_points_are_lifted_to_where_they_are_seen() -> None:
    camera = around(5, (160, 120), 2.5)[2]
    rng = np.random.default_rng(0)
    uv = rng.uniform(2, [158, 118], (200, 2))
    K = camera.K
    # a plane z = 3 + x/4 in the camera's axes, its depth at every pixel's middle
    slope = 3 / (1 - ((np.arange(160) + 0.5 - K[0, 2]) / K[0, 0]) / 4)
    depth = np.repeat(slope[None], 120, 0).astype(np.float32)
    alpha = np.ones_like(depth)
    alpha[:, :40] = 0.2
    depth[60:, 100:] *= 2
    image = np.zeros((120, 160, 3), np.float32)
    points, known = lifted(Rendered(image, alpha, depth * alpha, depth), camera, uv, CONFIG)
    seen = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    back = seen[:, :2] / seen[:, 2:] * [K[0, 0], K[1, 1]] + K[:2, 2]
    np.testing.assert_allclose(back[known], uv[known], atol=1e-6)
    near = known & ~((uv[:, 0] > 99) & (uv[:, 1] > 59))
    np.testing.assert_allclose(seen[near, 2], 3 + seen[near, 0] / 4, rtol=1e-4)
    assert not known[uv[:, 0] < 39].any()
    edge = (np.abs(uv[:, 0] - 100) < 0.4) & (uv[:, 1] > 61)
    assert not known[edge].any()
    assert known.mean() > 0.6


def test_information_is_that_of_reprojections() -> None:
    """JᵀWJ/σ² and JᵀWr/σ² against central differences of the projections by pose and focal length."""
    rng = np.random.default_rng(1)
    K = np.array([[300, 0, 160], [0, 310, 120], [0, 0, 1.0]])
    T = off(np.eye(4), 2, 40, 3)
    seen = rng.uniform([-1, -1, 2], [1, 1, 5], (50, 3))
    points = (seen - T[:3, 3]) @ T[:3, :3]

    def projected(xi: np.ndarray) -> np.ndarray:
        pose = moved(T, xi[:6])
        X = points @ pose[:3, :3].T + pose[:3, 3]
        return (X[:, :2] / X[:, 2:]) * [300, 310] * np.exp(xi[6]) + [160, 120]

    uv = projected(np.zeros(7)) + rng.normal(0, 0.7, (50, 2))
    step = 1e-6
    J = np.stack([(projected(step * e) - projected(-step * e)) / (2 * step) for e in np.eye(7)])
    residual = uv - projected(np.zeros(7))
    sigma = 1.4826 * np.median(np.abs(residual))
    weight = 1 / (1 + (residual**2).sum(1) / sigma**2)
    matrix, right = information(T, K, uv, points)
    expected = np.einsum("imk,jmk,m->ij", J, J, weight) / sigma**2
    np.testing.assert_allclose(matrix, expected, rtol=1e-5, atol=1e-5 * expected.max())
    expected = np.einsum("imk,mk,m->i", J, residual, weight) / sigma**2
    np.testing.assert_allclose(right, expected, rtol=1e-4, atol=1e-5 * np.abs(expected).max())


def test_pnp_finds_the_pose_in_map_coordinates() -> None:
    pytest.importorskip("pycolmap")
    camera = around(5, (320, 240), 2.5)[1]
    rng = np.random.default_rng(2)
    offset = np.array([500_000.0, 4_000_000.0, 100.0])
    seen = np.concatenate([rng.uniform(-1, 1, (80, 2)), rng.uniform(2, 5, (80, 1))], 1)
    true = camera.viewmat.copy()
    true[:3, 3] -= true[:3, :3] @ offset
    points = (seen - true[:3, 3]) @ true[:3, :3]
    K = camera.K
    uv = seen[:, :2] / seen[:, 2:] * [K[0, 0], K[1, 1]] + K[:2, 2]
    uv[::5] += rng.uniform(20, 60, (16, 2))
    found = solve_pnp(camera, uv, points, CONFIG)
    pose, inlying = found
    assert (~inlying).tolist() == [i % 5 == 0 for i in range(80)]
    assert pose_error(pose, true)[0] < 1e-3  # of millions
    assert solve_pnp(camera, uv[:5], points[:5], CONFIG) is None


def test_features_find_the_pose(tmp_path: Path) -> None:
    """A quarter of the distance to the surface, and 15°, off, under other light."""
    pytest.importorskip("pycolmap")
    views = _photographed(tmp_path)
    truth = dict(zip(views.names, views.viewmats, strict=True))
    starts = {name: off(pose, 0.4, 15, i) for i, (name, pose) in enumerate(truth.items())}
    found = register(BALL, views, starts=starts, config=CONFIG).report.photos
    direct = register(BALL, views, starts=starts, config=replace(CONFIG, matcher="direct"))
    for row, error in zip(found, result_errors(found, truth), strict=True):
        assert row.status == "registered"
        assert row.inliers >= CONFIG.min_inliers
        assert error.position < 0.005
        assert error.rotation < 0.1
        assert row.reprojection < 1
    assert all(row.inliers == 0 and row.reprojection is None for row in direct.report.photos)


def test_features_and_alignment_are_no_worse_than_either(tmp_path: Path) -> None:
    """At the photo's size: a smaller render of a ball on black is a little wider than the shrunk photo."""
    pytest.importorskip("pycolmap")
    views = _photographed(tmp_path)
    truth = dict(zip(views.names, views.viewmats, strict=True))
    starts = {name: off(pose, 0.2, 6, i) for i, (name, pose) in enumerate(truth.items())}
    errors = {}
    for refine in ("auto", "none", "photometric"):
        config = replace(CONFIG, refine=refine, align_size=CONFIG.size)  # type: ignore[arg-type]
        rows = register(BALL, views, starts=starts, config=config).report.photos
        assert all(row.inliers for row in rows)
        errors[refine] = np.median([error.position for error in result_errors(rows, truth)])
    assert errors["none"] < 0.001
    assert errors["auto"] <= 1.1 * min(errors["none"], errors["photometric"]) + 2e-4


def test_results_do_not_depend_on_threads(tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")
    views = _photographed(tmp_path, 1)
    starts = {views.names[0]: off(views.viewmats[0], 0.2, 6, 1)}
    found = on_threads(lambda: register(BALL, views, starts=starts, config=CONFIG).report, (1, 2))
    one, two = (report.photos[0] for report in found)
    assert one.inliers == two.inliers > 0
    np.testing.assert_array_equal(one.camera_from_world, two.camera_from_world)
    np.testing.assert_array_equal(one.covariance, two.covariance)


@pytest.mark.parametrize(
    ("pairs", "words"),
    [
        (None, "got NoneType"),
        (([[1, 2]], [[1, 2], [3, 4]]), r"got shapes \(1, 2\) and \(2, 2\)"),
        (([[1, 2, 3]], [[1, 2, 3]]), r"got shapes \(1, 3\)"),
        (([[1, np.nan]], [[1, 2]]), "not finite"),
        (("ab", "cd"), "got tuple"),
        (([[1, 2]],), "got tuple"),
        (([[1e9, 2]], [[1, 2]]), "1 pairs, none of them within the images"),
    ],
)
def test_invalid_pairs_of_a_matcher_are_named(pairs: object, words: str) -> None:
    with pytest.raises(InputError, match=words):
        checked_pairs("matcher m:f", pairs, (9, 9, 3), (9, 9, 3))


@pytest.mark.parametrize(
    ("machine", "words"), [("x86_64", r"\)"), ("aarch64", ", and has no wheel for linux aarch64")]
)
def test_without_pycolmap_direct_alignment_is_left(
    machine: str, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "find_spec", lambda name: None)
    monkeypatch.setattr(module.sys, "platform", "linux")
    monkeypatch.setattr(module.platform, "machine", lambda: machine)
    assert matcher_named("auto", 0.85, 100) is None
    for name in ("sift", "json:dumps"):
        with pytest.raises(MissingDependencyError, match=rf"pycolmap is not installed{words}"):
            matcher_named(name, 0.85, 100)


def test_extras_name_pycolmap_where_it_has_wheels() -> None:
    requirements = pytest.importorskip("packaging.requirements")
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for extra in ("register", "dev"):
        (found,) = (r for r in extras["optional-dependencies"][extra] if r.startswith("pycolmap"))
        marker = requirements.Requirement(found).marker
        for system in ("linux", "darwin", "win32"):
            for machine in ("x86_64", "AMD64", "aarch64", "arm64", "ARM64"):
                # not their names
                if (system, machine) not in (("linux", "AMD64"), ("win32", "x86_64")):
                    named = marker.evaluate({"sys_platform": system, "platform_machine": machine})
                    assert named == ((system, machine) in module._PYCOLMAP_PLATFORMS)


def test_a_pycolmap_that_does_not_load_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pycolmap")

    def broken(name: str) -> None:
        raise ImportError("libgomp.so.1: cannot open shared object file")

    monkeypatch.setattr(module.importlib, "import_module", broken)
    assert matcher_named("auto", 0.85, 100) is None
    with pytest.raises(
        MissingDependencyError, match="installed but cannot be imported: ImportError: libgomp"
    ):
        matcher_named("sift", 0.85, 100)


@pytest.mark.parametrize(
    ("source", "words"),
    [
        (None, "cannot import plugin: ModuleNotFoundError"),
        ("def other(a, b): ...", "plugin has no function match"),
        ("match = 3", "plugin has no function match"),
        ("def match(a, b): return 5", "expected two (M, 2) arrays"),
        ("def match(a, b): raise SystemExit(3)", "plugin:match: SystemExit: 3"),
        (
            "def match(a, b): raise ValueError('out\\nof luck')",
            "plugin:match: ValueError: out of luck",
        ),
    ],
)
def test_failing_plugins(
    source: str | None, words: str, command_line: CommandLine, tmp_path: Path
) -> None:
    pytest.importorskip("pycolmap")
    _one_view(tmp_path)
    if source is not None:
        (tmp_path / "plugin.py").write_text(source + "\n")
    assert words in refused(command_line, tmp_path, *_CALL, "--matcher", "plugin:match", status=1)


def test_a_plugin_matches(command_line: CommandLine, tmp_path: Path) -> None:
    """A plugin that calls SIFT gives the pose of --matcher sift."""
    pytest.importorskip("pycolmap")
    _one_view(tmp_path)
    (tmp_path / "plugin.py").write_text(
        "from g2ard.stages.register.matchers import Sift\nmatch = Sift(0.85, 4096)\n"
    )
    for name, output in (("plugin:match", "a.json"), ("sift", "b.json")):
        call = [output if word == "poses.json" else word for word in _CALL]
        succeeds(command_line, tmp_path, *call, "--matcher", name)
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()


_CALL = [
    *("register", "scene.ply", "--images", "views.json", "--poses", "coarse.json"),
    *("--size", "400", "-o", "poses.json"),
]


def _one_view(folder: Path) -> None:
    views = _photographed(folder, 1)
    write_splats(folder / "scene.ply", BALL)
    write_views(folder / "views.json", views)
    write_views(
        folder / "coarse.json", replace(views, viewmats=off(views.viewmats[0], 0.1, 3, 0)[None])
    )


@pytest.mark.parametrize(("gain", "bias"), [(1.6, 0.0), (1.0, -0.1)])
def test_a_change_of_light_does_not_move_the_pose(gain: float, bias: float, tmp_path: Path) -> None:
    """The pose changes by less than a tenth of what registration corrects."""
    pytest.importorskip("pycolmap")
    view = around(2, (400, 300), 2.5)[0]
    image = 0.5 * Renderer(BALL).image(view)
    write_png(tmp_path / "photo.png", np.clip(gain * image + bias, 0, 1))
    row, error = _registered(view, tmp_path)
    assert row.status == "registered"
    assert error.position < 0.01
    assert error.rotation < 0.3


def test_an_occluder_does_not_move_the_pose(tmp_path: Path) -> None:
    """The pose is right within 2σ although a fifth of the photo is foreign."""
    pytest.importorskip("pycolmap")
    rng = np.random.default_rng(4)
    view = around(2, (400, 300), 2.5)[0]
    image = np.clip(Renderer(BALL).image(view), 0, 1)
    image[60:210, 120:280] = rng.random((15, 16, 3)).repeat(10, 0).repeat(10, 1)
    write_png(tmp_path / "photo.png", image)
    row, error = _registered(view, tmp_path)
    assert row.status == "registered"
    assert error.position < 2 * row.sigma.position
    assert error.rotation < 2 * row.sigma.rotation


def test_a_photo_of_another_scene_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")
    view = around(3, (400, 300), 2.5)[1]
    write_png(tmp_path / "photo.png", np.clip(Renderer(blotched(seed=9)).image(view), 0, 1))
    assert _registered(view, tmp_path)[0].status != "registered"


def _registered(view: Camera, folder: Path) -> tuple[PhotoReport, PoseError]:
    """Register photo.png from a start that is 0.1 units and 3° off; return its report and error."""
    views = Cameras.of([replace(view, image_path=folder / "photo.png", name="photo")])
    starts = {"photo": off(view.viewmat, 0.1, 3, 0)}
    rows = register(BALL, views, starts=starts, config=CONFIG, keep="all").report.photos
    return rows[0], result_errors(rows, {"photo": view.viewmat})[0]


_MAST3R = f"""#!{sys.executable}
import sys

import numpy as np
from g2ard.stages.register.matchers import Sift
from PIL import Image


def read(name):
    image = Image.open(name)
    image = image.resize([round(512 * n / max(image.size)) for n in image.size])
    halves, centre = ([n // step * (step // 2) for n in image.size] for step in (16, 2))
    box = [c - h for c, h in zip(centre, halves)] + [c + h for c, h in zip(centre, halves)]
    return np.asarray(image.crop(box), np.float32) / 255


photo, render = (np.rint(pixels - 0.5) for pixels in Sift(0.85, 4096)(*map(read, sys.argv[1:3])))
np.savez(sys.argv[3], matches_im0=photo.astype(int), matches_im1=render.astype(int))
"""
"""A program in the place of MASt3R: it shrinks and crops as MASt3R does, and saves SIFT's matches."""


def _mast3r_adapter() -> str:
    text = (ROOT / "docs/methods/register.md").read_text(encoding="utf-8")
    return next(
        b for b in re.findall(r"(?ms)^```python\n(.*?)^```", text) if "mast3r_pairs.py" in b
    )


@pytest.mark.skipif(sys.platform == "win32", reason="needs a script that runs by its first line")
def test_the_documented_adapter_registers(
    command_line: CommandLine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pycolmap")
    _one_view(tmp_path)
    (tmp_path / "mast3r_pairs.py").write_text(_mast3r_adapter())
    (tmp_path / "mast3r").write_text(_MAST3R)
    (tmp_path / "mast3r").chmod(0o755)
    monkeypatch.setenv("MAST3R", str(tmp_path / "mast3r"))
    succeeds(command_line, tmp_path, *_CALL, "--matcher", "mast3r_pairs:match", "--passes", "1")
    true, found = (read_views(tmp_path / name).viewmats[0] for name in ("views.json", "poses.json"))
    position, rotation = pose_error(found, true)
    assert position < 0.01  # it starts at 0.1
    assert rotation < 0.3  # at 3°


def test_the_documented_adapter_reads_mast3rs_matches(tmp_path: Path) -> None:
    names: dict[str, Any] = {}
    exec(compile(_mast3r_adapter(), "mast3r_pairs.py", "exec"), names)
    photo, render = np.zeros((562, 1000, 3)), np.zeros((750, 1000, 3))
    # 1000×562 becomes 512×288 whole, 1000×750 becomes 512×384 whole; corners and centres in pixels of each
    found = {"matches_im0": [[0, 0], [511, 287]], "matches_im1": [[0, 0], [511, 383]]}
    np.savez(tmp_path / "m.npz", **found)
    a, b = names["pairs"](tmp_path / "m.npz", photo, render)
    np.testing.assert_allclose(a, [[0.98, 0.98], [999.02, 561.52]], atol=0.01)
    np.testing.assert_allclose(b, [[0.98, 0.98], [999.02, 749.02]], atol=0.01)
    np.savez(tmp_path / "n.npz", matches_im0=[[0, 0]], matches_im1=[[0, 0]])
    (a, _) = names["pairs"](tmp_path / "n.npz", np.zeros((600, 1000, 3)), render)
    # 307 rows, one cut
    np.testing.assert_allclose(a, [[0.98, 0.5 * 1000 / 512 + 1 * 1000 / 512]], atol=0.01)
