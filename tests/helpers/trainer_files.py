"""Cameras in the formats of INRIA's trainer, nerfstudio and gsplat."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from helpers.view_files import orbit, transforms

POSES = orbit(10)


# INRIA


def inria(path: Path, viewmats: list[np.ndarray] = POSES, **extra: Any) -> Path:
    """Write cameras as 3DGS does: test cameras first, ids in that order, rows of world_from_camera."""
    order = [*range(0, len(viewmats), 8), *(i for i in range(len(viewmats)) if i % 8)]
    cameras = []
    for number, i in enumerate(order):
        world = np.linalg.inv(viewmats[i])
        camera = {
            "id": number,
            "img_name": f"{i:03d}",
            "width": 80,
            "height": 61,
            "position": world[:3, 3].tolist(),
            "rotation": [row.tolist() for row in world[:3, :3]],
            "fy": 71.0,
            "fx": 70.0,
        }
        cameras.append(camera | extra)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(cameras))
    return path


# nerfstudio

T = np.eye(4)
"""A transform like nerfstudio's auto-orienting and centring."""


A = np.array([[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1.0]])


SCALE, APPLIED = 0.2, 1.5


CONFIG = """!!python/object:nerfstudio.engine.trainer.TrainerConfig
_target: &id001 !!python/name:nerfstudio.engine.trainer.Trainer ''
data: {data}
method_name: splatfacto
pipeline: !!python/object:nerfstudio.pipelines.base_pipeline.VanillaPipelineConfig
  _target: !!python/name:nerfstudio.pipelines.base_pipeline.VanillaPipeline ''
  datamanager: !!python/object:nerfstudio.data.datamanagers.full_images_datamanager.FullImageDatamanagerConfig
    data: {manager}
    dataparser: !!python/object:nerfstudio.data.dataparsers.parser.{parser}DataParserConfig
      auto_scale_poses: true
      colmap_path: !!python/object/apply:pathlib.PosixPath
      - colmap
      - sparse
      - '0'
      data: !!python/object/apply:pathlib.PosixPath []
      eval_interval: 4
      eval_mode: {mode}
      images_path: !!python/object/apply:pathlib.PosixPath
      - images
      train_split_fraction: 0.9
    eval_image_indices: !!python/tuple
    - 0
  model: !!python/object:nerfstudio.models.splatfacto.SplatfactoModelConfig
    camera_optimizer: !!python/object:nerfstudio.cameras.camera_optimizers.CameraOptimizerConfig
      mode: {optimizer}
timestamp: 2024-01-01_000000
"""


DATA = "&id003 !!python/object/apply:pathlib.PosixPath\n- data\n- poster"


def run_of(
    folder: Path,
    *,
    parser: str = "Nerfstudio",
    mode: str = "fraction",
    optimizer: str = "'off'",
    data: str = DATA,
    manager: str = "*id003",
) -> Path:
    """outputs/…, trained from folder/data/poster."""
    run = folder / "outputs" / "poster" / "splatfacto" / "today"
    run.mkdir(parents=True)
    settings = CONFIG.format(
        data=data, manager=manager, parser=parser, mode=mode, optimizer=optimizer
    )
    (run / "config.yml").write_text(settings)
    transform = (T @ A)[:3].tolist() if parser == "Nerfstudio" else T[:3].tolist()
    scale = SCALE * APPLIED if parser == "Nerfstudio" else SCALE
    (run / "dataparser_transforms.json").write_text(
        json.dumps({"transform": transform, "scale": scale})
    )
    return run


def data_of(folder: Path, **extra: Any) -> Path:
    data = folder / "data" / "poster"
    data.mkdir(parents=True)
    stated = {"applied_transform": A[:3].tolist(), "applied_scale": APPLIED}
    return transforms(data / "transforms.json", POSES, **(stated | extra))


def trained(view: np.ndarray) -> np.ndarray:
    """camera_from_world in the trained world: as nerfstudio moves poses, T·c2w with its centre scaled."""
    world = T @ np.linalg.inv(view)
    world[:3, 3] *= SCALE
    return np.linalg.inv(world)


def export(folder: Path, photos: Path, name: str, rows: range) -> Path:
    """Return a list of 3×4 world_from_camera with OpenGL's axes, as `ns-export cameras` writes it."""
    folder.mkdir(parents=True, exist_ok=True)
    frames = []
    for i in rows:
        world = np.linalg.inv(trained(POSES[i]))
        world[:3, 1:3] *= -1
        frames.append({"file_path": str(photos / f"{i:03d}.png"), "transform": world[:3].tolist()})
    (folder / name).write_text(json.dumps(frames))
    return folder / name


# gsplat

CFG = """batch_size: 1
ckpt: null
data_dir: {data_dir}
data_factor: 2
data_type: colmap
normalize_world_space: {normalize}
pose_opt: {pose_opt}
strategy: !!python/object:gsplat.strategy.default.DefaultStrategy
  absgrad: false
  verbose: true
test_every: 4
"""


def result_of(
    folder: Path, normalize: str = "false", data_dir: str = "data/garden", pose_opt: str = "false"
) -> Path:
    path = folder / "results" / "garden" / "cfg.yml"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(CFG.format(normalize=normalize, data_dir=data_dir, pose_opt=pose_opt))
    return path
