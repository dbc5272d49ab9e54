"""The same from Python: the whole job in one call, then stage by stage, on a city that takes seconds.

Run it in a checkout, after `pip install .` or `make setup`: python examples/02_from_python.py
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import g2ard

sys.path.append(str(Path(__file__).resolve().parents[1]))  # benchmarks, which are not installed
from benchmarks.synth import City, city

SKY = (0.6, 0.8, 1.0)


class CityPhotos:
    """A target is anything with `cameras` and an image for each; `g2ard.Photos` are such."""

    def __init__(self, town: City, split: str) -> None:
        self.cameras = town.views[split]
        self._photos = [town.photo(self.cameras, i) for i in range(len(self.cameras))]

    def __getitem__(self, view: int) -> NDArray[np.float32]:
        return self._photos[view]


def in_one_call(prior: g2ard.Splats) -> float:
    """A scene without photos is its own teacher: views are made, an eighth of them held out."""
    small = g2ard.distill(prior, ratio=10, steps=100, size=120, background=SKY)
    assert small.held_out is not None
    return g2ard.evaluate(small.splats, small.held_out, background=SKY).psnr


def stage_by_stage(prior: g2ard.Splats, town: City) -> tuple[float, float]:
    """PSNR on unseen photos before and after recovery."""
    # Ten times fewer; errors weigh by what the views see of them.
    small = g2ard.simplify(prior, ratio=10, views=town.views["train"])
    print(f"{small.report.input_count:,} discs → {small.report.output_count:,} Gaussians")

    train, unseen = CityPhotos(town, "train"), CityPhotos(town, "val")
    config = g2ard.RecoverConfig(
        steps=200, regularizers=g2ard.Regularizers.of("lift"), sh_degree=1, background=SKY
    )
    better = g2ard.recover(small.splats, train, config)

    before = g2ard.evaluate(small.splats, unseen, background=SKY).psnr
    after = g2ard.evaluate(better.splats, unseen, background=SKY).psnr
    print(f"unseen photos: {before:.2f} dB → {after:.2f} dB in {better.report.seconds:.1f} s")
    return before, after


def main() -> tuple[float, float]:
    """Both ways."""
    town = city(points=40_000, views=24, size=(160, 120), blocks=1)
    scan = town.points()
    prior = g2ard.lift(scan.positions, scan.colors)  # every point becomes a disc on its surface
    print(f"against its own renders: {in_one_call(prior):.2f} dB")
    return stage_by_stage(prior, town)


if __name__ == "__main__":
    main()
