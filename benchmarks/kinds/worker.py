"""Process for a stage of a matched cell: `python -m benchmarks.kinds.worker JOB.json`.

A job has a `kind` (reduce, select, recover or adapt), paths of inputs and an `output`. The stage's report is
written to report.json beside the output.
"""

from __future__ import annotations

import json
import math
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard import io
from g2ard.errors import G2ardError
from g2ard.io.atomic import atomic_output
from g2ard.io.images import to_bytes
from g2ard.rendering.targets import CACHE_BYTES, Targets, against_of, mask_of
from g2ard.scene.cameras import Cameras
from g2ard.stages.recover.anchors import Anchors, Regularizers
from g2ard.stages.recover.config import Rates, Schedule

__all__ = ["StoredTargets", "store_targets"]

Job = dict[str, Any]


class StoredTargets:
    """Targets stored for all cells: one .npy per view, photos as bytes."""

    def __init__(self, cameras: Cameras, folder: Path) -> None:
        self.cameras = cameras
        numbers = json.loads((folder / "names.json").read_text(encoding="utf-8"))
        self._paths = [folder / f"{numbers[name]}.npy" for name in cameras.names]
        self.source = f"stored {folder}"
        self._kept: dict[int, NDArray[Any]] = {}
        self._bytes = 0

    def __getitem__(self, view: int) -> NDArray[np.float32]:
        image = self._kept.get(view)
        if image is None:
            image = np.load(self._paths[view])
            if self._bytes + image.nbytes <= CACHE_BYTES:
                self._kept[view] = image
                self._bytes += image.nbytes
        return image.astype(np.float32) / np.float32(255) if image.dtype == np.uint8 else image

    def mask(self, view: int) -> NDArray[np.bool_] | None:
        """Return the mask of a view, or None."""
        path = self._paths[view].with_suffix(".mask.npy")
        return np.load(path) if path.exists() else None


def store_targets(targets: Targets, folder: Path) -> None:
    """Store photos (undistorted, at their views' size) or renders for `StoredTargets`."""
    folder.mkdir(parents=True, exist_ok=True)
    for view in range(len(targets.cameras)):
        image = targets[view]
        np.save(
            folder / f"{view}.npy",
            to_bytes(image) if against_of(targets, view) == "photo" else image,
        )
        mask = mask_of(targets, view)
        if mask is not None:
            np.save(folder / f"{view}.mask.npy", mask)
    numbers = {name: i for i, name in enumerate(targets.cameras.names)}
    (folder / "names.json").write_text(json.dumps(numbers), encoding="utf-8", newline="\n")


def _reduce(job: Job) -> dict[str, Any]:
    from benchmarks import baselines
    from g2ard.rendering.visibility import visibility_source
    from g2ard.stages.simplify import SimplifyConfig, simplify

    splats, cameras = io.read_splats(job["scene"]), _cameras(job["views"])
    output, began = Path(job["output"]), time.monotonic()
    if job["method"] in baselines.METHODS:
        small = baselines.reduce(
            job["method"], splats, job["count"], cameras, seed=job["seed"], indoor=job["indoor"]
        )
        seconds = time.monotonic() - began
        io.write_splats(output, small, overwrite=True)
        return {"count": len(small), "seconds": seconds}
    flags = np.load(job["flags"]) if job.get("flags") else None
    looks = job["method"] in ("default", "fast")
    constants = {} if job["protection"] is None else {"protection": job["protection"]}
    if job["method"] == "paper":
        constants["retention"] = 1e-9  # one reduction; the cell runs rounds
    config = SimplifyConfig(
        "default" if job["method"] == "no-views" else job["method"], **constants
    )
    done = simplify(
        splats,
        job["count"],
        visibility=visibility_source(cameras) if looks else None,
        protected=flags,
        final_budget=job["budget"],
        config=config,
    )
    seconds = time.monotonic() - began
    io.write_splats(output, done.splats, overwrite=True)
    np.save(output.with_name("flags.npy"), done.protected)
    return {"count": len(done.splats), "seconds": seconds}


def _select(job: Job) -> dict[str, Any]:
    from benchmarks.policies import order_views

    cameras = _cameras(job["views"])
    order = order_views(io.read_splats(job["scene"]), cameras, job["policy"], seed=job["seed"])[
        : job["k"]
    ]
    kept = cameras.take(np.sort(order))  # all are training views
    io.write_views(job["output"], kept, splits=["train"] * len(kept), overwrite=True)
    return {"views": len(order)}


def _cameras(path: str) -> Cameras:
    """Read all views of a file of the workspace, with or without photos."""
    return io.read_view_set(path, unpictured=True).cameras


def _targets(job: Job) -> StoredTargets:
    return StoredTargets(_cameras(job["views"]), Path(job["targets"]))


def _recover(job: Job) -> dict[str, Any]:
    from g2ard.stages.recover.config import RecoverConfig
    from g2ard.stages.recover.optimize import recover

    student, targets = io.read_splats(job["scene"]), _targets(job)
    for view in range(len(targets.cameras)):  # load before a time limit starts
        targets[view]
    config = RecoverConfig(
        schedule=_schedule(job["schedule"], targets.cameras),
        steps=job["steps"] if job["seconds"] is None else None,
        recovery_time=job["seconds"],
        regularizers=Regularizers(**job["regularizers"]),
        sh_degree=job["sh_degree"],
        background=tuple(job["background"]),
        final=job["final"],
        engine=job["engine"],
        seed=job["seed"],
    )
    built = io.read_splats(job["anchors"]) if job.get("anchors") else None
    anchors = None if built is None else Anchors.of(built, config.regularizers.in_plane)
    done = recover(student, targets, config, anchors=anchors)
    io.write_splats(job["output"], done.splats, overwrite=True)
    report = done.report.as_dict()
    return {
        key: report[key] for key in ("steps", "seconds", "psnr", "drift95", "needle", "multiplier")
    }


def _adapt(job: Job) -> dict[str, Any]:
    from g2ard.pipeline.adapt import AdaptConfig, adapt

    config = AdaptConfig(
        steps=job["steps"],
        schedule=job["schedule"],
        sh_degree=job["sh_degree"],
        background=tuple(job["background"]),
        seed=job["seed"],
        engine=job["engine"],
    )
    done = adapt(io.read_splats(job["scene"]), _targets(job), config)
    io.write_splats(job["output"], done.splats, overwrite=True)
    report = done.report.as_dict()
    return {key: report[key] for key in ("steps", "seconds", "psnr", "converged")}


def _schedule(name: str, cameras: Cameras) -> Schedule:
    """Return a schedule of recovery, or 3DGS's final training rates, as for fine-tuning."""
    if name != "3dgs":
        return Schedule.named(name)
    positions = cameras.positions
    extent = 1.1 * float(np.linalg.norm(positions - positions.mean(0), axis=1).max())
    return Schedule(
        rates=Rates(
            means=1.6e-6 * extent,
            log_scales=5e-3,
            quats=1e-3,
            logit_opacities=5e-2,
            sh0=2.5e-3,
            shN=1.25e-4,
        ),
        steps=5_000,
        means_in_scales=False,
        final_rate=None,
        multiplier=1.0,
        reach=math.inf,
        momentum=0.9,
    )


_KINDS = {"reduce": _reduce, "select": _select, "recover": _recover, "adapt": _adapt}


def _main(path: Path) -> None:
    job: Job = json.loads(path.read_text(encoding="utf-8"))
    try:
        report = _KINDS[job["kind"]](job)
        with atomic_output(
            Path(job["output"]).with_name("report.json"), overwrite=True
        ) as temporary:
            temporary.write_text(json.dumps(report), encoding="utf-8", newline="\n")
    except (G2ardError, OSError) as error:
        sys.exit(" ".join(str(error).split()))


if __name__ == "__main__":
    _main(Path(sys.argv[1]))
