"""A folder of point clouds, or several, as one."""

from pathlib import Path

import numpy as np
import pytest

from g2ard.errors import InputError
from g2ard.io import Source, read_splats
from g2ard.io.detect import kind
from g2ard.tiles.ingest import ingest
from helpers.cloud_files import las
from helpers.commands import CommandLine, succeeds


@pytest.fixture
def parts(tmp_path: Path) -> list[Path]:
    rng = np.random.default_rng(0)
    (tmp_path / "survey").mkdir()
    paths = []
    for number in range(3):
        positions = rng.uniform(0, 1, (400, 3)) * (10, 10, 0.1) + (10 * number, 0, 0)
        path = tmp_path / "survey" / f"part_{number}.las"
        paths.append(las(path, positions, rng.integers(0, 65535, (400, 3))))
    return paths


@pytest.mark.parametrize("rows", [(), ("--tile-rows", 500, "--workers", 1)])
def test_a_folder_and_its_files_are_one_cloud(
    rows: tuple[object, ...], parts: list[Path], tmp_path: Path, command_line: CommandLine
) -> None:
    (tmp_path / "survey" / "part_0.lax").write_bytes(b"index")
    ask = ("-n", 100, "--no-views", *rows)
    succeeds(command_line, tmp_path, "simplify", "survey", *ask, "-o", "folder.ply")
    succeeds(command_line, tmp_path, "simplify", *parts, *ask, "-o", "files.ply")
    one, other = (read_splats(tmp_path / name) for name in ("folder.ply", "files.ply"))
    assert len(one) == 100
    assert one.fingerprint() == other.fingerprint()
    assert np.ptp(one.means[:, 0]) > 25


def test_what_a_folder_of_clouds_is(parts: list[Path]) -> None:
    folder = parts[0].parent
    assert kind(folder) == "points"
    assert Source(folder).count == 1200 == Source(parts[0], others=parts[1:]).count
    assert ingest(folder, folder.parent / "tiles", tile_rows=500).count == 1200
    (folder / "photo.jpg").write_bytes(b"\xff\xd8\xff")
    with pytest.raises(InputError, match=r"not a supported folder; give one of its files"):
        kind(folder)
