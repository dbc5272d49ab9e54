"""Inputs and calls of `tests/goldens.py`; its commands are in `tests/goldens.txt`.

The inputs are written without g2ard, so that a change of its writers changes no input.
"""

import gzip
import json
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import Any

import laspy
import numpy as np
from PIL import Image
from plyfile import PlyData, PlyElement

SIZE = (48, 36)
MAP = np.array([542_300.0, 6_589_200.0, 30.0])
"""Origin of the LAS cloud."""

TEXTS = {
    "bad.toml": "[simplify]\nratoi = 4\n",
    "options.toml": """[simplify]
ratio = 8
method = "fast"
[distill]
ratio = 8
[distill.set]
rates.means = 1e-3
""",
    "text.ply": "This is no scene.\n",
    "broken.json": '{"format": "g2ard-views", "version": 1, "views": [{"name": "a", "width": 8}]}',
    "matrix.json": "[[0, -2, 0, 1], [2, 0, 0, 2], [0, 0, 2, 3], [0, 0, 0, 1]]",
}
"""Text files among the inputs: name, content."""

FAR = {"select.focus": "far"}
TILES = ("--tile-rows", "700", "--workers", "1")
RESUMED = ("adapt", "distill", "lod", "recover")
"""Commands that continue an interrupted run with --resume; the others need no option."""


def _targets(g: Any, photos: bool = False) -> Any:
    if photos:
        return g.Photos(g.load_views("in/photos"))
    return g.TeacherRenders(g.load("in/ball.ply"), g.load_views("in/views.json"))


CALLS: dict[str, Callable[[Any], Any]] = {
    "simplify": lambda g: g.simplify(
        "in/ball.ply", ratio=5, views="in/views.json", settings={"dilation": 0.3}
    ),
    "simplify-scene": lambda g: g.simplify(
        g.load("in/ball.ply"), count=70, method="fast", blind=True
    ),
    "simplify-config": lambda g: g.simplify(
        "in/ball.ply", ratio=5, config=g.preset("paper", g.SimplifyConfig())
    ),
    "select": lambda g: g.select(
        g.load("in/ball.ply"), g.load_views("in/views.json"), 5, policy="directional"
    ),
    "recover": lambda g: g.recover(g.load("in/small.ply"), _targets(g), steps=9, seed=2),
    "recover-paths": lambda g: g.recover(
        "in/small.ply",
        views="in/photos",
        photos=True,
        preset="lift",
        settings={"steps": 9, "sh_degree": 0},
    ),
    "adapt": lambda g: g.adapt(
        g.load("in/small.ply"), _targets(g, photos=True), g.AdaptConfig(steps=9)
    ),
    "distill": lambda g: g.distill(
        "in/ball.ply", ratio=5, views="in/views.json", steps=9, size=32, settings=FAR
    ),
    "distill-photos": lambda g: g.distill(None, count=90, views="in/photos", steps=9, size=32),
    "distill-against": lambda g: g.distill_against(
        g.load("in/ball.ply"),
        80,
        _targets(g),
        g.preset("trained", g.DistillConfig(recover=g.RecoverConfig(steps=9))),
    ),
    "lod": lambda g: g.lod("in/ball.ply", ratios=(2, 4), views="in/views.json", steps=9, size=32),
    "clean": lambda g: g.clean("in/sky.ply"),
    "convert": lambda g: g.convert(
        ["in/ball.ply", "in/small.ply"], box=(-1, -1, -1, 1, 1, 0.5), scale=2
    ),
    "lift": lambda g: g.lift(
        g.load_points("in/cloud.ply").positions, g.load_points("in/cloud.ply").colors
    ),
    "evaluate": lambda g: g.evaluate(g.load("in/small.ply"), _targets(g)),
    "render": lambda g: g.render(
        g.load("in/ball.ply"), g.load_views("in/views.json")[3], median=True
    ),
    "poses": lambda g: g.make_pool(g.load("in/ball.ply"), 6, size=SIZE),
    "views": lambda g: [
        g.load_views(f"in/{name}") for name in ("photos", "masked", "colmap", "trained")
    ],
    "presets": lambda g: [
        g.preset(name) for name in ("auto", "paper", "paper-noisy", "lift", "noisy")
    ],
    "no-budget": lambda g: g.simplify("in/ball.ply"),
    "no-setting": lambda g: g.distill("in/ball.ply", ratio=4, settings={"nothing": 1}),
    "no-scene": lambda g: g.load("in/short.ply"),
    "no-format": lambda g: g.save("s.xyz", g.load("in/ball.ply")),
}
"""Name → a call from Python. The fields of its result are compared, or its error."""

STOPPED: dict[str, Callable[[Any, Path, Any], Any]] = {
    "distill": lambda g, work, progress: g.distill(
        "in/ball.ply",
        ratio=5,
        views="in/views.json",
        size=32,
        steps=30,
        settings=FAR,
        work=work,
        progress=progress,
    ),
    "paper": lambda g, work, progress: g.distill(
        "in/ball.ply",
        ratio=4,
        views="in/views.json",
        size=32,
        preset="paper",
        steps=24,
        work=work,
        progress=progress,
    ),
    "adapt": lambda g, work, progress: g.adapt(
        g.load("in/small.ply"), _targets(g), g.AdaptConfig(steps=30), work=work, progress=progress
    ),
    "recover": lambda g, work, progress: g.recover(
        g.load("in/small.ply"), _targets(g), steps=30, checkpoint=work / "c.npz", progress=progress
    ),
    "lod": lambda g, work, progress: g.lod(
        "in/ball.ply",
        ratios=(2, 4),
        views="in/views.json",
        size=32,
        steps=20,
        work=work,
        progress=progress,
    ),
    "ingest": lambda g, work, progress: g.ingest(
        "in/town.ply", work / "tiles", tile_rows=500, progress=progress
    ),
}
"""Name → a call that is stopped by Ctrl-C and made again; it must then return what it returns unstopped."""


def make_inputs(folder: Path) -> None:
    """Write the inputs that the cases name as in/…"""
    for name, content in TEXTS.items():
        (folder / name).write_text(content)
    ball, town = _ball(400), _town(2000)
    _write_scene(folder / "ball.ply", ball)
    _write_scene(folder / "small.ply", _ball(100, seed=7))
    _write_scene(folder / "town.ply", town)
    _write_scene(
        folder / "sky.ply", {name: np.concatenate([ball[name], _sky(60)[name]]) for name in ball}
    )
    _write_scene(
        folder / "nan.ply", {**ball, "y": np.where(np.arange(400) == 17, np.nan, ball["y"])}
    )
    _write_scene(folder / "untyped.ply", {name: ball[name] for name in ball if name != "opacity"})
    (folder / "short.ply").write_bytes((folder / "ball.ply").read_bytes()[:-50])
    points, colors = _surface(900)
    rows = dict(zip("xyz", points.T, strict=True)) | dict(
        zip(("red", "green", "blue"), colors.T, strict=True)
    )
    _write_ply(folder / "cloud.ply", rows, dict.fromkeys(("red", "green", "blue"), "u1"))
    _write_las(folder / "cloud.las", points + MAP, colors)
    for name in ("level0-sh2", "level2-sh2"):
        packed = Path(__file__).parents[1] / "io" / "ksplat" / f"{name}.ksplat.gz"
        (folder / f"{name}.ksplat").write_bytes(gzip.decompress(packed.read_bytes()))
    _write_views(folder / "views.json", _around(16))
    _write_views(folder / "ring.json", [_looking(12 * np.array(e), (0, 0, 0)) for e in _circle(10)])
    _write_views(folder / "large.json", _around(4), 128, 96)
    _write_views(folder / "rough.json", [_moved(pose) for pose in _around(4)], 128, 96)
    for name, origin, masks in (("photos", 0, False), ("masked", 0, True), ("map", MAP, False)):
        _write_photos(folder / name, _around(8), np.zeros(3) + origin, masks)
    _write_photos(folder / "other", _around(5), np.zeros(3), False)
    _write_colmap(folder / "colmap", _around(8))
    _write_trained(folder / "trained", ball, _around(12))


def _surface(count: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Points on the unit sphere, and their colours, bytes."""
    normals = np.random.default_rng(seed).normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return normals, _colour(normals)


def _colour(places: np.ndarray) -> np.ndarray:
    """Colour of a place on the sphere: squares of two colours."""
    odd = (np.floor(3 * places[..., 0]) + np.floor(3 * places[..., 1])) % 2
    return np.where(odd[..., None] > 0, [230, 128, 26], [26, 77, 179]).astype(np.uint8)


def _scene(
    means: np.ndarray, quats: Any, sigmas: Any, opacity: Any, colors: np.ndarray, seed: int
) -> Any:
    """Columns of a trained scene of SH degree 1; `opacity` holds logits."""
    rng, count = np.random.default_rng(seed), len(means)
    names = [*"xyz", *(f"rot_{i}" for i in range(4)), *(f"scale_{i}" for i in range(3)), "opacity"]
    names += [*(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(9))]
    parts = [
        means,
        quats,
        np.log(sigmas),
        np.reshape(opacity, (count, 1)),
        (colors / 255 - 0.5) / 0.28209479,
    ]
    table = np.concatenate([*parts, rng.normal(0, 0.03, (count, 9))], axis=1)
    return dict(zip(names, table.T, strict=True))


def _ball(count: int, seed: int = 0) -> Any:
    """Discs on the unit sphere."""
    normals, colors = _surface(count, seed)
    x, y, z = normals.T
    size = 1.6 * np.sqrt(4 * np.pi / count) / 2
    quats = np.stack([1 + z, -y, x, 0 * x], 1)
    logits = np.random.default_rng(seed).normal(2.5, 0.5, count)
    return _scene(
        normals, quats, np.tile([size, size, size / 10], (count, 1)), logits, colors, seed
    )


def _town(count: int) -> Any:
    """A ground with boxes on it, of uneven density."""
    rng = np.random.default_rng(3)
    means = rng.uniform([-8, -4, 0], [8, 4, 0.1], (count, 3))
    means[count // 2 :, 0] = rng.choice([-6.0, -2.0, 3.0], count - count // 2) + rng.normal(
        0, 0.4, count // 2
    )
    means[count // 2 :, 2] = rng.uniform(0, 1.5, count - count // 2)
    sigmas, logits = np.exp(rng.normal(-1.8, 0.3, (count, 3))), rng.normal(2, 2, count)
    return _scene(means, rng.normal(size=(count, 4)), sigmas, logits, _colour(means / 2), 3)


def _sky(count: int) -> Any:
    """Faint layers far away, some of them needles or floaters."""
    rng = np.random.default_rng(4)
    towards = rng.normal(size=(count, 3))
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    sigmas = np.exp(rng.normal(np.log([12, 6, 1e-6]), 0.3, (count, 3)))
    sigmas[::6] = [0.5, 1e-3, 1e-3]
    distances = np.where(np.arange(count) % 6, rng.uniform(20, 60, count), 2)
    means, quats = towards * distances[:, None], rng.normal(size=(count, 4))
    return _scene(
        means, quats, sigmas, rng.normal(-1, 1, count), rng.integers(0, 255, (count, 3)), 4
    )


def _write_ply(path: Path, columns: dict[str, np.ndarray], types: dict[str, str]) -> None:
    table = np.empty(len(columns["x"]), [(name, types.get(name, "f4")) for name in columns])
    for name, values in columns.items():
        table[name] = values
    path.parent.mkdir(parents=True, exist_ok=True)
    PlyData([PlyElement.describe(table, "vertex")], byte_order="<").write(str(path))


def _write_scene(path: Path, columns: dict[str, np.ndarray]) -> None:
    _write_ply(path, columns, {})


def _write_las(path: Path, points: np.ndarray, colors: np.ndarray) -> None:
    header = laspy.LasHeader(point_format=2, version="1.2")
    header.offsets, header.scales = points.min(0), np.full(3, 0.001)
    header.creation_date = date(2026, 1, 1)  # today's by default
    data = laspy.LasData(header)
    data.x, data.y, data.z = points.T
    data.red, data.green, data.blue = colors.astype(np.uint16).T * 257
    data.write(str(path))


def _looking(eye: np.ndarray, at: Any) -> np.ndarray:
    """(4, 4) camera_from_world: x right, y down, z forward; z is up in the world."""
    forward = np.asarray(at, float) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = [right, np.cross(forward, right), forward]
    pose[:3, 3] = -pose[:3, :3] @ eye
    return pose


def _circle(count: int, high: float = 0.4) -> list[list[float]]:
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return [[float(np.cos(a)), float(0.7 * np.sin(a)), high] for a in angles]


def _around(count: int) -> list[np.ndarray]:
    """Poses on a spiral over the sphere, 3 from its middle."""
    z = 0.9 - 1.8 * np.arange(count) / (count - 1)
    azimuth, flat = 2.4 * np.arange(count), np.sqrt(1 - z * z)
    eyes = 3 * np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), z], 1)
    return [_looking(eye, (0, 0, 0)) for eye in eyes]


def _moved(pose: np.ndarray) -> np.ndarray:
    return pose + np.eye(4)[:, :3] @ np.diag([0.03, -0.02, 0.05]) @ np.ones((3, 1)) * [0, 0, 0, 1]


def _photo(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a photo of the coloured unit sphere and its mask, by intersecting rays."""
    (width, height), focal = SIZE, SIZE[0]
    u, v = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    rays = np.stack([u / focal, v / focal, np.ones_like(u)], -1) @ pose[:3, :3]
    eye = -pose[:3, :3].T @ pose[:3, 3]
    a, b, c = (rays**2).sum(-1), rays @ eye, eye @ eye - 1
    hit = b * b > a * c
    far = (-b - np.sqrt(np.where(hit, b * b - a * c, 0))) / a
    return np.where(hit[..., None], _colour(eye + far[..., None] * rays), 0).astype(np.uint8), hit


def _write_views(
    path: Path, poses: list[np.ndarray], width: int = SIZE[0], height: int = SIZE[1]
) -> None:
    K = [[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]]
    views = [
        {
            "name": f"view_{i:03d}",
            "width": width,
            "height": height,
            "K": K,
            "camera_from_world": pose.tolist(),
        }
        for i, pose in enumerate(poses)
    ]
    path.write_text(json.dumps({"format": "g2ard-views", "version": 1, "views": views}))


def _write_image(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)


def _write_photos(folder: Path, poses: list[np.ndarray], origin: np.ndarray, masks: bool) -> None:
    """Write a transforms.json with photos with alpha, and masks of the left three quarters if requested."""
    frames = []
    for i, pose in enumerate(poses):
        world = np.linalg.inv(pose)
        world[:3, 3] += origin
        world[:3, 1:3] *= -1  # OpenGL's axes
        frames.append({"file_path": f"images/{i:03d}.png", "transform_matrix": world.tolist()})
        pixels, hit = _photo(pose)
        _write_image(
            folder / f"images/{i:03d}.png", np.dstack([pixels, 255 * hit.astype(np.uint8)])
        )
        if masks:
            frames[-1]["mask_path"] = f"masks/{i:03d}.png"
            kept = np.full(SIZE[::-1], 255, np.uint8)
            kept[:, 3 * SIZE[0] // 4 :] = 0
            _write_image(folder / f"masks/{i:03d}.png", kept)
    (width, height), focal = SIZE, SIZE[0]
    lens = {
        "fl_x": focal,
        "fl_y": focal,
        "cx": width / 2,
        "cy": height / 2,
        "w": width,
        "h": height,
    }
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))


def _write_colmap(folder: Path, poses: list[np.ndarray]) -> None:
    """Write a COLMAP project in text, with sparse points."""
    model, (width, height), focal = folder / "sparse" / "0", SIZE, SIZE[0]
    model.mkdir(parents=True)
    camera = f"1 PINHOLE {width} {height} {focal} {focal} {width / 2} {height / 2}\n"
    (model / "cameras.txt").write_text(camera)
    lines = []
    for i, pose in enumerate(poses):
        R = pose[:3, :3]
        w = np.sqrt(1 + np.trace(R)) / 2
        x, y, z = (R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]) / (4 * w)
        lines.append(f"{i + 1} {w} {x} {y} {z} {' '.join(map(str, pose[:3, 3]))} 1 {i:03d}.png\n\n")
        _write_image(folder / f"images/{i:03d}.png", _photo(pose)[0])
    (model / "images.txt").write_text("".join(lines))
    points = zip(*_surface(80, seed=5), strict=True)
    rows = [
        f"{i} {x} {y} {z} {r} {g} {b} 0.5 1 0 2 0\n"
        for i, ((x, y, z), (r, g, b)) in enumerate(points)
    ]
    (model / "points3D.txt").write_text("".join(rows))


def _write_trained(folder: Path, scene: dict[str, np.ndarray], poses: list[np.ndarray]) -> None:
    """Write a model as 3DGS's trainer does: the scene with its cameras.json two folders above."""
    _write_scene(folder / "point_cloud/iteration_7/point_cloud.ply", scene)
    cameras = []
    for i, pose in enumerate(poses):
        world, lens = (
            np.linalg.inv(pose),
            {"fx": SIZE[0], "fy": SIZE[0], "width": SIZE[0], "height": SIZE[1]},
        )
        where = {"position": world[:3, 3].tolist(), "rotation": world[:3, :3].tolist()}
        cameras.append({"id": i, "img_name": f"{i:03d}", **lens, **where})
    (folder / "cameras.json").write_text(json.dumps(cameras))
