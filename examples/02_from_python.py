"""The same job from Python, stage by stage, on a city small enough to take seconds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from g2ard.stages.evaluate import evaluate
from g2ard.stages.lift import lift
from g2ard.stages.recover import RecoverConfig, recover
from g2ard.stages.recover.anchors import PRESETS
from g2ard.stages.simplify import simplify
from g2ard.synth import City, city
from g2ard.visibility import looker

SKY = (0.6, 0.8, 1.0)


class CityPhotos:
    """A target is anything with `cameras` and an image for each; see also g2ard.targets."""

    def __init__(self, town: City, split: str) -> None:
        self.cameras = town.views[split]
        self._photos = [town.photo(self.cameras, i) for i in range(len(self.cameras))]

    def __getitem__(self, view: int) -> NDArray[np.float32]:
        return self._photos[view]


def main() -> tuple[float, float]:
    """PSNR on unseen views before and after recovery."""
    town = city(points=40_000, views=24, size=(160, 120), blocks=1)
    scan = town.points()
    prior = lift(scan.positions, scan.colors)  # every point becomes a disc on its surface

    # Ten times fewer; errors weigh by what the views see of them.
    small = simplify(prior, budget=len(prior) // 10, visibility=looker(town.views["train"]))
    print(f"{len(prior):,} discs → {len(small.splats):,} Gaussians")

    train, unseen = CityPhotos(town, "train"), CityPhotos(town, "val")
    config = RecoverConfig(steps=200, regularizers=PRESETS["lift"], sh_degree=1, background=SKY)
    better = recover(small.splats, train, config)

    before = evaluate(small.splats, unseen, background=SKY).psnr
    after = evaluate(better.splats, unseen, background=SKY).psnr
    print(f"unseen views: {before:.2f} dB → {after:.2f} dB in {better.report['seconds']:.1f} s")
    return before, after


if __name__ == "__main__":
    main()
