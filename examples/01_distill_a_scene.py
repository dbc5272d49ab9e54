"""Distil a scene ten times smaller and see how good it is.

Takes the real scene playbot (CC-BY-4.0, "PLAYBOT" by Stephane Agullo) where G2ARD_DATA has it, else a small
procedural city: its coloured point cloud is lifted, and its photos are what recovery looks at.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

OUT = Path("demo")


def g2ard(*arguments: str) -> None:
    """Run a command as it would be typed."""
    print(f"\n$ g2ard {' '.join(arguments)}", flush=True)
    subprocess.run([sys.executable, "-m", "g2ard", *arguments], check=True)


def main() -> None:
    OUT.mkdir(exist_ok=True)
    playbot = Path(os.environ.get("G2ARD_DATA", "")) / "playbot" / "0_0"
    if os.environ.get("G2ARD_DATA") and playbot.is_dir():
        # Trained, without photos: a pool of poses is made, and the scene itself is the teacher.
        g2ard(
            "distill",
            str(playbot),
            "--ratio",
            "10",
            "--output",
            str(OUT / "playbot"),
            "--overwrite",
        )
    else:
        # A LiDAR-like cloud has geometry but no appearance: its photos are the targets.
        city = OUT / "city"
        make = [
            "-m",
            "benchmarks",
            "synth",
            "city",
            "--size",
            "480x360",
            "--output",
            str(city),
            "--overwrite",
        ]
        subprocess.run([sys.executable, *make], check=True)
        views = ["--views", str(city / "train.json"), "--held-out", str(city / "val.json")]
        options = ["--ratio", "10", "--background", "0.6,0.8,1", "--overwrite"]  # the sky's colour
        g2ard(
            "distill", str(city / "cloud.ply"), *views, *options, "--output", str(OUT / "city-10x")
        )


if __name__ == "__main__":
    main()
