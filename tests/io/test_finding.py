"""Names of photos and masks in every spelling, whatever else lies beside them."""

import json
import os
import struct
import unicodedata
from pathlib import Path

import numpy as np
import pytest

from g2ard.io.finding import _CODE_PAGES, _MASKS, _MASKS_BESIDE, Finder, files_in, photos_in
from g2ard.io.splits import splits_of
from g2ard.io.views import read_view_set
from helpers.view_files import colmap, edit, orbit, photo, transforms

JUNK = ["._{}", ".DS_Store", "Thumbs.db", "desktop.ini"]
NAMES = [f"photo {i}.png" for i in range(4)]


def named(folder: Path, names: list[str]) -> Path:
    """Write a transforms.json of four frames of these names."""
    path = transforms(folder / "transforms.json", orbit(4))

    def rename(content: dict) -> None:
        for frame, name in zip(content["frames"], names, strict=True):
            frame["file_path"] = name

    edit(path, rename)
    return path


@pytest.mark.parametrize("junk", [*JUNK, "empty"])
def test_what_systems_leave_and_empty_files_are_ignored(tmp_path: Path, junk: str) -> None:
    photo(tmp_path / "1.png")
    (tmp_path / junk.format("1.png")).write_bytes(b"" if junk == "empty" else b"\0\5\26\7")
    assert [file.name for file in files_in(tmp_path)] == ["1.png"]
    assert Finder(tmp_path).find(junk.format("1.png")) is None


@pytest.mark.parametrize("form", ["NFC", "NFD"])
@pytest.mark.parametrize("folder", ["images", "Fotos Küche"])
def test_unicode_forms_of_names_and_folders(tmp_path: Path, form: str, folder: str) -> None:
    other = "NFD" if form == "NFC" else "NFC"
    names = [f"{folder}/Größe é {i}.png" for i in range(4)]
    path = named(tmp_path, [unicodedata.normalize(form, name) for name in names])
    for name in names:
        photo(tmp_path / unicodedata.normalize(other, name).upper().replace("PNG", "png"))
    assert None not in read_view_set(path).cameras.image_paths


@pytest.mark.parametrize("page", [page for page in _CODE_PAGES if page not in ("cp1251", "cp437")])
@pytest.mark.parametrize("text", [False, True])
def test_names_in_code_pages(tmp_path: Path, page: str, text: bool) -> None:
    word = {"cp949": "한국", "cp932": "日本", "gbk": "中国", "big5": "臺灣"}.get(page, "Küche")
    colmap(tmp_path, orbit(4), text)
    table = tmp_path / "sparse" / "0" / f"images.{'txt' if text else 'bin'}"
    table.write_bytes(table.read_bytes().replace(b"photo", word.encode(page)))
    for name in NAMES:
        photo(tmp_path / "images" / name.replace("photo", word))
    found = read_view_set(tmp_path)
    assert None not in found.cameras.image_paths
    assert [name.partition(" ")[0] for name in found.cameras.names] == [word] * 4
    assert "other_spelling" in {note.code for note in found.notes}


@pytest.mark.parametrize("page", ["cp949", "cp437"])
def test_files_unpacked_in_another_character_set(tmp_path: Path, page: str) -> None:
    """The table is right; an archive's names were taken for another character set, or kept as bytes."""
    word = "한국" if page == "cp949" else "Küche"
    path = named(tmp_path, [f"{word}_{i}.png" for i in range(4)])
    for i in range(4):
        raw = f"{word}_{i}.png".encode("utf-8" if page != "cp949" else page)
        photo(tmp_path / (os.fsdecode(raw) if page == "cp949" else raw.decode(page)))
    assert None not in read_view_set(path).cameras.image_paths


def test_names_that_nothing_matches_can_be_printed(tmp_path: Path) -> None:
    colmap(tmp_path, orbit(4), text=False)
    table = tmp_path / "sparse" / "0" / "images.bin"
    table.write_bytes(table.read_bytes().replace(b"photo", b"\xc7\xd1\xff"))
    assert read_view_set(tmp_path).cameras.names[0].encode().startswith(b"\\xc7\\xd1\\xff")


@pytest.mark.parametrize(
    ("beside", "spelling"),
    [(False, name) for name in _MASKS] + [(True, name) for name in _MASKS_BESIDE],
)
@pytest.mark.parametrize("suffix", [".png", ".jpg", ".PNG"])
def test_masks_in_every_spelling(tmp_path: Path, beside: bool, spelling: str, suffix: str) -> None:
    path = named(tmp_path, [f"images/{i}.jpg" for i in range(4)])
    for i in range(4):
        photo(tmp_path / "images" / f"{i}.jpg")
        name = spelling.format(name=f"{i}.jpg", stem=i) + suffix
        photo(tmp_path / ("images" if beside else "masks") / name)
    masks = read_view_set(path).cameras.mask_paths
    assert all(mask is not None and mask.is_file() for mask in masks)
    assert [p.name for p in photos_in(tmp_path / "images")] == [f"{i}.jpg" for i in range(4)]


@pytest.mark.parametrize("place", ["", "photos", "input"])
def test_photos_are_found_in_the_project(tmp_path: Path, place: str) -> None:
    colmap(tmp_path, orbit(4), text=True)
    for name in NAMES:
        photo(tmp_path / place / name)
    for path in (tmp_path, tmp_path / "sparse" / "0"):
        found = read_view_set(path)
        assert None not in found.cameras.image_paths
        assert "photos_elsewhere" in {note.code for note in found.notes}


def test_views_take_the_size_of_their_photos(tmp_path: Path) -> None:
    colmap(tmp_path, orbit(4), text=True)
    whole = read_view_set(tmp_path).cameras
    width, height = int(whole.widths[0]), int(whole.heights[0])
    for i, name in enumerate(NAMES):
        # the last is another photo
        size = (width // 2, height // 2) if i < 3 else (width, height * 2)
        photo(tmp_path / "images" / name, size)
    found = read_view_set(tmp_path)
    assert found.cameras.widths.tolist() == [width // 2] * 3 + [width]
    np.testing.assert_allclose(found.cameras.Ks[:3, :2], whole.Ks[:3, :2] / 2)
    assert [note.count for note in found.notes if note.code == "other_size"] == [3]


@pytest.mark.parametrize("place", ["", "sparse/0"])
@pytest.mark.parametrize(("file", "split"), [("test.txt", "test"), ("train.txt", "train")])
@pytest.mark.parametrize("suffix", ["", ".png"])
def test_lists_of_a_split(tmp_path: Path, place: str, file: str, split: str, suffix: str) -> None:
    colmap(tmp_path, orbit(4), text=True)
    (tmp_path / place / file).write_text(
        f"\ufeffphoto 1{suffix}\r\n\r\nphoto 2{suffix}\r\n", encoding="utf-8"
    )
    other = "train" if split == "test" else "test"
    for path in (tmp_path, tmp_path / "sparse" / "0"):
        if place or path == tmp_path:
            assert splits_of(path, NAMES) == (other, split, split, other)
    (tmp_path / place / file).write_text("other.png\n")
    assert splits_of(tmp_path, NAMES) == splits_of(None, NAMES)


def test_poses_of_rigs_win_over_stale_ones(tmp_path: Path) -> None:
    colmap(tmp_path, orbit(4), text=True)
    model = tmp_path / "sparse" / "0"
    (model / "rigs.txt").write_text("1 1 CAMERA 7\n")
    right = read_view_set(tmp_path).cameras.viewmats[1]
    (model / "frames.txt").write_text("2 1 1 0 0 0 7 8 9 1 CAMERA 7 2\n")
    found = read_view_set(tmp_path)
    assert found.cameras.viewmats[1][:3, 3].tolist() == [7, 8, 9]
    assert right[:3, 3].tolist() != [7, 8, 9]
    assert [note.count for note in found.notes if note.code == "stale_poses"] == [1]


@pytest.mark.parametrize("value", ["-nan(ind)", "1.#IND", "nan", "-inf", "-1.#INF"])
def test_observations_that_are_not_numbers(tmp_path: Path, value: str) -> None:
    colmap(tmp_path, orbit(4), text=True)
    table = tmp_path / "sparse" / "0" / "images.txt"
    lines = [
        line for line in table.read_text().splitlines() if line.strip() and not line.startswith("#")
    ]
    rows = [line for line in lines if line.endswith(".png")]
    table.write_text("".join(f"{row}\n12.5 30.25 17 {value} {value} -1\n" for row in rows))
    assert len(read_view_set(tmp_path).cameras) == 4


def test_doubles_of_polycam(tmp_path: Path) -> None:
    cameras = tmp_path / "keyframes" / "cameras"
    cameras.mkdir(parents=True)
    pose = {f"t_{r}{c}": float(r == c) for r in range(3) for c in range(4)}
    lens = {"fx": 9.0, "fy": 9.0, "cx": 4.0, "cy": 3.0, "width": 8, "height": 6}
    for i in range(3):
        (cameras / f"{i}.json").write_text(json.dumps(pose | lens))
        (cameras / f"._{i}.json").write_bytes(struct.pack(">II", 0x00051607, 0x00020000))
        photo(tmp_path / "keyframes" / "images" / f"{i}.jpg")
    assert len(read_view_set(tmp_path).cameras) == 3


def test_a_folder_with_a_few_of_the_names_holds_other_photos(tmp_path: Path) -> None:
    (tmp_path / "new").mkdir()
    names = [f"{k}.png" for k in range(8)]
    for held in range(1, 9):
        (tmp_path / "new" / names[held - 1]).write_bytes(b"photo")
        found = Finder.among(None, names, [tmp_path / "images"], [tmp_path])
        assert (found.find(names[0]) is not None) == (held >= 4)


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize(
    ("listed", "stored"),
    [
        ("my%20photo%200.png", "my photo 0.png"),
        ("K%C3%BCche%200.png", "K\u00fcche 0.png"),
        ("2024-05-01T12:00:0.png", "2024-05-01T12_00_0.png"),
        ("what? 0.png", "what_ 0.png"),
    ],
)
def test_escapes_of_addresses_and_letters_that_windows_lacks(
    tmp_path: Path, listed: str, stored: str, turned: bool
) -> None:
    listed, stored = (stored, listed) if turned else (listed, stored)
    photo(tmp_path / stored)
    photo(tmp_path / "other.png")
    assert Finder(tmp_path).find(f"images/{listed}") == tmp_path / stored
