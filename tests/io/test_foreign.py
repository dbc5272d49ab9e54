"""Files and folders of other programs are named for what they are."""

import json
from pathlib import Path

import pytest
from PIL import Image

from g2ard.errors import InputError
from g2ard.io import kind, read_cloud, read_scene

TILESET = {"asset": {"version": "1.1"}, "geometricError": 9, "root": {"children": []}}


@pytest.mark.parametrize("given", ["", "tileset.json"])
@pytest.mark.parametrize("tiles", [0, 2])
def test_tilesets(tmp_path: Path, given: str, tiles: int) -> None:
    (tmp_path / "tileset.json").write_text(json.dumps(TILESET))
    for i in range(tiles):
        (tmp_path / f"0_{i}.b3dm").write_bytes(b"x")
    with pytest.raises(InputError, match=r"tileset\.json: is a tileset of 3D Tiles"):
        read_scene(tmp_path / given)


def gsplat_pngs(folder: Path, names: list[str], extra: dict) -> None:
    folder.mkdir(parents=True)
    meta = {}
    for name in names:
        meta[name] = {"shape": [4, 3], "dtype": "float32", "mins": [0], "maxs": [1]} | extra
        Image.new("L", (2, 2)).save(folder / f"{name}.png")
    (folder / "meta.json").write_text(json.dumps(meta))


@pytest.mark.parametrize("given", ["", "meta.json"])
@pytest.mark.parametrize("name", ["scene", "compression/rank0"])
@pytest.mark.parametrize(
    ("names", "extra"),
    [
        (["means", "scales", "quats", "opacities", "sh0"], {}),
        (["means", "scales", "quats", "opacities", "sh0", "shN"], {"quantization": 6}),
    ],
)
def test_pngs_of_gsplat(tmp_path: Path, given: str, name: str, names: list[str], extra: dict) -> None:
    gsplat_pngs(tmp_path / name, names, extra)
    with pytest.raises(InputError, match="gsplat"):
        read_scene(tmp_path / name / given)


@pytest.mark.parametrize("suffix", [".lcc", ".LCC", ".zip", ".7z", ".rad", ".pcd"])
@pytest.mark.parametrize("beside", [[], ["data.bin", "attrs.lcp"]])
def test_folders_with_a_file_of_another_program(tmp_path: Path, suffix: str, beside: list[str]) -> None:
    for name in [f"room{suffix}", *beside]:
        (tmp_path / name).write_bytes(b"x")
    for path in (tmp_path, tmp_path / f"room{suffix}"):
        with pytest.raises(InputError) as caught:
            kind(path)
        assert suffix.strip(".").lower() in str(caught.value).lower()
        assert "looked for" not in str(caught.value)
        assert "unknown format" not in str(caught.value)


CONVERTERS = {
    **dict.fromkeys((".pcd", ".pts", ".ptx", ".xyz"), "pdal translate"),
    **{".lcc": "splat-transform", ".rad": "Spark"},
}


@pytest.mark.parametrize("suffix", CONVERTERS)
def test_a_format_that_is_not_read_names_what_converts_it(suffix: str, tmp_path: Path) -> None:
    (tmp_path / f"a{suffix}").write_text("1 2 3 255 0 0\n")
    for read in (read_scene, read_cloud):
        with pytest.raises(InputError, match=rf"a\{suffix}: .*{CONVERTERS[suffix]}"):
            read(tmp_path / f"a{suffix}")
