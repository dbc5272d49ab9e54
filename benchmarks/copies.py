"""Tile a .ply scene to test large sizes: `python benchmarks/copies.py IN.ply OUT.ply 6 4`.

The numbers are copies along the scene's longest and second longest side (0.5th to 99.5th percentile).
Supports binary little-endian files of float32 only.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np


def main(source: str, target: str, along: int, across: int) -> None:
    header, end = bytearray(), b"end_header\n"
    with Path(source).open("rb") as file:
        while not header.endswith(end):
            header += file.readline()
    lines = header.decode("ascii").splitlines()
    count = int(next(line.split()[2] for line in lines if line.startswith("element vertex")))
    width = sum(line.startswith("property float ") for line in lines)
    rows = np.memmap(source, np.float32, "r", len(header), (count, width))
    low, high = np.percentile(rows[::100, :3], (0.5, 99.5), axis=0)
    second, first = np.argsort(low - high)[:2]
    moved = header.replace(
        b"element vertex %d" % count, b"element vertex %d" % (count * along * across)
    )
    with Path(target).open("wb") as file:
        file.write(moved)
        for i in range(along):
            for j in range(across):
                copy = rows.copy()
                copy[:, first] += np.float32(i * (high - low)[first])
                copy[:, second] += np.float32(j * (high - low)[second])
                file.write(copy.tobytes())


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
