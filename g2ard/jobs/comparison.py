"""Common views, targets and size in which several runs are scored."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from g2ard.errors import InputError
from g2ard.io.detect import run_background, run_scene, run_views
from g2ard.io.jsonfile import read_json
from g2ard.io.paths import real_path
from g2ard.io.source import Source
from g2ard.io.types import ViewSet
from g2ard.jobs.inputs import Views, load_split_views
from g2ard.rendering.targets import RENDERS, Targets, scored_in
from g2ard.report.labels import DENSE, RESULT
from g2ard.scene.cameras import Camera, Cameras
from g2ard.stages.evaluate import Evaluation

_EQUAL = 0.05
"""Difference in dB below which two results are equally good."""
_POSE_DIGITS = 6
"""Decimals to which equal views have equal poses."""


@dataclass(frozen=True, eq=False)
class Common:
    """Source of the scores of a run, as its report states it, or of several runs.

    Args:
        path: folder of the run, or of the first one.
        views: that folder; of several runs, views of split `test` at one size that none trained on.
        teacher: the scene to render; None if all targets are photos.
        photos: use photos where views have them.
        size: longer side, for a single run.
    """

    path: Path
    views: Views
    teacher: Path | None
    photos: bool
    size: int | None

    @classmethod
    def of(cls, path: Path) -> Common:
        """Read the source of a run's own scores."""
        report = read_json(path / "report.json")
        against = report.get("against", RENDERS)
        config = report["config"]
        teacher = None if against == "photos" else Path(config["scene"])
        return cls(path, path, teacher, teacher is not None and "photo" in against, config["size"])

    def check_same(self, other: Common, *, background: bool) -> None:
        """Raise an `InputError` unless both runs can have the same targets."""
        told = {
            run: "photos" if run.teacher is None else f"renders of {run.teacher}"
            for run in (self, other)
        }
        places = [None if run.teacher is None else real_path(run.teacher) for run in (self, other)]
        if places[0] != places[1]:
            raise InputError(
                f"was scored against {told[other]}, and {self.path} against {told[self]}; their scores "
                "cannot be compared",
                path=other.path,
                hint="give {views} and {teacher=SCENE} of the scene that both show",
            )
        if not background and run_background(self.path) != run_background(other.path):
            raise InputError(
                f"has another background than {self.path}",
                path=other.path,
                hint="give {background=COLOUR}",
            )

    def each_view(self) -> Iterator[tuple[Camera, str]]:
        """Yield each view of a run with its split; the scored ones also from scored.json."""
        for place in (run_views(self.path), self.path / "scored.json"):
            if place.is_file():
                found, _ = load_split_views(place, "all", unpictured=self.teacher is not None)
                yield from zip(
                    found.cameras, (split or "train" for split in found.splits), strict=True
                )


def is_run(path: Path) -> bool:
    """Return whether a path is the folder of a finished run with its views."""
    return run_scene(path) != path and run_views(path) != path


def find_source(path: Path) -> Path | None:
    """Return the real path of the dense scene of a run, or None."""
    config = read_json(path / "report.json").get("config", {}) if is_run(path) else {}
    scene = config.get("scene")
    return None if scene is None else real_path(Path(scene))


def is_made_of_points(path: Path, opened: Source | None = None) -> bool:
    """Return whether a scene is a point cloud, or was made of one: a run's result, or its scene file.

    Args:
        opened: the source of `path`, if there is one.
    """
    dense = find_source(path if path.is_dir() else path.parent)
    if dense is None:
        return path.exists() and (opened or Source(path)).kind == "points"
    return dense.exists() and Source(dense).kind == "points"


def put_dense_first(first: Path, second: Path) -> tuple[list[Path], tuple[str, ...]]:
    """Return two scenes, the dense one before a run's result, with their roles; others as given, without."""
    for dense, result in ((first, second), (second, first)):
        if find_source(result) == real_path(dense):
            return [dense, result], (DENSE, RESULT)
    return [first, second], ()


def find_common(paths: Sequence[Path], *, background: bool = False) -> Common | None:
    """Return the views and targets in which the results of all runs among `paths` can be scored.

    They are those of a single run. Several runs share the views that one of them held out and none trained
    on, at the size of the largest. The order of the runs has no effect. None without a run.

    Args:
        background: whether the user gave the background, so that runs with different ones are accepted.

    Raises:
        InputError: the runs show different scenes, or have no such view in common.
    """
    folders = sorted({real_path(path): path for path in paths if is_run(path)}.items())
    runs = [Common.of(path) for _, path in folders]
    if not runs:
        return None
    first, *others = runs
    for other in others:
        first.check_same(other, background=background)
    if first.teacher is not None and not first.teacher.exists():
        raise InputError(
            f"was made from {first.teacher}, which is not there",
            path=first.path,
            hint="give {teacher=SCENE}",
        )
    if not others:
        return first
    views = _find_common_views(runs, first.teacher is not None and not first.photos)
    return replace(first, views=ViewSet(views, splits=("test",) * len(views)), size=None)


_Key = tuple[object, ...]


def _identify_view(view: Camera) -> _Key:
    """Return what equal views of different runs have in common: the photo, otherwise pose and lens."""
    if view.image_path is not None:
        return (real_path(view.image_path),)
    lens = np.array([view.K[0] / view.width, view.K[1] / view.height]).round(_POSE_DIGITS)
    return (
        *(view.viewmat.round(_POSE_DIGITS) + 0.0).ravel().tolist(),
        *(lens + 0.0).ravel().tolist(),
    )


def _find_common_views(runs: Sequence[Common], rendered: bool) -> Cameras:
    """Return the views that a run held out and none trained on, at one size."""
    held_out: dict[_Key, Camera] = {}
    trained: set[_Key] = set()
    seen: list[dict[_Key, Camera]] = []
    for run in runs:
        own: dict[_Key, Camera] = {}
        for view, split in run.each_view():
            key = _identify_view(view)
            own[key] = view
            if split != "test":
                trained.add(key)
            elif key not in held_out or view.width > held_out[key].width:
                held_out[key] = view
        seen.append(own)
    if not rendered:
        for run, own in zip(runs[1:], seen[1:], strict=True):
            _check_same_photos(runs[0].path, seen[0], run.path, own)
    left = {key: view for key, view in held_out.items() if key not in trained}
    if not left:
        names = ", ".join(str(run.path) for run in runs)
        raise InputError(
            f"every view that one of the runs holds out trained another ({names})",
            hint="give {views} that none trained on",
        )
    sides = [max(view.width, view.height) for view in left.values()]
    ordered = [
        left[key] for key in sorted(left, key=lambda key: (left[key].name, tuple(map(str, key))))
    ]
    cameras = Cameras.of(_number_names(ordered))
    return cameras.scaled(max(sides)) if rendered else cameras.resized(min(sides))


def _check_same_photos(
    first: Path, own: dict[_Key, Camera], second: Path, other: dict[_Key, Camera]
) -> None:
    """Raise an `InputError` unless two runs share photos, with the same poses."""
    shared = own.keys() & other.keys()
    if not shared:
        raise InputError(
            f"shares no photo with {first}; their scores cannot be compared",
            path=second,
            hint="give {views} with photos of the scene that both show",
        )
    moved = sorted(
        own[key].name
        for key in shared
        if not np.allclose(own[key].viewmat, other[key].viewmat, atol=1e-4)
    )
    if moved:
        raise InputError(f"has another pose of photo {moved[0]} than {first}", path=second)


def _number_names(views: Sequence[Camera]) -> list[Camera]:
    """Number views of the same name."""
    names = Counter(view.name for view in views)
    used: Counter[str] = Counter()
    found = []
    for view in views:
        used[view.name] += 1
        again = f" ({used[view.name]})" if names[view.name] > 1 else ""
        found.append(replace(view, name=view.name + again))
    return found


def describe_better(
    names: Sequence[str], scores: Sequence[Evaluation], targets: Targets, split: str
) -> str | None:
    """Say which of several scenes scores best, and by how much; None for a single one.

    >>> from g2ard.rendering.targets import Photos
    >>> views = Cameras.of([Camera.facing([0, -3, 0], [0, 0, 0], width=64, height=48)])
    >>> photos = Photos(views, [np.zeros((48, 64, 3), np.uint8)])
    >>> from types import SimpleNamespace as Score
    >>> describe_better("AB", [Score(psnr=30.0, ssim=0.9), Score(psnr=33.3, ssim=0.8)], photos, "test")
    'B is better: +3.3 dB in 1 test photo, 64×48 px, though A has the better SSIM (0.9000, 0.8000)'
    """
    if len(scores) < 2:
        return None
    order = sorted(range(len(scores)), key=lambda i: (-scores[i].psnr, names[i]))
    best, second = order[:2]
    gain = scores[best].psnr - scores[second].psnr
    where = f"in {scored_in(targets, split)}"
    if gain < _EQUAL:
        return f"{names[best]} and {names[second]} are equal within {_EQUAL} dB {where}"
    what = "better" if len(scores) == 2 else "best"
    over = "" if len(scores) == 2 else f" over {names[second]}"
    likest = max(order, key=lambda i: scores[i].ssim)
    line = f"{names[best]} is {what}: +{gain:.1f} dB{over} {where}"
    if likest != best and round(scores[likest].ssim, 4) > round(scores[best].ssim, 4):
        line += (
            f", though {names[likest]} has the better SSIM ({scores[likest].ssim:.4f}, "
            f"{scores[best].ssim:.4f})"
        )
    return line
