"""Photos become what their pinhole cameras would have taken; images come out as they went in."""

import struct
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from g2ard.errors import InputError, OutputError
from g2ard.io.finding import Finder
from g2ard.io.images import to_bytes, write_png
from g2ard.io.photo_headers import describe_unreadable
from g2ard.io.photos import load_mask, load_photo
from g2ard.scene.cameras import Cameras
from helpers.scenes import around


def camera(
    photo: Path | None, size: tuple[int, int], K: list[float] | None = None, distortion: object = ()
) -> Cameras:
    fx, fy, cx, cy = K or (size[0], size[0], size[0] / 2, size[1] / 2)
    matrix = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
    return Cameras.from_lists(
        [np.eye(4)], [matrix], [size], ["view"], [photo], [distortion] if distortion else ()
    )


def save(path: Path, array: np.ndarray, **options: object) -> Path:
    Image.fromarray(array).save(path, **options)
    return path


@pytest.mark.parametrize("size", [(28, 21), (12, 9), (4, 3)])
def test_shrinking_takes_the_mean_of_the_area(tmp_path: Path, size: tuple[int, int]) -> None:
    pixels, (width, height) = (
        np.random.default_rng(2).integers(0, 256, (21, 28, 3), dtype=np.uint8),
        size,
    )
    image = load_photo(camera(save(tmp_path / "a.png", pixels), size), 0)[0]
    fine = np.repeat(np.repeat(pixels / 255, height, axis=0), width, axis=1)  # both grids divide it
    np.testing.assert_allclose(
        image, fine.reshape(height, 21, width, 28, 3).mean((1, 3)), atol=1e-6
    )
    assert (image.dtype, image.flags.c_contiguous) == (np.float32, True)


def test_growing_stays_in_range(tmp_path: Path) -> None:
    pixels = np.random.default_rng(3).integers(0, 256, (6, 8, 3), dtype=np.uint8)
    image = load_photo(camera(save(tmp_path / "a.png", pixels), (16, 12)), 0)[0]
    assert image.shape == (12, 16, 3)
    assert pixels.min() / 255 <= image.min() <= image.max() <= pixels.max() / 255


@pytest.mark.parametrize(
    ("array", "expected"),
    [
        (np.full((4, 4), 51, np.uint8), [0.2, 0.2, 0.2]),
        (np.full((4, 4), 13107, np.uint16), [0.2, 0.2, 0.2]),
        (np.full((4, 4, 4), (255, 0, 51, 51), np.uint8), [0.2, 0, 0.04]),
        (np.full((4, 4, 2), (255, 51), np.uint8), [0.2, 0.2, 0.2]),
    ],
)
def test_other_pixel_types(tmp_path: Path, array: np.ndarray, expected: list[float]) -> None:
    image = load_photo(camera(save(tmp_path / "a.png", array), (4, 4)), 0)[0]
    assert (image.shape, image.dtype) == ((4, 4, 3), np.float32)
    np.testing.assert_allclose(image[2, 1], expected, atol=1e-6)


def test_palette_photo(tmp_path: Path) -> None:
    Image.new("RGB", (4, 4), (255, 0, 51)).convert("P", palette=Image.Palette.ADAPTIVE).save(
        tmp_path / "a.png"
    )
    image = load_photo(camera(tmp_path / "a.png", (4, 4)), 0)[0]
    np.testing.assert_allclose(image[0, 0], [1, 0, 0.2], atol=0.01)


def bend(x: np.ndarray, y: np.ndarray, k: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """OpenCV's distortion as its manual states it."""
    k1, k2, p1, p2, k3 = k
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2),
        y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y,
    )


def pattern(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A smooth picture of the plane z = 1, so that interpolation is almost exact."""
    return np.stack(
        [0.5 + 0.4 * np.sin(5 * x), 0.5 + 0.4 * np.cos(4 * y), 0.5 + 0.3 * np.sin(3 * (x + y))], -1
    )


@pytest.mark.parametrize("scale", [1, 2])
def test_undistorted_photo_is_the_pinhole_picture(tmp_path: Path, scale: int) -> None:
    """Draw the distorted photo by inverting the lens numerically; loading must give the undistorted one."""
    k = (0.25, -0.05, 0.01, -0.02, 0.01)
    width, height = 160, 120
    fx, fy, cx, cy = 150.0, 155.0, 78.3, 61.4
    v, u = np.mgrid[0 : height * scale, 0 : width * scale] + 0.5
    xd, yd = (u / scale - cx) / fx, (v / scale - cy) / fy
    x, y = xd.copy(), yd.copy()
    for _ in range(50):
        bx, by = bend(x, y, k)
        x, y = x + xd - bx, y + yd - by
    photo = save(tmp_path / "a.png", to_bytes(pattern(x, y)))
    image = load_photo(camera(photo, (width, height), [fx, fy, cx, cy], k), 0)[0]
    v, u = np.mgrid[0:height, 0:width] + 0.5
    expected = pattern((u - cx) / fx, (v - cy) / fy)
    inside = (slice(14, -14), slice(14, -14))  # the edge is repeated where the lens saw no more
    np.testing.assert_allclose(image[inside], expected[inside], atol=0.5 / 255 + 1.5e-3)
    undone = np.asarray(Image.open(photo), np.float32)[::scale, ::scale] / 255
    assert np.abs(undone[inside] - expected[inside]).max() > 0.02  # it was distorted


def test_photos_that_cannot_be_loaded_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"view 0 \(view\) has no photo"):
        load_photo(camera(None, (4, 4)), 0)
    with pytest.raises(InputError, match=r"gone\.png: no such photo"):
        load_photo(camera(tmp_path / "gone.png", (4, 4)), 0)
    (tmp_path / "a.png").write_bytes(b"not an image")
    with pytest.raises(InputError, match=r"a\.png: is not an image"):
        load_photo(camera(tmp_path / "a.png", (4, 4)), 0)
    path = save(
        tmp_path / "b.png", np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    )
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(InputError, match=r"b\.png: cannot be decoded"):
        load_photo(camera(path, (64, 64)), 0)
    path = save(tmp_path / "c.png", np.zeros((40, 30, 3), np.uint8))
    with pytest.raises(InputError, match="the photo is 30×40, its view 40×30"):
        load_photo(camera(path, (40, 30)), 0)


def test_png_round_trip(tmp_path: Path) -> None:
    image = np.random.default_rng(0).random((5, 7, 3))
    write_png(tmp_path / "a.png", image)
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "a.png")), np.rint(image * 255))
    write_png(tmp_path / "grey.png", image[..., 0])
    assert Image.open(tmp_path / "grey.png").mode == "L"
    with pytest.raises(OutputError, match="exists"):
        write_png(tmp_path / "a.png", image)
    with pytest.raises(InputError, match="expected an image"):
        write_png(tmp_path / "b.png", np.zeros((2, 3, 5)))


@pytest.mark.parametrize("value", [1.94, -0.1, np.nan])
def test_float_photos_are_within_0_and_1(tmp_path: Path, value: float) -> None:
    pixels = np.full((6, 8), 0.5, np.float32)
    whole = camera(save(tmp_path / "a.tiff", pixels), (8, 6))
    np.testing.assert_array_equal(load_photo(whole, 0)[0], 0.5)
    pixels[2, 3] = value
    with pytest.raises(InputError, match=r"b\.tiff: expected values in \[0, 1\]"):
        load_photo(camera(save(tmp_path / "b.tiff", pixels), (8, 6)), 0)


@pytest.mark.parametrize("own", [False, True])
def test_a_mask_holds_from_half_on(tmp_path: Path, own: bool) -> None:
    """Test every grey, in a mask and as the alpha of a photo that is its own mask."""
    levels = np.arange(256, dtype=np.uint8).reshape(16, 16)
    photo, mask = tmp_path / "a.png", tmp_path / ("a.png" if own else "m.png")
    Image.fromarray(np.dstack([levels, levels, levels, levels])).save(photo)
    if not own:
        Image.fromarray(levels).save(mask)
    views = replace(around(1, (16, 16)), image_paths=(photo,), mask_paths=(mask,))
    np.testing.assert_array_equal(load_mask(views, 0), levels > 127)


@pytest.mark.parametrize(
    "k",
    [
        (0.3, 0, 0, 0, 0),
        (0, 0.4, 0, 0, 0),
        (-0.7, 0, 0, 0, 0),
        (0.1, -0.2, 0.05, -0.05, 0.3),
        (0, 0, 0, 0, -2),
    ],
)
@pytest.mark.parametrize("size", [(80, 60), (40, 30)])
def test_pixels_that_a_photo_does_not_hold_are_masked(
    tmp_path: Path, k: tuple[float, ...], size: tuple[int, int]
) -> None:
    """A pixel counts if the lens maps its centre into the photo before the model folds back."""
    path = save(tmp_path / "a.png", np.full((60, 80, 3), 99, np.uint8))
    f = 0.75 * size[0]
    mask = load_mask(camera(path, size, [f, f, size[0] / 2, size[1] / 2], k), 0)
    v, u = np.mgrid[0 : size[1], 0 : size[0]] + 0.5
    x, y = (u - size[0] / 2) / f, (v - size[1] / 2) / f
    xd, yd = bend(x, y, k)
    radii = np.linspace(0, 3, 30001)
    radial = radii * (1 + k[0] * radii**2 + k[1] * radii**4 + k[4] * radii**6)
    falls = np.flatnonzero(np.diff(radial) <= 0)
    fold = radii[falls[0]] if len(falls) else np.inf
    u, v = xd * f + size[0] / 2, yd * f + size[1] / 2
    held = (u >= 0) & (u <= size[0]) & (v >= 0) & (v <= size[1]) & (np.hypot(x, y) < fold)
    assert not held.all()
    assert mask is not None
    assert not mask[~held].any()
    assert mask[held].mean() > 0.9


@pytest.mark.parametrize("k", [(0, 0, 0, 0, 0), (-0.05, 0, 0, 0, 0)])
def test_a_photo_that_holds_every_pixel_has_no_mask(tmp_path: Path, k: tuple[float, ...]) -> None:
    path = save(tmp_path / "a.png", np.full((60, 80, 3), 99, np.uint8))
    assert load_mask(camera(path, (80, 60), [60, 60, 40, 30], k), 0) is None


def words_png(words: np.ndarray) -> bytes:
    """Return a PNG of 16-bit (H, W, C) values, which Pillow cannot write."""
    height, width, channels = words.shape
    raw = b"".join(b"\0" + row.astype(">u2").tobytes() for row in words)

    def chunk(name: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        )

    head = struct.pack(">IIBBBBB", width, height, 16, {1: 0, 2: 4, 3: 2, 4: 6}[channels], 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", head)
        + chunk(b"IDAT", zlib.compress(raw))
        + chunk(b"IEND", b"")
    )


def words_tiff(words: np.ndarray) -> bytes:
    """Return an uncompressed TIFF of (H, W, C) values of 16 bits or more, or floats."""
    height, width, channels = words.shape
    sample = {"u": 1, "i": 2, "f": 3}[words.dtype.kind]
    numbers = {
        256: width,
        257: height,
        258: 8 * words.itemsize,
        259: 1,
        262: 2 if channels > 2 else 1,
    }
    numbers |= {273: 150 + 2 * channels, 277: channels, 278: height, 279: words.nbytes, 339: sample}
    if channels > 3:
        numbers[338] = 0
    if channels > 2:
        numbers[258] = 150
    rows = [
        struct.pack("<HHII", tag, 3, channels if tag == 258 else 1, value)
        for tag, value in sorted(numbers.items())
    ]
    head = b"II*\0" + struct.pack("<IH", 8, len(rows)) + b"".join(rows) + bytes(4)
    return (
        head.ljust(150, b"\0")
        + struct.pack(f"<{channels}H", *[8 * words.itemsize] * channels)
        + words.tobytes()
    )


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize(("suffix", "written"), [(".png", words_png), (".tif", words_tiff)])
def test_photos_of_fewer_bits_in_16(
    tmp_path: Path, suffix: str, written: Callable, channels: int, bits: int
) -> None:
    """The range is that of the folder: a darker photo stays darker."""
    true = np.random.default_rng(bits).uniform(0.6, 1, (6, 8, channels))
    for name, light in (("a", 1.0), ("b", 0.05)):
        words = np.rint(light * true * (2**bits - 1))
        if channels == 4:
            words[..., 3] = 2**bits - 1
        (tmp_path / (name + suffix)).write_bytes(written(words.astype("<u2")))
        got = load_photo(camera(tmp_path / (name + suffix), (8, 6)), 0)[0]
        np.testing.assert_allclose(
            got, np.broadcast_to(light * true[..., :3], got.shape), atol=0.6 / (2**bits - 1)
        )


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
@pytest.mark.parametrize("channels", [2, 4])
@pytest.mark.parametrize("opaque", [0, 65535])
def test_alpha_of_all_bits_beside_colours_of_fewer(
    tmp_path: Path, channels: int, bits: int, opaque: int
) -> None:
    top = 2**bits - 1
    words = np.random.default_rng(bits).integers(0, top + 1, (6, 8, channels))
    words[0, 0, 0] = top
    words[..., -1] = np.where(words[..., 0] % 2, opaque or top, 0)
    (tmp_path / "a.png").write_bytes(words_png(words.astype("<u2")))
    got = load_photo(camera(tmp_path / "a.png", (8, 6)), 0, None)[0]
    np.testing.assert_array_equal(got[..., 3], words[..., -1] > 0)
    wanted = words[..., :-1] * (words[..., -1:] > 0) / top
    np.testing.assert_allclose(got[..., :3], np.broadcast_to(wanted, (6, 8, 3)), atol=1e-6)


def test_a_photo_brighter_than_its_folder_keeps_its_own_range(tmp_path: Path) -> None:
    for k in range(6):
        (tmp_path / f"{k}.png").write_bytes(
            words_png(np.full((4, 4, 3), 900 if k != 1 else 60000) + np.arange(3))
        )
    assert load_photo(camera(tmp_path / "1.png", (4, 4)), 0)[0][0, 0, 0] == pytest.approx(
        60000 / 65535
    )


@pytest.mark.parametrize(
    ("channels", "kind"),
    [(3, "f4"), (5, "u1"), (5, "u2"), (2, "u2"), (3, "i2")],
    ids=lambda value: str(value),
)
def test_tiffs_that_cannot_be_read_say_so(tmp_path: Path, channels: int, kind: str) -> None:
    file = tmp_path / "a.tif"
    file.write_bytes(words_tiff(np.ones((6, 8, channels), kind)))
    with pytest.raises(InputError, match=r"a\.tif: is a TIFF .*bands.*gdal_translate"):
        load_photo(camera(file, (8, 6)), 0)
    assert "TIFF" in str(describe_unreadable(file))


PRIMARIES = {
    "Display P3": (
        (0.51512, 0.2412, -0.00105),
        (0.29198, 0.69225, 0.04189),
        (0.1571, 0.06657, 0.78407),
    ),
    "Adobe RGB": (
        (0.60974, 0.31111, 0.01947),
        (0.20528, 0.62567, 0.06087),
        (0.14919, 0.06322, 0.74457),
    ),
    "ProPhoto": ((0.79767, 0.28804, 0.0), (0.13519, 0.71188, 0.0), (0.0313, 0.00009, 0.8249)),
}
SRGB = np.array(
    [(0.43607, 0.22249, 0.01392), (0.38515, 0.71687, 0.09708), (0.14307, 0.06061, 0.7141)]
).T


def profile(primaries: tuple, name: bytes) -> bytes:
    """Return an ICC profile of these primaries, in XYZ with the white of D50, and gamma 2.2."""

    def xyz(values: tuple) -> bytes:
        return b"XYZ " + bytes(4) + b"".join(struct.pack(">i", round(v * 65536)) for v in values)

    curve = b"curv" + bytes(4) + struct.pack(">IHxx", 1, round(2.2 * 256))
    named = b"desc" + bytes(4) + struct.pack(">I", len(name) + 1) + name + b"\0" + bytes(78)
    tags = {b"desc": named, b"cprt": b"text" + bytes(5), b"wtpt": xyz((0.9642, 1.0, 0.8249))}
    tags |= {tag: xyz(own) for tag, own in zip((b"rXYZ", b"gXYZ", b"bXYZ"), primaries, strict=True)}
    tags |= dict.fromkeys((b"rTRC", b"gTRC", b"bTRC"), curve)
    table, body = b"", b""
    for tag, value in tags.items():
        table += tag + struct.pack(">II", 132 + 12 * len(tags) + len(body), len(value))
        body += value + bytes(-len(value) % 4)
    size = 132 + len(table) + len(body)
    head = struct.pack(
        ">I4xI4s4s4s12x4s", size, 0x02100000, b"mntr", b"RGB ", b"XYZ ", b"acsp"
    ).ljust(68, b"\0")
    white = struct.pack(">iii", *(round(v * 65536) for v in (0.9642, 1.0, 0.8249)))
    return (head + white).ljust(128, b"\0") + struct.pack(">I", len(tags)) + table + body


def in_space(primaries: tuple, true: np.ndarray) -> np.ndarray:
    linear = np.where(true <= 0.04045, true / 12.92, ((true + 0.055) / 1.055) ** 2.4)
    return np.clip(linear @ (np.linalg.inv(np.array(primaries).T) @ SRGB).T, 0, 1) ** (1 / 2.2)


@pytest.mark.parametrize("space", PRIMARIES)
@pytest.mark.parametrize("kind", ["RGB", "RGBA", "P"])
@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_wide_colour_spaces_become_srgb(tmp_path: Path, suffix: str, kind: str, space: str) -> None:
    true = np.repeat(np.random.default_rng(1).uniform(0.05, 0.95, (1, 8, 3)), 6, 0)
    image = Image.fromarray(
        np.rint(255 * in_space(PRIMARIES[space], true)).astype(np.uint8)
    ).convert(kind, palette=Image.Palette.ADAPTIVE)
    image.save(tmp_path / f"a{suffix}", icc_profile=profile(PRIMARIES[space], b"wide"))
    got = load_photo(camera(tmp_path / f"a{suffix}", (8, 6)), 0)[0]
    np.testing.assert_allclose(got, true, atol=0.05)
    assert np.abs(got - true).mean() < 0.008


@pytest.mark.parametrize(
    "content", [b"", b"broken", profile(PRIMARIES["ProPhoto"], b"my sRGB")[:300]]
)
def test_a_broken_profile_is_ignored(tmp_path: Path, content: bytes) -> None:
    Image.new("RGB", (8, 6), (51, 102, 204)).save(tmp_path / "a.png", icc_profile=content)
    got = load_photo(camera(tmp_path / "a.png", (8, 6)), 0)[0]
    np.testing.assert_allclose(got[0, 0], [0.2, 0.4, 0.8], atol=1e-6)


def palette(mask: np.ndarray, colours: list[int]) -> Image.Image:
    image = Image.fromarray(mask.astype(np.uint8)).convert("L")
    image = Image.frombytes("P", image.size, image.tobytes())
    image.putpalette(colours)
    return image


VOC = [0, 0, 0, 128, 0, 0, 0, 128, 0, 128, 128, 0]


def in_alpha(mask: np.ndarray, shade: int) -> Image.Image:
    shades = np.full_like(mask, shade, np.uint8)
    return Image.fromarray(np.dstack([shades, shades, shades, 255 * mask.astype(np.uint8)]))


@pytest.mark.parametrize(
    "written",
    {
        "0 and 1": lambda m: Image.fromarray(m.astype(np.uint8)),
        "0 and 1 of 16 bits": lambda m: Image.fromarray(m.astype(np.uint16)),
        "0 and 255 of 16 bits": lambda m: Image.fromarray(255 * m.astype(np.uint16)),
        "labels": lambda m: Image.fromarray((m * np.array([1, 2, 3, 4] * 2)).astype(np.uint8)),
        "grey": lambda m: Image.fromarray(100 * m.astype(np.uint8)),
        "one bit": lambda m: Image.fromarray(m),
        "palette": lambda m: palette(m, [0, 0, 0, 128, 0, 0]),
        "palette, turned": lambda m: palette(~m, [255, 255, 255, 0, 0, 0]),
        "labels of VOC": lambda m: palette(m * np.array([1, 2, 3, 1, 2, 3, 1, 2]), VOC),
        "alpha of white": lambda m: in_alpha(m, 255),
        "alpha of black": lambda m: in_alpha(m, 0),
        "all white": lambda m: Image.new("L", (8, 6), 255),
    }.items(),
    ids=lambda pair: pair[0],
)  # fmt: skip
@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_masks_as_programs_write_them(
    tmp_path: Path, suffix: str, written: tuple[str, Callable]
) -> None:
    kept = np.zeros((6, 8), bool)
    kept[:, :5] = True
    Image.new("RGB", (8, 6)).save(tmp_path / "a.png")
    written[1](kept).save(tmp_path / f"m{suffix}")
    views = replace(
        around(1, (8, 6)), image_paths=(tmp_path / "a.png",), mask_paths=(tmp_path / f"m{suffix}",)
    )
    np.testing.assert_array_equal(load_mask(views, 0), kept | (written[0] == "all white"))


@pytest.mark.parametrize("level", [0, 1, 255])
def test_dynamic_masks_leave_out_what_is_white(tmp_path: Path, level: int) -> None:
    moving = np.zeros((6, 8), np.uint8)
    moving[:, 5:] = level
    Image.new("RGB", (8, 6)).save(tmp_path / "a.png")
    Image.fromarray(moving).save(tmp_path / "dynamic_mask_a.png")
    masks = (Finder(tmp_path).mask(tmp_path / "a.png", 1),)
    views = replace(around(1, (8, 6)), image_paths=(tmp_path / "a.png",), mask_paths=masks)
    np.testing.assert_array_equal(load_mask(views, 0), moving == 0)
