"""Command for baselines: `python -m benchmarks.baselines METHOD SCENE COUNT OUT.ply [--views VIEWS]`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from benchmarks.baselines import METHODS, reduce
from g2ard import io
from g2ard.errors import G2ardError


def _main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.baselines")
    parser.add_argument("method", choices=METHODS)
    parser.add_argument("scene", type=Path)
    parser.add_argument("count", type=int)
    parser.add_argument("output", type=Path)
    parser.add_argument(
        "--views", type=Path, help="views to train on (only the split train, if the file has splits)"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--indoor", action="store_true")
    given = parser.parse_args()
    try:
        cameras = io.read_views(given.views, split="train") if given.views else None
        scene = io.read_splats(given.scene)
        small = reduce(given.method, scene, given.count, cameras, seed=given.seed, indoor=given.indoor)
        io.write_splats(given.output, small)
    except (G2ardError, OSError) as e:
        sys.exit(f"{given.method}: {e}")


if __name__ == "__main__":
    _main()
