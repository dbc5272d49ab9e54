"""Projects of photos as people have them: moved, renamed, in folders, in parts, from other systems."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from g2ard.errors import InputError
from g2ard.io import kind, read_views
from g2ard.io.finding import Finder
from g2ard.io.photos import load_mask, load_photo
from g2ard.io.types import ViewFiles
from g2ard.io.views import read_view_set
from g2ard.jobs.start_points import find_sparse_file, read_sparse_points
from helpers.view_files import colmap, edit, orbit, photo, transforms

NAMES = [f"photo {i}.png" for i in range(4)]


def project(folder: Path, text: bool = True, stored: Callable[[str], str] = str) -> Path:
    """Write a COLMAP project of four views with their photos."""
    colmap(folder, orbit(4), text)
    for i, name in enumerate(NAMES):
        photo(folder / "images" / stored(name), red=40 * i)
    return folder


def captured(folder: Path, names: list[str], **top: object) -> Path:
    """Write a transforms.json of four frames of these names."""
    path = transforms(folder / "transforms.json", orbit(4), **top)

    def rename(content: dict) -> None:
        for frame, name in zip(content["frames"], names, strict=True):
            frame["file_path"] = name

    edit(path, rename)
    return path


def codes(path: Path, **options: Path) -> set[str]:
    return {note.code for note in read_view_set(path, **options).notes}


@pytest.mark.parametrize(
    "listed", ["a/1.png", "a\\1.png", "/mnt/x/images/a/1.png", "D:\\x\\images\\a\\1.png"]
)
@pytest.mark.parametrize(
    "stored", ["images/a/1.png", "a/1.png", "images/a/1.JPG", "images/a/1.tiff"]
)
def test_one_order_finds_photos(tmp_path: Path, listed: str, stored: str) -> None:
    photo(tmp_path / "images" / "b" / "1.png")
    path = tmp_path / stored
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"x")
    assert Finder(tmp_path, tmp_path / "images").find(listed) == path


def test_the_order_of_names(tmp_path: Path) -> None:
    """A longer end wins over a nearer folder, and an exact suffix over another one."""
    for name in ("1.png", "images/a/1.png", "images/1.jpg"):
        photo(tmp_path / name)
    finder = Finder(tmp_path, tmp_path / "images")
    assert finder.find("/mnt/a/1.png") == tmp_path / "images" / "a" / "1.png"
    assert finder.find("/mnt/b/1.png") == tmp_path / "1.png"
    assert finder.find("/mnt/b/1.JPG") == tmp_path / "images" / "1.jpg"
    assert finder.find("2.png") is None


@pytest.mark.parametrize("write", ["colmap", "transforms"])
@pytest.mark.parametrize(
    "listed", ["{}", "cam\\{}", "./cam/{}", "/mnt/capture/cam/{}", "C:/capture/cam/{}"]
)
@pytest.mark.parametrize("moved", [False, True])
def test_every_format_uses_it(tmp_path: Path, write: str, listed: str, moved: bool) -> None:
    names = [listed.format(name) for name in NAMES]
    if write == "colmap":
        colmap(tmp_path, orbit(4), text=True)
        images = tmp_path / "sparse" / "0" / "images.txt"
        for plain, name in zip(NAMES, names, strict=True):
            images.write_text(images.read_text().replace(plain, name))
    else:
        captured(tmp_path, names)
    place = tmp_path / ("moved" if moved else "images")
    for name in NAMES:
        photo(place / ("cam" if "cam/" in listed or "cam\\" in listed else "") / name)
    found = read_views(tmp_path, images=place if moved else None)
    assert [p and p.name for p in found.image_paths] == NAMES
    assert all(p and p.is_file() for p in found.image_paths)


def test_equal_names_in_folders_are_not_mixed_up(tmp_path: Path) -> None:
    path = captured(
        tmp_path, ["images/a/0.png", "images/b/0.png", "images/a/1.png", "images/b/1.png"]
    )
    for name in ("0.png", "1.png"):
        photo(tmp_path / "flat" / name)
    assert "equal_names" in codes(path, images=tmp_path / "flat")
    for folder in "ab":
        for name in ("0.png", "1.png"):
            photo(tmp_path / "deep" / folder / name)
    found = read_views(path, images=tmp_path / "deep")
    assert len({p for p in found.image_paths if p}) == 4


@pytest.mark.parametrize("suffix", [".jpg", ".JPEG", ".webp", ".tif", ".PNG"])
def test_photos_converted_later_are_found_with_a_note(tmp_path: Path, suffix: str) -> None:
    folder = project(tmp_path, stored=lambda name: name.replace(".png", suffix))
    assert all(p and p.suffix == suffix for p in read_views(folder).image_paths)
    assert ("other_suffix" in codes(folder)) == (suffix != ".PNG")


@pytest.mark.parametrize(
    "place", ["masks/{0}", "masks/{0}.png", "mask/{1}.png", "images/masks/cam/{0}"]
)
@pytest.mark.parametrize("deep", [False, True])
def test_masks_are_found_in_folders(tmp_path: Path, place: str, deep: bool) -> None:
    names = [f"images/{'cam/x/' * deep}{i}.jpg" for i in range(4)]
    if place.startswith("images"):
        names = [f"images/cam/{i}.jpg" for i in range(4)]
        place = "images/masks/{0}"
    path = captured(tmp_path, names, w=8, h=6)
    for i, name in enumerate(names):
        photo(tmp_path / name)
        own = Path(name).relative_to("images" if not place.startswith("images") else "images/cam")
        Image.new("L", (8, 6), 255 * (i % 2)).save(
            _made(tmp_path / place.format(own, own.with_suffix(""))), "PNG"
        )
    masks = [load_mask(read_views(path), i) for i in range(4)]
    assert [mask is not None and bool(mask.all()) for mask in masks] == [False, True, False, True]


def test_masks_of_other_names_are_told(tmp_path: Path) -> None:
    photo(project(tmp_path) / "masks" / "frame_0.png")
    assert "unused_masks" in codes(tmp_path)


def test_a_mask_is_never_its_photo(tmp_path: Path) -> None:
    path = captured(tmp_path, [f"{i}.png" for i in range(4)])
    edit(path, lambda content: content["frames"][2].update(mask_path="masks/2.png"))
    for i in range(4):
        photo(tmp_path / f"{i}.png")
    with pytest.raises(InputError, match="does not exist") as caught:
        read_views(path)
    assert (caught.value.property, caught.value.index) == ("mask_path", 2)


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize(
    ("place", "found"),
    [
        *(
            (place, True)
            for place in ("sparse/1", "sparse", "colmap/sparse/3", "colmap/sparse", "7")
        ),
        *((place, False) for place in ("dense/sparse", "model", "sparse/geo", "out/colmap/sparse")),
    ],
)
def test_models_elsewhere_are_read_or_named(
    tmp_path: Path, text: bool, place: str, found: bool
) -> None:
    project(tmp_path, text)
    (tmp_path / "sparse" / "0").rename(tmp_path / "kept")
    shutil.rmtree(tmp_path / "sparse")
    (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / "kept").rename(tmp_path / place)
    if found:
        assert len(read_views(tmp_path)) == 4
        assert read_sparse_points(find_sparse_file(tmp_path)) is not None
        return
    with pytest.raises(InputError) as caught:
        read_views(tmp_path)
    assert f"give {tmp_path / place}" in str(caught.value)
    assert sum(p is not None for p in read_views(tmp_path / place).image_paths) == 4


@pytest.mark.parametrize("text", [False, True])
def test_tables_in_capitals_are_read(tmp_path: Path, text: bool) -> None:
    project(tmp_path, text)
    for file in list((tmp_path / "sparse" / "0").iterdir()):
        file.rename(file.with_name(file.name.capitalize()))
    assert len(read_views(tmp_path)) == 4
    assert kind(tmp_path / "sparse" / "0" / f"Cameras.{'txt' if text else 'bin'}") == "views"
    assert read_sparse_points(find_sparse_file(tmp_path)) is not None


@pytest.mark.parametrize(("small", "large"), [("0", "1"), ("1", "0"), ("2", "10")])
@pytest.mark.parametrize("text", [False, True])
def test_the_largest_of_several_models_is_read(
    tmp_path: Path, small: str, large: str, text: bool
) -> None:
    project(tmp_path, text)
    (tmp_path / "sparse" / "0").rename(tmp_path / "sparse" / "large")
    colmap(tmp_path / "part", orbit(2), text)
    (tmp_path / "part" / "sparse" / "0").rename(tmp_path / "sparse" / small)
    (tmp_path / "sparse" / "large").rename(tmp_path / "sparse" / large)
    found = read_view_set(tmp_path)
    assert len(found.cameras) == 4
    assert any(note.code == "other_models" for note in found.notes)
    chosen = read_view_set(tmp_path / "sparse" / small)
    assert len(chosen.cameras) == 2
    assert any(large in str(note) and "4 images" in str(note) for note in chosen.notes)


@pytest.mark.parametrize("points", ["", "1.5 2.5 -1", "1.5 2.5 -1 3.5 4.5 7 0 0 12"])
@pytest.mark.parametrize(
    "kept", [lambda i: False, lambda i: i % 2, lambda i: i != 3, lambda i: True]
)
def test_images_txt_with_and_without_lines_of_points(
    tmp_path: Path, kept: Callable[[int], bool], points: str
) -> None:
    project(tmp_path)
    file = tmp_path / "sparse" / "0" / "images.txt"
    lines = [points if i % 2 else line for i, line in enumerate(file.read_text().splitlines()[1:])]
    file.write_text("".join(f"{line}\n" for i, line in enumerate(lines) if not i % 2 or kept(i)))
    assert read_views(tmp_path).names == tuple(NAMES)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_byte_order_marks(tmp_path: Path, encoding: str) -> None:
    project(tmp_path / "a")
    (tmp_path / "b").mkdir()
    captured(tmp_path / "b", NAMES)
    for file in [*(tmp_path / "a" / "sparse" / "0").iterdir(), tmp_path / "b" / "transforms.json"]:
        if file.suffix in (".txt", ".json"):
            file.write_bytes(file.read_text().replace("\n", "\r\n").encode(encoding))
    assert len(read_views(tmp_path / "a")) == len(read_views(tmp_path / "b")) == 4
    assert len(read_sparse_points(find_sparse_file(tmp_path / "a")) or ()) == 2


@pytest.mark.parametrize(
    "word", ["nan", "-nan(ind)", "NaN", "inf", "-1.#IND", "1.#QNAN", "nan(snan)"]
)
@pytest.mark.parametrize(
    ("table", "column"), [("cameras", 4), ("cameras", 6), ("images", 2), ("images", 7)]
)
def test_numbers_that_are_not_finite_cost_their_views(
    tmp_path: Path, word: str, table: str, column: int
) -> None:
    project(tmp_path)
    file = tmp_path / "sparse" / "0" / f"{table}.txt"
    if table == "cameras":
        file.write_text(file.read_text() + "8 PINHOLE 8 6 500 500 4 3\n")
        images = file.with_name("images.txt")
        images.write_text(images.read_text().replace("7 photo 2", "8 photo 2"))
    lines = file.read_text().splitlines()
    at = next(
        i for i, line in enumerate(lines) if line.startswith("8 " if table == "cameras" else "3 ")
    )
    words = lines[at].split(" ")
    lines[at] = " ".join([*words[:column], word, *words[column + 1 :]])
    file.write_text("\n".join(lines) + "\n")
    found = read_view_set(tmp_path)
    assert found.cameras.names == ("photo 0.png", "photo 1.png", "photo 3.png")
    (note,) = [note for note in found.notes if note.code == "not_finite"]
    assert file.name in str(note)
    assert "photo 2.png" in str(note)
    assert note.count == 1


@pytest.mark.parametrize("key", ["fl_x", "k1", "transform_matrix"])
def test_frames_that_are_not_finite_are_left_out(tmp_path: Path, key: str) -> None:
    path = captured(tmp_path, NAMES)

    def spoil(content: dict) -> None:
        frame = content["frames"][1]
        if key == "transform_matrix":
            frame[key][0][3] = float("nan")
        else:
            frame[key] = float("inf")

    edit(path, spoil)
    found = read_view_set(path)
    assert found.cameras.names == (NAMES[0], *NAMES[2:])
    assert any(note.code == "not_finite" and key in str(note) for note in found.notes)
    edit(path, lambda content: content.update(frames=content["frames"][1:2]))
    with pytest.raises(InputError) as caught:
        read_views(path)
    assert caught.value.index == 0


@pytest.mark.parametrize(
    ("key", "split"), [("test_frames", "test"), ("eval_frames", "test"), ("val_frames", "val")]
)
def test_frames_apart_are_held_out(tmp_path: Path, key: str, split: str) -> None:
    path = captured(tmp_path, NAMES)
    edit(path, lambda content: content.update({key: [content["frames"].pop()]}))
    assert read_views(path, split=split).names == ("photo 3.png",)
    assert len(read_views(path, split="train")) == 3


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("upright", [False, True])
def test_exif_turns_photos_where_only_that_fits(
    tmp_path: Path, orientation: int, upright: bool
) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (6, 8, 3), dtype=np.uint8)
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(pixels).save(_made(tmp_path / "images" / "0.png"), exif=exif)
    across = orientation > 4 and upright
    size = {"w": 6, "h": 8} if across else {"w": 8, "h": 6}
    path = transforms(tmp_path / "a.json", orbit(1), **size)
    edit(path, lambda content: content["frames"][0].update(file_path="images/0.png"))
    image = load_photo(read_views(path), 0)[0]
    turns = {
        5: pixels.swapaxes(0, 1),
        6: np.rot90(pixels, -1),
        7: np.rot90(pixels, 2).swapaxes(0, 1),
        8: np.rot90(pixels),
    }
    np.testing.assert_allclose(image * 255, turns[orientation] if across else pixels, atol=1e-3)
    assert ("exif_orientation" in codes(path)) == (orientation > 1)


UNREADABLE = {
    "HEIC": (".HEIC", b"\0\0\0\x18ftypheic\0\0\0\0mif1heic"),
    "HEIC in a .jpg": (".jpg", b"\0\0\0\x18ftypmif1\0\0\0\0mif1heic"),
    "OpenEXR": (".exr", b"v/1\x01\2\0\0\0"),
    "raw": (".CR2", b"II*\0"),
    "Git LFS": (".png", b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n"),
}


@pytest.mark.parametrize("what", UNREADABLE)
def test_photos_that_cannot_be_read_are_named_at_once(tmp_path: Path, what: str) -> None:
    suffix, content = UNREADABLE[what]
    path = captured(tmp_path, [f"{i}{suffix}" for i in range(4)])
    for i in range(4):
        (tmp_path / f"{i}{suffix}").write_bytes(content + bytes(200))
    found = read_view_set(ViewFiles(path))
    (note,) = [note for note in found.notes if note.code == "unreadable_photos"]
    assert what.partition(" in ")[0] in str(note)
    assert found.cameras.image_paths == (None,) * 4


@pytest.mark.parametrize("suffix", [".TIF", ".heic", ".exr", ".bmp", ".dng", ".jpg"])
@pytest.mark.parametrize("below", ["", "images/", "cam0/", "images/cam 1/"])
def test_folders_of_photos_without_poses_are_recognised(
    tmp_path: Path, suffix: str, below: str
) -> None:
    _made(tmp_path / f"{below}a{suffix}").write_bytes(b"x")
    with pytest.raises(InputError, match="photos without poses") as caught:
        read_views(tmp_path)
    assert ("convert" in str(caught.value)) == (suffix in (".heic", ".exr", ".dng"))


def test_points_of_a_folder_of_smaller_photos(tmp_path: Path) -> None:
    project(tmp_path)
    (tmp_path / "images").rename(tmp_path / "images_2")
    for path in (tmp_path, tmp_path / "images_2", tmp_path / "sparse" / "0"):
        assert len(read_sparse_points(find_sparse_file(path)) or ()) == 2


@pytest.mark.parametrize("damage", ["cut", "empty", "missing"])
@pytest.mark.parametrize("text", [False, True])
def test_points_that_cannot_be_used_are_a_warning(tmp_path: Path, damage: str, text: bool) -> None:
    project(tmp_path, text)
    file = find_sparse_file(tmp_path)
    assert file is not None
    if damage == "missing":
        file.unlink()
    else:
        data = file.read_bytes()
        file.write_bytes(
            (b"# none\n" if text else bytes(8)) if damage == "empty" else data[: len(data) - 25]
        )
    said: list[str] = []
    points = read_sparse_points(find_sparse_file(tmp_path), said.append)
    assert points is None or (damage == "cut" and text)
    assert points is not None or (len(said) == 1 and ("points3D" in said[0] or "sparse" in said[0]))


@pytest.mark.parametrize("name", ["gone.ply", "/mnt/gone.ply"])
def test_named_points_that_cannot_be_used_are_a_warning(tmp_path: Path, name: str) -> None:
    path = captured(tmp_path, NAMES, ply_file_path=name)
    said: list[str] = []
    assert read_sparse_points(find_sparse_file(path), said.append) is None
    assert len(said) == 1
    assert Path(name).name in said[0]


def test_points_named_on_another_machine(tmp_path: Path) -> None:
    path = captured(tmp_path, NAMES, ply_file_path="C:\\capture\\cloud\\p.ply")
    (tmp_path / "cloud").mkdir()
    (tmp_path / "cloud" / "p.ply").write_bytes(b"ply")
    assert find_sparse_file(path) == tmp_path / "cloud" / "p.ply"


def _made(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def test_named_points_without_colours_are_taken(tmp_path: Path) -> None:
    """Photos colour them."""
    path = captured(tmp_path, NAMES, ply_file_path="bare.ply")
    head = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
    (tmp_path / "bare.ply").write_text(f"{head}end_header\n0 0 0\n")
    cloud = read_sparse_points(find_sparse_file(path))
    assert cloud is not None
    assert cloud.colored.tolist() == [False]
