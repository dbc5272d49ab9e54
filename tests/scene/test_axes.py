"""Axes by name: the same world in every system, harmonics included, and in the files that name them."""

import struct
from pathlib import Path

import numpy as np
import pytest
import torch

from g2ard.config.choices import AXES
from g2ard.errors import InputError
from g2ard.io import read_splats, write_splats
from g2ard.io.spz import _ADOBE_AXES
from g2ard.scene.splats import Splats
from g2ard.scene.transform import change_of_axes, with_axes
from helpers.commands import CommandLine, refused, succeeds
from helpers.opened import read_scene
from helpers.peers import adobe_spz, splat_transform
from reference.raster import sh_basis
from reference.rotations import covariances

WORLD = {
    "R": [1, 0, 0],
    "L": [-1, 0, 0],
    "U": [0, 1, 0],
    "D": [0, -1, 0],
    "B": [0, 0, 1],
    "F": [0, 0, -1],
}
"""Directions of the letters, written out, in the world right, up, back."""


def scene(count: int = 40) -> Splats:
    rng = np.random.default_rng(3)
    return Splats.create(
        rng.normal(size=(count, 3)),
        quats=rng.normal(size=(count, 4)),
        scales=np.exp(rng.normal(-1, 0.5, (count, 3))),
        sh0=rng.normal(0, 0.5, (count, 1, 3)),
        shN=rng.uniform(-0.9, 0.9, (count, 15, 3)),
    )


def world(splats: Splats, axes: str) -> list[np.ndarray]:
    """Means, covariances and colours from fixed directions, in the world right, up, back: the naive twin."""
    to_world = np.array([WORLD[letter] for letter in axes], float).T
    directions = np.random.default_rng(0).normal(size=(20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    basis = sh_basis(torch.from_numpy(directions @ to_world), 16).numpy()
    coefficients = np.concatenate([splats.sh0, splats.shN], axis=1)
    colors = np.einsum("dk,nkc->ndc", basis, coefficients)
    return [
        splats.means @ to_world.T,
        to_world @ covariances(splats.quats, splats.scales) @ to_world.T,
        colors,
    ]


@pytest.mark.parametrize("name", AXES)
def test_the_world_stays_the_same(name: str) -> None:
    here = scene()
    there = with_axes(here, change_of_axes("RDF", name))
    for mine, theirs in zip(world(there, name), world(here, "RDF"), strict=True):
        np.testing.assert_allclose(mine, theirs, atol=2e-5)
    back = with_axes(there, change_of_axes(name, "RDF"))
    np.testing.assert_array_equal(back.means, here.means)
    np.testing.assert_allclose(back.shN, here.shN, atol=1e-6)


@pytest.mark.parametrize("name", AXES)
def test_spz_in_every_system_is_the_same_world(tmp_path: Path, name: str) -> None:
    usual, other = tmp_path / "usual.spz", tmp_path / "other.spz"
    write_splats(usual, scene(), spz_version=4)
    write_splats(other, scene(), spz_version=4, axes=name)
    read = read_scene(other)
    assert read.notes == ()
    data = other.read_bytes()
    assert bool(data[14] & 2) == (name != "RUB")
    if name != "RUB":
        record = struct.unpack_from("<III", data, 32)
        assert record == (0xADBE0003, 4, _ADOBE_AXES.index(name) + 1)
    # what is stored without the extension: coordinates of another system taken for right, up, back
    plain = bytearray(data)
    plain[14] &= 0xFD
    (tmp_path / "plain.spz").write_bytes(plain)
    stored = with_axes(read_splats(tmp_path / "plain.spz"), change_of_axes("RDF", "RUB"))
    order, others = (np.lexsort(np.round(s.means, 2).T) for s in (read.splats, read_splats(usual)))
    got, want = world(read.splats.take(order), "RDF"), world(read_splats(usual).take(others), "RDF")
    for mine, theirs, near in zip(got, want, (1e-3, 0.05, 0.5), strict=True):
        np.testing.assert_allclose(mine, theirs, atol=near)
    for mine, theirs in zip(world(stored, name), world(read.splats, "RDF"), strict=True):
        np.testing.assert_allclose(mine, theirs, atol=2e-5)


@pytest.mark.parametrize("name", AXES)
def test_adobe_reads_every_system_as_we_do(tmp_path: Path, name: str) -> None:
    path = tmp_path / "a.spz"
    write_splats(path, scene(), spz_version=4, axes=name)
    ours, read = read_splats(path), adobe_spz(path)
    rows = {key: values.reshape(len(ours), -1) for key, values in read.items()}
    theirs = Splats.create(
        rows["positions"],
        quats=rows["rotations"][:, [3, 0, 1, 2]],
        scales=np.exp(rows["scales"]),
        sh0=rows["colors"][:, None],
        shN=rows["sh"].reshape(-1, 15, 3),
    )
    for mine, other in zip(world(ours, "RDF"), world(theirs, "RDF"), strict=True):
        np.testing.assert_allclose(mine, other, atol=2e-3)


def test_extension_records_are_checked(tmp_path: Path) -> None:
    path = tmp_path / "a.spz"
    write_splats(path, scene(), spz_version=4, axes="RFU")
    data = path.read_bytes()

    def with_record(kind: int, number: int) -> Path:
        path.write_bytes(data[:32] + struct.pack("<III", kind, 4, number) + data[44:])
        return path

    assert [note.code for note in read_scene(with_record(0xADBE0002, 1)).notes] == [
        "ignored_extensions"
    ]
    assert len(read_splats(with_record(0xADBE0003, 0))) == 40
    with pytest.raises(InputError, match="unknown coordinate system 17"):
        read_splats(with_record(0xADBE0003, 17))
    path.write_bytes(data[:36] + struct.pack("<I", 99) + data[40:])
    with pytest.raises(InputError, match="an extension is cut off"):
        read_splats(path)


def test_convert_stores_other_axes(command_line: CommandLine, tmp_path: Path) -> None:
    write_splats(tmp_path / "a.ply", scene())
    for name in ("b.ply", "b.sog", "b.compressed.ply"):
        succeeds(command_line, tmp_path, "convert", "a.ply", name, "--to-axes", "rfu")
    expected = with_axes(scene(), change_of_axes("RDF", "RFU"))
    np.testing.assert_allclose(read_splats(tmp_path / "b.ply").shN, expected.shN, atol=1e-6)
    line = refused(
        command_line, tmp_path, "convert", "a.ply", "b.glb", "--to-axes", "RFU", status=1
    )
    assert "LUF axes by definition" in line
    succeeds(command_line, tmp_path, "convert", "a.ply", "b.glb", "--to-axes", "LUF")
    succeeds(command_line, tmp_path, "convert", "a.ply", "b.spz", "--to-axes", "LBU")
    assert (tmp_path / "b.spz").read_bytes()[:8] == b"NGSP\4\0\0\0"
    given = "convert", "a.ply", "c.spz", "--spz-version", "3", "--to-axes", "RFU"
    assert "version 3 has RUB axes, or RDF" in refused(command_line, tmp_path, *given, status=1)
    write_splats(tmp_path / "named.spz", scene(), spz_version=4, axes="RFU")
    given = "convert", "named.spz", "c.ply", "--from-axes", "RDF"
    assert "names its axes" in refused(command_line, tmp_path, *given, status=1)


def test_splat_transform_reads_and_writes_spz_with_the_axes_of_a_ply(
    command_line: CommandLine, tmp_path: Path
) -> None:
    write_splats(tmp_path / "a.ply", scene())
    succeeds(command_line, tmp_path, "convert", "a.ply", "theirs.spz", "--to-axes", "RDF")
    splat_transform(tmp_path / "theirs.spz", tmp_path / "theirs.ply")
    splat_transform(tmp_path / "a.ply", tmp_path / "written.spz")
    succeeds(command_line, tmp_path, "convert", "written.spz", "written.ply", "--from-axes", "RDF")
    for name in ("theirs.ply", "written.ply"):
        read = read_splats(tmp_path / name)
        rows, others = (np.lexsort(np.round(s.means, 2).T) for s in (read, scene()))
        got, want = world(read.take(rows), "RDF"), world(scene().take(others), "RDF")
        # scales are rounded by 3 %
        for mine, other, near in zip(got, want, (1e-3, 0.05, 0.5), strict=True):
            np.testing.assert_allclose(mine, other, atol=near, rtol=0.07)
