"""Scenes in blocks are the scenes that the readers give, bit by bit, whatever the blocks."""

import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from g2ard.errors import InputError
from g2ard.io import write_splats
from g2ard.levels import Cut, save_levels
from g2ard.scene.splats import ARRAYS, Splats
from helpers.opened import read_scene, stream_of
from helpers.ply_files import columns, save, scene
from helpers.sog_files import folder, parts


def joined(blocks: list[Splats]) -> Splats:
    return replace(
        blocks[0], **{n: np.concatenate([getattr(b, n) for b in blocks]) for n in ARRAYS}
    )


def written(name: str, degree: int) -> Callable[[Path], Path]:
    def write(to: Path) -> Path:
        write_splats(
            to / name,
            scene(
                700,
                degree,
                offset=(4e5, 5e6, 1) if not name.endswith((".splat", ".spz")) else (0, 0, 0),
            ),
        )
        return to if name == "meta.json" else to / name

    return write


def bad_ply(to: Path) -> Path:
    properties = columns(scene(700, 1)) | {"label": np.zeros(700)}
    properties["opacity"][[0, 3, 699]] = (np.nan, np.inf, np.nan)
    return save(to / "bad.ply", properties)


def double_ply(to: Path) -> Path:
    far = {name: values.astype(np.float64) for name, values in columns(scene(700, 1)).items()}
    far["y"] += 5_427_319.25
    return save(to / "far.ply", far, dtype="f8")


def chunks(to: Path) -> Path:
    for name, count, bands in (("0_0", 10, 1), ("0_2", 0, 0), ("0_10", 7, 3), ("1_0", 4, 0)):
        folder(to / name, parts(count, bands, seed=count))
    return to


def levels(to: Path) -> Path:
    fine = scene(900, 2)
    save_levels(to / "lod", [fine, fine.take(slice(0, 100))], cut=Cut(most=250, least=50))
    return to / "lod"


@pytest.mark.parametrize(
    "make",
    [
        *(
            written(name, degree)
            for name in ("a.ply", "a.compressed.ply", "a.sog")
            for degree in (0, 3)
        ),
        *(written(name, 1) for name in ("meta.json", "a.splat", "a.glb", "a.spz")),
        bad_ply,
        double_ply,
        chunks,
        levels,
    ],
)
def test_blocks_are_the_scene(tmp_path: Path, make: Callable[[Path], Path]) -> None:
    try:
        path = make(tmp_path)
    except ImportError as error:
        pytest.skip(f"what writes this format is not installed: {error}")
    whole = read_scene(path)
    for rows in (64, 256, 300, 10_000):
        stream = stream_of(path)
        assert stream.sh_degree == whole.splats.sh_degree
        np.testing.assert_array_equal(stream.offset, whole.splats.offset)
        positions = np.concatenate(list(stream.positions(rows)))
        blocks = list(stream.blocks(rows))
        assert max(len(block) for block in blocks) <= rows
        assert joined(blocks).fingerprint() == whole.splats.fingerprint()
        assert stream.all_notes() == whole.notes
        assert stream.tally.rows == stream.count == len(positions)
        if not whole.notes:
            np.testing.assert_array_equal(positions, whole.splats.means)

        later = stream_of(path)  # as after an interruption
        rest = list(later.blocks(rows, stream.count - 5))
        lost = stream.tally.dropped - later.tally.dropped
        assert sum(len(block) for block in rest) == 5 - later.tally.dropped
        assert (
            joined(rest).fingerprint()
            == whole.splats.take(slice(stream.count - 5 - lost, None)).fingerprint()
        )

        there = stream  # in another process, unless the file is read whole
        if path.suffix not in (".glb", ".spz"):
            there = pickle.loads(pickle.dumps(stream.absolute()))
        read = {part: [*there.part("blocks", rows, *part)] for part in reversed(stream.parts(rows))}
        assert joined([b for part in stream.parts(rows) for b in read[part]]).fingerprint() == (
            whole.splats.fingerprint()
        )


def test_several_are_one_scene(tmp_path: Path) -> None:
    scenes = [
        scene(300, 1, seed=1, offset=(1000.0, 0, 0)),
        scene(200, 3, seed=2, offset=(1010.0, 0, 2)),
    ]
    paths = [tmp_path / "a.ply", tmp_path / "b.compressed.ply"]
    for path, splats in zip(paths, scenes, strict=True):
        write_splats(path, splats)
    first, second = (read_scene(path).splats for path in paths)
    second = second.recentred(first.offset)
    stream = stream_of(paths)
    assert (stream.count, stream.sh_degree) == (500, 3)
    found = joined(list(stream.blocks(90)))
    for name in ARRAYS:
        both = [getattr(s.with_sh_degree(3), name) for s in (first, second)]
        np.testing.assert_array_equal(getattr(found, name), np.concatenate(both), err_msg=name)
    np.testing.assert_array_equal(np.concatenate(list(stream.positions(77))), found.means)
    rest = joined(list(stream_of(paths).blocks(90, 310)))
    assert rest.fingerprint() == found.take(slice(310, None)).fingerprint()
    with pytest.raises(InputError, match="no scene"):
        stream_of([])


def test_another_time_is_another_source(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    write_splats(path, scene(50))
    first = stream_of(path).identity()
    assert stream_of(path).identity() == first
    content = path.read_bytes()
    path.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    assert stream_of(path).identity() != first
