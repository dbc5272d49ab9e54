"""Reader and writer for .glb with KHR_gaussian_splatting: attributes of a point primitive, or an SPZ.

glTF has y up and z forward; a 3DGS .ply has y down and z forward. They differ by half a turn about z, which
changes the signs of x and y, of the quaternion's x and y, and of harmonics of odd order m.

The values of an SPZ (KHR_gaussian_splatting_compression_spz_2) are glTF coordinates, as CesiumJS reads them.
The draft asks for SPZ's own axes, which differ by half a turn about y.
"""

import json
import struct
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.errors import InputError, damaged, require
from g2ard.io import spz
from g2ard.io.atomic import atomic_output
from g2ard.io.jsonfile import (
    Fields,
    fields_of,
    index_of,
    listed,
    numbers,
    object_of,
    objects,
    parse_json,
    text,
    whole,
)
from g2ard.io.packing import morton_order, rounding, unit_quats, writable
from g2ard.io.sanitize import Raw, cleaned
from g2ard.io.types import Note, Scene
from g2ard.progress import plural
from g2ard.scene.splats import Splats
from g2ard.scene.transform import placed, rotation_matrices

EXTENSION = "KHR_gaussian_splatting"
SPZ_EXTENSION = f"{EXTENSION}_compression_spz_2"
_SPZ_VERSION = 3
_MAGIC, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942
_FLOAT, _USHORT, _UBYTE = 5126, 5123, 5121
_TYPES = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_DTYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
_SH_FLIPS = np.array([-1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1], np.float32)
"""Sign of each harmonic of bands 1–3 after half a turn about z: (−1)^m."""
_GLTF_TURN = np.array([-1.0, -1, 1])


def write(path: Path, splats: Splats, *, overwrite: bool = False, compress: str | None = None) -> float:
    """Write a .glb with KHR_gaussian_splatting; equal scenes give equal bytes.

    SCALE and OPACITY are linear, ROTATION is x y z w. COLOR_0 is for viewers that only draw points: the base
    colour clipped to [0, 1] and decoded from sRGB, and α. `offset` is the node's translation.
    `compress="spz"` writes an SPZ of version 3 instead of attributes, for CesiumJS.

    Return the largest change of a position by rounding.
    """
    require("compress", repr(compress), compress in (None, "spz"), "spz")
    given, splats = splats, writable(path, splats).narrowed()
    error = rounding(given, splats)
    if compress is None:
        content = _plain(path, splats)
    else:
        content = spz_glb(path, splats)
        error += spz.rounding(splats.means, spz.fraction_bits(path, splats.means.astype(np.float64), splats))
    with atomic_output(path, overwrite) as temporary, temporary.open("wb") as file:
        file.writelines(content)
    return error


def _plain(path: Path, splats: Splats) -> list[bytes]:
    """Return the parts of a .glb with float32 attributes."""
    attributes = _attributes(splats)
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    blobs, start = [], 0
    for name, values in attributes.items():
        blob = values.tobytes()
        blob += b"\0" * (-len(blob) % 4)
        accessor = {
            "bufferView": len(views),
            "componentType": _USHORT if values.dtype == np.uint16 else _FLOAT,
            "count": len(splats),
            "type": {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[values.shape[1]],
        }
        if values.dtype == np.uint16:
            accessor["normalized"] = True
        if name == "POSITION":
            accessor |= {end: getattr(values, end)(axis=0).tolist() for end in ("min", "max")}
        views.append({"buffer": 0, "byteOffset": start, "byteLength": values.nbytes, "target": 34962})
        accessors.append(accessor)
        blobs.append(blob)
        start += len(blob)
    node: dict[str, Any] = {"mesh": 0}
    if splats.offset.any():
        node["translation"] = (splats.offset * _GLTF_TURN).tolist()
    document = _document(node, list(attributes), views, accessors, start)
    return _glb(path, document, blobs)


def spz_glb(path: Path, splats: Splats, centre: NDArray[np.float64] | None = None) -> list[bytes]:
    """Return the parts of a .glb that holds an SPZ; `path` names it in messages.

    Args:
        splats: the scene, whose `offset` is the node's translation.
        centre: (3,) moved from the means to the node's translation, so that coordinates are fine.
    """
    splats = splats.take(morton_order(splats.means))
    centre = np.zeros(3) if centre is None else centre
    means = (splats.means.astype(np.float64) - centre) * (-1, 1, -1)
    bits = spz.fraction_bits(path, means, splats)
    blob = spz.encoded(path, _about_y(splats), means, bits, _SPZ_VERSION)
    stored = np.rint(means * (1, -1, -1) * (1 << bits)) / (1 << bits)
    ends = {end: getattr(stored, end)(axis=0).tolist() for end in ("min", "max")}
    names = {"POSITION": "VEC3", "COLOR_0": "VEC4"}
    names |= {f"{EXTENSION}:SCALE": "VEC3", f"{EXTENSION}:ROTATION": "VEC4"}
    names |= {name: "VEC3" for name, _ in _harmonics(splats.sh_degree)}
    accessors: list[dict[str, Any]] = [
        {"componentType": _FLOAT, "count": len(splats), "type": kind} for kind in names.values()
    ]
    accessors[0] |= ends
    accessors[1] |= {"componentType": _UBYTE, "normalized": True}
    # CesiumJS needs a `matrix`, and takes the SPZ from the first buffer view.
    matrix = np.eye(4)
    matrix[3, :3] = (splats.offset + centre) * _GLTF_TURN
    node = {"mesh": 0, "matrix": matrix.ravel().tolist()}
    view = {"buffer": 0, "byteOffset": 0, "byteLength": len(blob)}
    blob += b"\0" * (-len(blob) % 4)
    document = _document(node, list(names), [view], accessors, len(blob))
    splatting = document["meshes"][0]["primitives"][0]["extensions"][EXTENSION]
    splatting["extensions"] = {SPZ_EXTENSION: {"bufferView": 0}}
    document["extensionsUsed"] = document["extensionsRequired"] = [EXTENSION, SPZ_EXTENSION]
    return _glb(path, document, [blob])


def _about_y(splats: Splats) -> Splats:
    """Turn a scene by half a turn about y, exactly: from SPZ's axes to glTF's, seen in those of a .ply."""
    signs = (_SH_FLIPS * spz.FLIPS)[: splats.shN.shape[1], None]
    means = splats.means * np.array([-1, 1, -1], splats.means.dtype)
    return replace(
        splats, means=means, quats=splats.quats * np.array([1, -1, 1, -1], np.float32), shN=splats.shN * signs
    )


def _glb(path: Path, document: dict[str, Any], blobs: list[bytes]) -> list[bytes]:
    start = sum(map(len, blobs))
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + start
    if total >= 1 << 32:
        raise InputError(f"not written: {total:,} bytes exceed the 4 GiB of a .glb", path=path)
    head = struct.pack("<III", _MAGIC, 2, total) + struct.pack("<II", len(text), _JSON)
    return [head, text, struct.pack("<II", start, _BIN), *blobs]


def _attributes(splats: Splats) -> dict[str, NDArray[Any]]:
    """Return the primitive's attributes, (N, C) each."""
    linear = np.clip(splats.colors.astype(np.float64), 0, 1)
    linear = np.where(linear <= 0.04045, linear / 12.92, ((linear + 0.055) / 1.055) ** 2.4)
    alphas = splats.opacities[:, None]
    quats = unit_quats(splats.quats)
    turned = quats[:, [1, 2, 3, 0]] * (*_GLTF_TURN, 1)
    out: dict[str, NDArray[Any]] = {
        "POSITION": (splats.means * _GLTF_TURN).astype("<f4"),
        "COLOR_0": np.rint(np.column_stack([linear, alphas]) * 65535).astype("<u2"),
        f"{EXTENSION}:ROTATION": turned.astype("<f4"),
        f"{EXTENSION}:SCALE": splats.scales.astype("<f4"),
        f"{EXTENSION}:OPACITY": alphas.astype("<f4"),
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": splats.sh0[:, 0].astype("<f4"),
    }
    for name, k in _harmonics(splats.sh_degree):
        out[name] = (splats.shN[:, k] * _SH_FLIPS[k]).astype("<f4")
    return out


def _harmonics(degree: int) -> list[tuple[str, int]]:
    """Return the attributes of the coefficients past band 0, with their indices in `shN`."""
    return [
        (f"{EXTENSION}:SH_DEGREE_{band}_COEF_{c}", band * band - 1 + c)
        for band in range(1, degree + 1)
        for c in range(2 * band + 1)
    ]


def _document(
    node: dict[str, Any], names: list[str], views: list[Any], accessors: list[Any], size: int
) -> dict[str, Any]:
    from g2ard._core import __version__

    splatting: dict[str, Any] = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    primitive = {
        "mode": 0,
        "attributes": {name: i for i, name in enumerate(names)},
        "extensions": {EXTENSION: splatting},
    }
    return {
        "asset": {"version": "2.0", "generator": f"g2ard {__version__}"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": size}],
        "bufferViews": views,
        "accessors": accessors,
    }


def read(path: Path) -> Scene:
    """Read the splat primitive of a .glb as its nodes place it; a mere translation becomes the `offset`."""
    content, binary = _chunks(path)
    return _scene(path, fields_of(path, content), binary)


def _chunks(path: Path) -> tuple[Any, bytes]:
    """Return the JSON document and the binary chunk."""
    data = path.read_bytes()
    if len(data) < 20 or struct.unpack_from("<II", data) != (_MAGIC, 2):
        raise InputError(f"not a .glb of glTF 2.0 (begins with {data[:4]!r})", path=path)
    found: dict[int, bytes] = {}
    at = 12
    while at + 8 <= len(data):
        size, kind = struct.unpack_from("<II", data, at)
        if at + 8 + size > len(data):
            raise damaged(f"truncated: a chunk of {size:,} bytes is cut off", path=path)
        found.setdefault(kind, data[at + 8 : at + 8 + size])
        at += 8 + size
    if _JSON not in found:
        raise InputError("holds no JSON chunk", path=path)
    return parse_json(path, found[_JSON]), found.get(_BIN, b"")


def _scene(path: Path, document: Fields, binary: bytes) -> Scene:
    primitives = [objects(mesh, "primitives") for mesh in objects(document, "meshes")]
    splatting = [(at, p) for at, held in enumerate(primitives) for p in held if EXTENSION in _extensions(p)]
    if len(splatting) != 1:
        raise InputError(f"has {len(splatting)} primitives with {EXTENSION}, expected 1", path=path)
    mesh, primitive = splatting[0]
    splats = object_of(_extensions(primitive), EXTENSION)
    packed = _extensions(splats)
    if unknown := sorted(set(packed) - {SPZ_EXTENSION}):
        raise InputError(f"unsupported extension {unknown[0]!r}", path=path)
    if splats.get("kernel", "ellipse") != "ellipse":
        raise InputError("unsupported kernel; expected 'ellipse'", path=path)
    notes = []
    if others := sum(map(len, primitives)) - 1:
        notes.append(Note("ignored_meshes", others, f"{plural(others, 'other primitive')} ignored"))
    if splats.get("colorSpace") == "lin_rec709_display":
        notes.append(Note("linear_colors", 1, "linear colours are taken as sRGB, so renders are too dark"))
    place = _placement(path, document, mesh)
    if packed:
        view, start = _view(path, document, object_of(packed, SPZ_EXTENSION), "the SPZ")
        scene = spz.decoded(path, binary[start : start + whole(view, "byteLength")])
        scene = replace(scene, splats=_about_y(scene.splats))
    else:
        scene = _attributes_of(path, document, binary, primitive)
    try:
        moved = placed(scene.splats, place)
    except InputError as error:
        raise error.at(path=path, parameter=None, message=f"a node {error.message}") from None
    return replace(scene, splats=moved, notes=(*notes, *scene.notes))


def _attributes_of(path: Path, document: Fields, binary: bytes, primitive: Fields) -> Scene:
    """Read the float or integer attributes of a primitive, in the axes of a .ply."""
    names = object_of(primitive, "attributes")

    def values(name: str, width: int) -> NDArray[np.float32]:
        if name not in names:
            raise InputError(f"attribute {name!r} is missing", path=path)
        return _accessor(path, document, binary, names, name, width)

    degree = max(d for d in range(4) if d == 0 or f"{EXTENSION}:SH_DEGREE_{d}_COEF_0" in names)
    means = values("POSITION", 3)
    raw = Raw.empty(len(means), (degree + 1) ** 2 - 1)
    raw.set_linear(values(f"{EXTENSION}:SCALE", 3), values(f"{EXTENSION}:OPACITY", 1)[:, 0])
    with np.errstate(invalid="ignore"):  # a signalling NaN
        raw.means[:] = means * _GLTF_TURN
        raw.quats[:] = values(f"{EXTENSION}:ROTATION", 4)[:, [3, 0, 1, 2]] * (1, *_GLTF_TURN)
        raw.sh0[:, 0] = values(f"{EXTENSION}:SH_DEGREE_0_COEF_0", 3)
        for name, k in _harmonics(degree):
            raw.shN[:, k] = values(name, 3) * _SH_FLIPS[k]
    return cleaned(path, raw)


def _extensions(of: Fields) -> Fields:
    return object_of(of, "extensions") if "extensions" in of else Fields({})


def _pointed(document: Fields, table: str, holder: Fields, name: str) -> Fields:
    """Return the entry of a table whose index is a property of `holder`."""
    entries = listed(document, table)
    return object_of(entries, index_of(holder, name, len(entries)))


def _view(path: Path, document: Fields, holder: Fields, what: str) -> tuple[Fields, int]:
    """Return the buffer view that `holder` points to, and its start in the binary chunk."""
    view = _pointed(document, "bufferViews", holder, "bufferView")
    if view["buffer"] != 0 or "uri" in _pointed(document, "buffers", view, "buffer"):
        raise InputError(f"{what} lies outside the file", path=path)
    return view, whole(view, "byteOffset", 0)


def _accessor(
    path: Path, document: Fields, binary: bytes, names: Fields, name: str, width: int
) -> NDArray[np.float32]:
    """Return the (count, width) values of an accessor; normalised integers become fractions."""
    accessor = _pointed(document, "accessors", names, name)
    kind = whole(accessor, "componentType")
    if kind not in _DTYPES or _TYPES.get(text(accessor, "type")) != width or "sparse" in accessor:
        raise InputError(f"attribute {name!r} has an unsupported type", path=path)
    view, start = _view(path, document, accessor, f"attribute {name!r}")
    dtype, count = np.dtype(_DTYPES[kind]), whole(accessor, "count")
    step = whole(view, "byteStride", width * dtype.itemsize)
    start += whole(accessor, "byteOffset", 0)
    if step < width * dtype.itemsize:
        raise InputError(
            f"attribute {name!r} has a stride of {step} bytes, less than its elements", path=path
        )
    if count and start + step * (count - 1) + width * dtype.itemsize > len(binary):
        raise damaged(f"truncated: attribute {name!r} ends past the file", path=path)
    rows = np.ndarray((count, width), dtype, binary, start, (step, dtype.itemsize))
    if not accessor.get("normalized"):
        return rows.astype(np.float32)
    top = np.iinfo(dtype).max
    return np.maximum(rows.astype(np.float32) / np.float32(top), np.float32(-1))


def _placement(path: Path, document: Fields, mesh: int) -> NDArray[np.float64]:
    """Return the (4, 4) placement by the mesh's only node and its ancestors, in the axes of a .ply."""
    nodes = objects(document, "nodes")
    parents: dict[int, list[int]] = {}
    for i, node in enumerate(nodes):
        children = listed(node, "children")
        for k in range(len(children)):
            parents.setdefault(index_of(children, k, len(nodes)), []).append(i)
    at = [i for i, node in enumerate(nodes) if node.get("mesh") == mesh]
    if len(at) > 1:
        raise InputError(f"{len(at)} nodes show the splats, expected 1", path=path)
    total = np.eye(4)
    seen: set[int] = set()
    while at:
        if at[0] in seen:
            raise InputError(f"node {at[0]} is its own ancestor", path=path)
        seen.add(at[0])
        with np.errstate(over="ignore", invalid="ignore"):
            total = _local(nodes[at[0]]) @ total
        at = parents.get(at[0], [])
        if len(at) > 1:
            raise InputError(f"a node has {len(at)} parents", path=path)
    if not np.isfinite(total[:3, 3]).all():
        raise InputError(f"invalid translation {tuple(total[:3, 3].tolist())}", path=path)
    return total * np.outer((*_GLTF_TURN, 1), (*_GLTF_TURN, 1))


def _local(node: Fields) -> NDArray[np.float64]:
    """Return a node's (4, 4) matrix, given as such or as translation, rotation and scale."""
    if "matrix" in node:
        return _numbers(node, "matrix", np.eye(4).ravel()).reshape(4, 4).T
    matrix = np.eye(4)
    matrix[:3, 3] = _numbers(node, "translation", (0, 0, 0))
    if "rotation" in node or "scale" in node:
        quat = _numbers(node, "rotation", (0, 0, 0, 1))[[3, 0, 1, 2]]
        matrix[:3, :3] = rotation_matrices(quat[None])[0] * _numbers(node, "scale", (1, 1, 1))
    return matrix


def _numbers(node: Fields, key: str, default: Sequence[float] | NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a node's vector or matrix, of the same length as its default."""
    return np.array(numbers(node, key, len(default)) if key in node else default, np.float64)
