"""Reader for nerfstudio runs: the cameras of the data, moved into the training world."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np

import g2ard.io.colmap as colmap
import g2ard.io.transforms as transforms
from g2ard.arrays import Float
from g2ard.errors import InputError
from g2ard.io.frames import Frame, Listed, invert_pose, make_rigid
from g2ard.io.jsonfile import Place, Pose, Positive, checked, read_json
from g2ard.io.trainer_yaml import Settings, below, read_settings
from g2ard.io.types import ViewFiles
from g2ard.scene.samples import evenly_spaced

NAME = "dataparser_transforms.json"
"""File beside config.yml with `transform`, 3×4, and `scale`."""
CONFIG = "config.yml"

_PARSERS = ("NerfstudioDataParser", "ColmapDataParser", "BlenderDataParser")
_EYE = np.eye(4)


class _Trained(msgspec.Struct):
    transform: Pose
    scale: Positive


class _Applied(msgspec.Struct):
    applied_transform: Pose | None = None
    applied_scale: Positive = 1.0


def read(views: ViewFiles) -> Listed:
    """Read a run's training and test cameras in the world of the exported scene.

    x_trained = s·(D·A⁻¹·x) with s = scale / applied_scale. D and `scale`, from dataparser_transforms.json,
    start from the original data. A (`applied_transform`) and `applied_scale`, from the data's
    transforms.json, lead from the original data to its poses. For COLMAP data, A = 1.

    `path` is the run's folder or one of its two files. config.yml names the data; without it, the data is a
    transforms.json in the folder.
    """
    path = views.path
    folder = path if path.is_dir() else path.parent
    file = folder / NAME
    place = Place(file)
    trained = checked(read_json(file), _Trained, place)
    D = _affine(trained.transform, place.to("transform"))
    settings = None
    if (folder / CONFIG).is_file():
        settings = read_settings(folder / CONFIG)
    frames, A, applied_scale = _data(replace(views, path=folder), settings)
    scale = trained.scale / applied_scale
    trained_from_saved = make_rigid(D @ np.linalg.inv(A), place.to("transform"))
    found = Listed(file, [_moved(frame, trained_from_saved, scale) for frame in frames])
    mode = _optimized(settings)
    if not mode:
        return found
    text = f"the run optimised its poses ({mode}); these are the poses before training"
    return found.noted("optimised_poses", len(frames), text)


def _data(views: ViewFiles, settings: Settings | None) -> tuple[Sequence[Frame], Float, float]:
    """Return the data's frames, and A and the scale that were applied to them."""
    folder = views.path
    if settings is None:
        if not (folder / "transforms.json").is_file():
            raise InputError(
                f"neither {CONFIG} nor transforms.json, which name the data, exist beside it",
                path=folder / NAME,
            )
        return _saved(replace(views, path=folder / "transforms.json"), None)
    parser, options, data = _parser(folder / CONFIG, settings)
    place = below(folder / CONFIG, data)
    if place is None:
        hint = f"give its transforms.json or COLMAP folder as views, or correct `data` in {CONFIG}"
        raise InputError(f"data {data.as_posix()} does not exist", path=folder / CONFIG, hint=hint)
    if parser == "ColmapDataParser":
        model = place / (options.path("colmap_path") or "colmap/sparse/0")
        photos = views.images or place / (options.path("images_path") or "images")
        files = ViewFiles(model, photos if photos.is_dir() else None)
        return colmap.listed(files).whole(), _EYE, 1.0
    views = replace(views, path=place)
    if parser == "NerfstudioDataParser":
        return _saved(views, options)
    return _saved(views, None)


def _parser(path: Path, settings: Settings) -> tuple[str, Settings, Path]:
    manager = settings.block("pipeline", "datamanager")
    parser = manager and manager[1].block("dataparser")
    if not parser or not manager:
        raise InputError("is missing", path=path, property="pipeline.datamanager.dataparser")
    tag, options = parser
    name = tag.rsplit(".", 1)[-1].removesuffix("Config")
    if name not in _PARSERS:
        text = f"unsupported data parser {name!r}; expected {', '.join(_PARSERS)}"
        raise InputError(text, path=path)
    data = settings.path("data") or manager[1].path("data") or options.path("data")
    if data is None:
        raise InputError("is missing", path=path, property="data")
    return name, options, data


def _saved(views: ViewFiles, options: Settings | None) -> tuple[Sequence[Frame], Float, float]:
    """Return the frames, A and scale of a transforms.json, or of a folder with transforms*.json."""
    data = views.path
    file = data / "transforms.json"
    if not file.is_file():
        file = data
    frames = transforms.listed(replace(views, path=file)).whole()
    if not frames:
        raise InputError("no transforms.json in the run's data", path=data)
    place = Place(file).to("applied_transform")
    applied = _Applied()
    if file.is_file():
        applied = checked(read_json(file), _Applied, Place(file))
    A = _EYE
    if applied.applied_transform is not None:
        A = _affine(applied.applied_transform, place)
    elif options is not None and (file.parent / "colmap" / "sparse" / "0").is_dir():
        raise place.error("is missing, and its default differs between versions of nerfstudio")
    if options is not None and not any(frame.split for frame in frames):
        try:
            frames = _split(frames, options)
        except (ValueError, OverflowError) as error:
            raise InputError(f"invalid split in the run's {CONFIG} ({error})", path=data) from error
    return frames, A, applied.applied_scale


def _split(frames: Sequence[Frame], options: Settings) -> Sequence[Frame]:
    """Assign the run's split by `eval_mode` over sorted photo paths, if views are split at all."""
    count = len(frames)
    mode = options.word("eval_mode")
    photos = [frame.photo or Path(frame.name) for frame in frames]
    order = sorted(range(count), key=photos.__getitem__)
    rank = np.argsort(order)
    if mode == "fraction":
        fraction = float(options.word("train_split_fraction") or 0.9)
        if not 0 <= fraction <= 1:
            raise ValueError(f"train_split_fraction {fraction}")
        many = math.ceil(count * fraction)
        train = np.isin(rank, evenly_spaced(count, many, floor=True))
    elif mode == "interval":
        interval = int(options.word("eval_interval") or 8)
        if interval < 1:
            raise ValueError(f"eval_interval {interval}")
        train = rank % interval != 0
    elif mode == "filename":
        train = np.array(["train" in Path(frame.name).name for frame in frames])
    else:
        return frames
    words = np.where(train, "train", "test").tolist()
    return [frame._replace(split=word) for frame, word in zip(frames, words, strict=True)]


def _optimized(settings: Settings | None) -> str | None:
    optimizer = settings and settings.block("pipeline", "model", "camera_optimizer")
    if not optimizer:
        return None
    mode = optimizer[1].word("mode")
    if mode in ("off", "false"):
        return None
    return mode


def _moved(frame: Frame, transform: Float, scale: float) -> Frame:
    """Move a frame by x → scale·(transform·x); the scale only applies to its centre."""
    world_from_camera = transform @ invert_pose(frame.viewmat)
    world_from_camera[:3, 3] *= scale
    return frame._replace(viewmat=invert_pose(world_from_camera))


def _affine(rows: Pose, place: Place) -> Float:
    """Return a 3×4 or 4×4 list as a (4, 4) rotation and translation."""
    out = np.eye(4)
    out[:3] = rows[:3]
    if not 0.99 < abs(np.linalg.det(out[:3, :3])) < 1.01:
        raise place.error("is not a rotation")
    return out
