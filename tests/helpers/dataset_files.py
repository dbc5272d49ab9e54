"""Data sets in their published layout, with few views."""

import json
from pathlib import Path

import numpy as np

from g2ard.io import write_splats
from g2ard.io.images import write_png
from g2ard.rendering.renderer import Renderer
from g2ard.scene.cameras import Camera, look_at
from g2ard.scene.splats import SH_C0, Splats
from helpers.cloud_files import ply
from helpers.scenes import around
from helpers.view_files import photo, quaternion

POSES = [look_at([3 * np.cos(a), 3 * np.sin(a), 1.5], [0, 0, 0]) for a in np.linspace(0, 5, 9)]


def opengl(view: np.ndarray) -> np.ndarray:
    return np.linalg.inv(view) @ np.diag([1.0, -1, -1, 1])


def llff(root: Path, scale: int = 4) -> None:
    """poses_bounds.npy for photos of 400×300 pixels, of which a smaller copy exists."""
    rows = []
    for i, view in enumerate(POSES):
        pose = np.linalg.inv(view)  # right, down, forward
        down_right_back = np.stack([pose[:3, 1], pose[:3, 0], -pose[:3, 2]], axis=1)
        head = np.array([[300.0], [400.0], [380.0]])
        rows.append([*np.hstack([down_right_back, pose[:3, 3:], head]).ravel(), 1.0, 9.0])
        photo(root / f"images_{scale}" / f"IMG_{i:04d}.JPG", (400 // scale, 300 // scale))
    np.save(root / "poses_bounds.npy", np.array(rows))


def polycam(root: Path, folder: str = "corrected_") -> None:
    """Keyframes of a Polycam capture, named by their time in microseconds."""
    for i, view in enumerate(POSES):
        name, pose = str(9_999_000 + 500 * i), opengl(view)
        frame = {f"t_{row}{column}": pose[row, column] for row in range(3) for column in range(4)}
        frame |= {
            "fx": 95.0,
            "fy": 96.0,
            "cx": 51.0,
            "cy": 37.0,
            "width": 100,
            "height": 75,
            "blur_score": 30.0,
        }
        cameras = root / "keyframes" / f"{folder}cameras"
        cameras.mkdir(parents=True, exist_ok=True)
        (cameras / f"{name}.json").write_text(json.dumps(frame))
        photo(root / "keyframes" / f"{folder}images" / f"{name}.jpg", (100, 75))


def matrix_city(root: Path, scene: Splats, count: int = 16, size: int = 48) -> None:
    """Write the folders of MatrixCity that the studies read, and scenes in the place of the teachers.

    The pose folder has lengths in 100 m; the blocks have metres and rotations of a hundredth.
    """
    street = root / "small_city" / "street"
    pose, views = street / "pose" / "block_A", around(count, (size, size))
    pose.mkdir(parents=True)
    angle = 2 * float(np.arctan(size / 2 / views.Ks[0, 0, 0]))
    lens = {
        "camera_angle_x": angle,
        "fl_x": float(views.Ks[0, 0, 0]),
        "fl_y": float(views.Ks[0, 0, 0]),
    }
    lens |= {"k1": 0, "k2": 0, "k3": 0, "k4": 0, "p1": 0, "p2": 0, "cx": size / 2, "cy": size / 2}
    head = {**lens, "w": float(size), "h": float(size)}
    renderer = Renderer(scene)
    for split, rows in (("train", range(count - 4)), ("test", range(count - 4, count))):
        frames = []
        for i in rows:
            where = f"{split}/small_city_road_{'horizon' if i % 2 else 'vertical'}{'_test' * (split == 'test')}"
            write_png(_made(street / where / f"{i:04d}.png"), renderer.clipped(views[i]))
            matrix = opengl(views.viewmats[i]).tolist()
            frames.append({"file_path": f"../../{where}/{i:04d}.png", "transform_matrix": matrix})
        (pose / f"transforms_{split}.json").write_text(json.dumps({**head, "frames": frames}))
    block = street / "train_dense" / "small_city_road_horizon_dense"
    between, frames = around(40, (size, size), 2.6), []
    for i, view in enumerate(between):
        write_png(_made(block / f"{i:04d}.png"), renderer.clipped(view))
        matrix = opengl(view.viewmat)
        matrix[:3, :3] /= 100
        matrix[:3, 3] *= 100
        frames.append({"frame_index": i, "rot_mat": matrix.tolist()})
    (block / "transforms.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))
    points = root / "small_city_pointcloud" / "point_cloud_ds20" / "street" / "Block_A.ply"
    colors = np.rint(255 * np.clip(0.5 + SH_C0 * scene.sh0[:, 0], 0, 1))
    # as Open3D writes it
    types = dict.fromkeys("xyz", "f8") | dict.fromkeys(("red", "green", "blue"), "u1")
    ply(_made(points), types, np.concatenate([scene.means, colors], 1))
    for name in ("block_A.ply", "block_A_3M.ply"):
        write_splats(root / name, scene)


def inria_model(root: Path, scene: Splats) -> None:
    """Write a trained model as 3DGS's release has it."""
    write_splats(_made(root / "point_cloud" / "iteration_30000" / "point_cloud.ply"), scene)


def _made(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def mip_nerf_360(root: Path) -> None:
    model = root / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text("# x\n1 PINHOLE 400 300 380 381 201 149\n")
    rows = []
    for i, view in enumerate(POSES):
        q, t = quaternion(view[:3, :3]), view[:3, 3]
        rows.append(" ".join(map(str, (i + 1, *q, *t, 1, f"DSC{i:04d}.JPG"))) + "\n\n")
        for folder, size in (
            ("images", (400, 300)),
            ("images_2", (200, 150)),
            ("images_4", (100, 75)),
        ):
            photo(root / folder / f"DSC{i:04d}.JPG", size, red=20 * i)
    (model / "images.txt").write_text("".join(rows))


def cambridge(root: Path, size: tuple[int, int] = (192, 108), scene: Splats | None = None) -> None:
    """Write the lists, the NVM model and the photos, which show the scene if there is one."""
    lines = {"train": [], "test": []}
    cameras = []
    renderer = None if scene is None else Renderer(scene)
    for i, view in enumerate(POSES):
        split = "test" if i >= 6 else "train"
        name = f"seq{2 if split == 'test' else 1}/frame{i:05d}"
        q, c = quaternion(view[:3, :3]), -view[:3, :3].T @ view[:3, 3]
        lines[split].append(" ".join(f"{v:.9f}" for v in (*c, *q)).join((f"{name}.png ", "")))
        if i != 4:
            numbers = " ".join(f"{v:.9f}" for v in (1670.0 + i, *q, *c))
            cameras.append(f"{name}.jpg\t{numbers} -0.05 0 ")
        if renderer is None:
            photo(root / f"{name}.png", size)
        else:
            K = [
                [1670.0 / 1920 * size[0], 0, size[0] / 2],
                [0, 1670.0 / 1920 * size[0], size[1] / 2],
                [0, 0, 1],
            ]
            image = renderer.clipped(Camera(view, np.array(K), *size))
            write_png(_made(root / f"{name}.png"), image)
    for split, rows in lines.items():
        head = "Visual Landmark Dataset V1\nImageFile, Camera Position [X Y Z W P Q R]\n\n"
        (root / f"dataset_{split}.txt").write_text(head + "\n".join(rows) + "\n")
    points = "\n\n1\n0.1 0.2 0.3 9 8 7 0\n"
    (root / "reconstruction.nvm").write_text(
        f"NVM_V3 \n\n{len(cameras)}\n" + "\n".join(cameras) + points, encoding="utf-8"
    )


def ace_poses(path: Path, error: float = 0.03) -> None:
    """Write poses of `cambridge`'s test photos, a little off, as ACE and GS-CPR publish them."""
    lines = []
    for i, view in enumerate(POSES[6:], 6):
        q, t = quaternion(view[:3, :3]), view[:3, 3] + error
        numbers = " ".join(str(v) for v in (*q, *t, 0.2, 0.03))
        lines.append(f"seq2_frame{i:05d}.png {numbers} 1652\n")
    path.write_text("".join(lines))
