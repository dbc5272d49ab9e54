"""Reader and writer for .glb with KHR_gaussian_splatting: attributes of a point primitive, or an SPZ.

glTF has y up and z forward; a 3DGS .ply has y down and z forward. They differ by half a turn about z, which
changes the signs of x and y, of the quaternion's x and y, and of harmonics of odd order m.

The values of an SPZ (KHR_gaussian_splatting_compression_spz_2) are glTF coordinates, as CesiumJS reads them.
The draft asks for SPZ's own axes, which differ by half a turn about y.
"""

import base64
import json
import re
import struct
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast
from urllib.parse import unquote

import msgspec
import numpy as np

import g2ard.io.spz as spz
from g2ard.arrays import Float, Float32, Values
from g2ard.config.choices import AXES, Axes
from g2ard.errors import InputError, damaged, require
from g2ard.io.atomic import atomic_output
from g2ard.io.jsonfile import Json, Number, Place, Row, Vector, Whole, checked, parse_json
from g2ard.io.judge import fill_linear
from g2ard.io.packing import packing_order, rounding, unit_quats, writable
from g2ard.io.paths import check_regular, decoded
from g2ard.io.sanitize import Raw, cleaned
from g2ard.io.signs import MESH, SCAN
from g2ard.io.types import Note, Noted
from g2ard.progress import plural
from g2ard.scene.splats import SH_C0, Splats
from g2ard.scene.transform import (
    as_stored,
    deformed,
    harmonic_signs,
    join,
    restored,
    rotation_matrices,
)

EXTENSION = "KHR_gaussian_splatting"
SPZ_EXTENSION = f"{EXTENSION}_compression_spz_2"
_SPZ_EXTENSIONS = (
    SPZ_EXTENSION,
    f"{EXTENSION}_compression_spz",
    "KHR_spz_gaussian_splats_compression",
    "KHR_spz_compression",
)
"""The extension of an SPZ, and its earlier names: within the splats' extension, or beside or without it."""

_SPLATS = re.compile(r"[A-Z]+_(gaussian_splat|spz)")
"""Prefixes of the names of extensions for splats, including earlier and unsupported ones."""

LINEAR_NOTE = Note("linear_colors", 1, "linear colours are taken as sRGB, so renders are too dark")
_SPZ_VERSION = 3
_MAGIC = 0x46546C67  # "glTF"
_JSON = 0x4E4F534A  # "JSON"
_BIN = 0x004E4942  # "BIN"
_FLOAT = 5126
_USHORT = 5123
_UBYTE = 5121
_ARRAY_BUFFER = 34962
_TYPES = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_TYPE_OF_WIDTH = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_DTYPES = {
    5120: "i1",
    _UBYTE: "u1",
    5122: "<i2",
    _USHORT: "<u2",
    _FLOAT: "<f4",
}
_GLTF_TURN = np.array([-1.0, -1, 1])
_SH_FLIPS = harmonic_signs(_GLTF_TURN)


def write(
    path: Path,
    splats: Splats,
    *,
    overwrite: bool = False,
    compress: str | None = None,
) -> float:
    """Write a .glb with KHR_gaussian_splatting; equal scenes give equal bytes.

    SCALE and OPACITY are linear, ROTATION is x y z w. COLOR_0 is for viewers that only draw points: the base
    colour clipped to [0, 1] and decoded from sRGB, and α. `offset` is the node's translation, and its extras
    name axes other than those of a .ply, to which reading turns. `compress="spz"` writes an SPZ of version 3
    instead of attributes, for CesiumJS.

    Return the largest change of a position by rounding.
    """
    require("compress", repr(compress), compress in (None, "spz"), "spz")
    error = rounding(splats, writable(splats).narrowed())
    splats = as_stored(splats)
    if compress is None:
        content = _plain(splats)
    else:
        content, packed = spz_glb(splats)
        error += packed
    with atomic_output(path, overwrite) as temporary, temporary.open("wb") as file:
        file.writelines(content)
    return error


def _plain(splats: Splats) -> list[bytes]:
    """Return the parts of a .glb with float32 attributes."""
    attributes = _attributes(splats)
    views: list[Json] = []
    accessors = []
    blobs = []
    start = 0
    for name, values in attributes.items():
        blob = values.tobytes()
        blob += b"\0" * (-len(blob) % 4)
        accessor = {
            "bufferView": len(views),
            "componentType": _FLOAT,
            "count": len(splats),
            "type": _TYPE_OF_WIDTH[values.shape[1]],
        }
        if values.dtype == np.uint16:
            accessor["componentType"] = _USHORT
            accessor["normalized"] = True
        if name == "POSITION":
            accessor |= _ends(values)
        view = {
            "buffer": 0,
            "byteOffset": start,
            "byteLength": values.nbytes,
            "target": _ARRAY_BUFFER,
        }
        views.append(view)
        accessors.append(accessor)
        blobs.append(blob)
        start += len(blob)
    node: Json = {"mesh": 0}
    if splats.offset.any():
        node["translation"] = (splats.offset * _GLTF_TURN).tolist()
    node |= _extras(splats)
    document = _document(node, list(attributes), views, accessors, start)
    return _glb(document, blobs)


def _ends(means: Values) -> Json:
    return {
        "min": means.min(axis=0).tolist(),
        "max": means.max(axis=0).tolist(),
    }


def spz_glb(splats: Splats, centre: Float | None = None) -> tuple[list[bytes], float]:
    """Return the parts of a .glb that holds an SPZ, and the largest change of a position by rounding.

    The node's translation is the scene's `offset`, and `centre`, which makes coordinates small.
    """
    movable = centre is not None
    if centre is None:
        centre = np.zeros(3)
    near = splats.means.astype(float) - centre
    bits = spz.fraction_bits(near, splats, movable=movable)
    order = packing_order(splats.means)
    splats = splats.take(order)
    means = near[order] * (-1, 1, -1)
    blob = spz.encoded(_about_y(splats), means, bits, _SPZ_VERSION)
    steps = 1 << bits
    stored = np.rint(means * (1, -1, -1) * steps) / steps
    names = {
        "POSITION": "VEC3",
        "COLOR_0": "VEC4",
        f"{EXTENSION}:SCALE": "VEC3",
        f"{EXTENSION}:ROTATION": "VEC4",
    }
    for name, _ in _harmonics(splats.sh_degree):
        names[name] = "VEC3"
    accessors: list[Json] = [
        {"componentType": _FLOAT, "count": len(splats), "type": kind} for kind in names.values()
    ]
    accessors[0] |= _ends(stored)
    accessors[1] |= {"componentType": _UBYTE, "normalized": True}
    # CesiumJS needs a `matrix`, and takes the SPZ from the first buffer view.
    matrix = np.eye(4)
    matrix[3, :3] = (splats.offset + centre) * _GLTF_TURN
    node = {
        "mesh": 0,
        "matrix": matrix.ravel().tolist(),
        **_extras(splats),
    }
    view = {
        "buffer": 0,
        "byteOffset": 0,
        "byteLength": len(blob),
    }
    blob += b"\0" * (-len(blob) % 4)
    document = _document(
        node,
        list(names),
        [view],
        accessors,
        len(blob),
    )
    primitive = document["meshes"][0]["primitives"][0]
    splatting = primitive["extensions"][EXTENSION]
    splatting["extensions"] = {SPZ_EXTENSION: {"bufferView": 0}}
    extensions = [EXTENSION, SPZ_EXTENSION]
    document["extensionsUsed"] = extensions
    document["extensionsRequired"] = extensions
    return _glb(document, [blob]), spz.rounding(means, bits)


def _extras(splats: Splats) -> Json:
    """Return what a node states of a scene that is turned: the axes of its coordinates."""
    if splats.axes == "RDF":
        return {}
    return {"extras": {"g2ard": {"axes": splats.axes}}}


def _about_y(splats: Splats) -> Splats:
    """Turn a scene by half a turn about y, exactly: from SPZ's axes to glTF's, seen in those of a .ply."""
    signs = harmonic_signs((-1, 1, -1))[: splats.shN.shape[1], None]
    return replace(
        splats,
        means=splats.means * np.array([-1, 1, -1], splats.means.dtype),
        quats=splats.quats * np.array([1, -1, 1, -1], np.float32),
        shN=splats.shN * signs,
    )


def _glb(document: Json, blobs: list[bytes]) -> list[bytes]:
    start = sum(map(len, blobs))
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + start
    if total >= 1 << 32:
        raise InputError(f"not written: {total:,} bytes exceed the 4 GiB of a .glb")
    head = struct.pack("<IIIII", _MAGIC, 2, total, len(text), _JSON)
    head_of_blobs = struct.pack("<II", start, _BIN)
    return [head, text, head_of_blobs, *blobs]


def _attributes(splats: Splats) -> dict[str, Values]:
    srgb = np.clip(splats.colors.astype(float), 0, 1)
    bright = ((srgb + 0.055) / 1.055) ** 2.4
    linear = np.where(srgb <= 0.04045, srgb / 12.92, bright)
    alphas = splats.opacities[:, None]
    quats = unit_quats(splats.quats)
    turned = quats[:, [1, 2, 3, 0]] * (*_GLTF_TURN, 1)
    out: dict[str, Values] = {
        "POSITION": splats.means * _GLTF_TURN,
        "COLOR_0": np.rint(np.column_stack([linear, alphas]) * 65535).astype("<u2"),
        f"{EXTENSION}:ROTATION": turned,
        f"{EXTENSION}:SCALE": splats.scales,
        f"{EXTENSION}:OPACITY": alphas,
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": splats.sh0[:, 0],
    }
    for name, k in _harmonics(splats.sh_degree):
        out[name] = splats.shN[:, k] * _SH_FLIPS[k]
    for name, values in out.items():
        if values.dtype.kind == "f":
            out[name] = values.astype("<f4")
    return out


def _harmonics(degree: int) -> list[tuple[str, int]]:
    """Return the attributes of the coefficients past band 0, with their indices in `shN`."""
    return [
        (f"{EXTENSION}:SH_DEGREE_{band}_COEF_{c}", band * band - 1 + c)
        for band in range(1, degree + 1)
        for c in range(2 * band + 1)
    ]


def _document(
    node: Json,
    names: list[str],
    views: list[Any],
    accessors: list[Any],
    size: int,
) -> Json:
    from g2ard._core import __version__

    splatting: Json = {
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


_Entry = TypeVar("_Entry")


class _Primitive(msgspec.Struct):
    mode: Any = 4  # triangles
    attributes: Json = {}
    extensions: Json = {}


class _Splatting(msgspec.Struct, rename="camel"):
    kernel: Any = "ellipse"
    color_space: Any = None
    quantized_position_scale: Any = 1
    extensions: Json = {}


class _Mesh(msgspec.Struct):
    primitives: list[_Primitive] = []


class _Node(msgspec.Struct):
    mesh: Any = None
    extras: Any = None
    children: list[Whole] = []
    matrix: Annotated[list[Number], msgspec.Meta(min_length=16, max_length=16)] | None = None
    translation: Vector = (0.0, 0.0, 0.0)
    rotation: Row = (0.0, 0.0, 0.0, 1.0)
    scale: Vector = (1.0, 1.0, 1.0)


class _Accessor(msgspec.Struct, rename="camel"):
    component_type: Whole
    count: Whole
    type: str
    buffer_view: Whole | None = None
    byte_offset: Whole = Whole(0)
    normalized: Any = False
    sparse: Any = None


class _View(msgspec.Struct, rename="camel"):
    byte_length: Whole
    buffer: Whole | None = None
    byte_offset: Whole = Whole(0)
    byte_stride: Whole | None = None


class _Compressed(msgspec.Struct, rename="camel"):
    buffer_view: Whole


class _Shown(msgspec.Struct):
    nodes: list[Whole] = []


class _Document(msgspec.Struct, rename="camel"):
    scene: Whole = Whole(0)
    scenes: list[_Shown] = []
    meshes: list[_Mesh] = []
    nodes: list[_Node] = []
    accessors: list[_Accessor] = []
    buffer_views: list[_View] = []
    buffers: list[Json] = []


def read(path: Path) -> Noted:
    """Read the splat primitive of a .glb as its nodes place it; a mere translation becomes the `offset`."""
    content, binary = _chunks(path)
    return _scene(path, checked(content, _Document, Place(path)), binary)


def _chunks(path: Path) -> tuple[Any, bytes]:
    data = path.read_bytes()
    if path.suffix.lower() == ".gltf":
        return _with_buffer(path, parse_json(decoded(data)))
    if len(data) < 20 or struct.unpack_from("<II", data) != (_MAGIC, 2):
        raise InputError(f"not a .glb of glTF 2.0 (begins with {data[:4]!r})")
    found: dict[int, bytes] = {}
    at = 12
    while at + 8 <= len(data):
        size, kind = struct.unpack_from("<II", data, at)
        if at + 8 + size > len(data):
            raise damaged(f"truncated: a chunk of {size:,} bytes is cut off")
        found.setdefault(kind, data[at + 8 : at + 8 + size])
        at += 8 + size
    if _JSON not in found:
        raise InputError("holds no JSON chunk")
    return parse_json(decoded(found[_JSON])), found.get(_BIN, b"")


def _with_buffer(path: Path, document: Any) -> tuple[Any, bytes]:
    """Return the document of a .gltf and its only buffer, which it holds in base64 or names beside it."""
    buffers = None
    uri = None
    if isinstance(document, dict):
        buffers = document.get("buffers")
    if isinstance(buffers, list) and len(buffers) == 1:
        uri = buffers[0].get("uri")
    if not isinstance(buffers, list) or not isinstance(uri, str):
        raise InputError("expected one buffer with a uri", hint="export it as .glb")
    document = {**document, "buffers": [{**buffers[0], "uri": None}]}
    if uri.startswith("data:"):
        try:
            return document, base64.b64decode(uri.partition(",")[2], validate=True)
        except ValueError as error:
            raise damaged(f"broken base64 in a buffer ({error})") from error
    file = path.parent / unquote(uri)
    check_regular(file)
    return document, file.read_bytes()


def _scene(path: Path, document: _Document, binary: bytes) -> Noted:
    """Read all splat primitives, each as often as nodes show it."""
    found = placed(_shown(path, document, binary))
    primitives = [primitive for mesh in document.meshes for primitive in mesh.primitives]
    if found is None:
        modes = {primitive.mode for primitive in primitives}
        held = "nothing"
        hint = None
        if modes == {0}:
            held = "points"
            hint = SCAN
        elif modes:
            held = "a mesh"
            hint = MESH
        raise InputError(f"holds {held}: no primitive has {EXTENSION}", hint=hint)
    scene, notes = found
    others = sum(not _has_splats(primitive) for primitive in primitives)
    if others:
        text = f"{plural(others, 'other primitive')} ignored"
        notes = (Note("ignored_meshes", others, text), *notes)
    return restored(scene, _axes(document.nodes)), notes


def _axes(nodes: list[_Node]) -> Axes:
    """Return the axes that g2ard stated in a node, or those of a .ply."""
    for node in nodes:
        if not isinstance(node.extras, dict):
            continue
        own = node.extras.get("g2ard")
        if isinstance(own, dict) and own.get("axes") in AXES:
            return cast("Axes", own["axes"])
    return "RDF"


def _has_splats(primitive: _Primitive) -> bool:
    return any(map(_SPLATS.match, primitive.extensions))


def _shown(
    path: Path,
    document: _Document,
    binary: bytes,
) -> Iterator[tuple[Noted, Float]]:
    """Yield each splat primitive with each of its placements."""
    shown = _nodes_shown(path, document)
    for index, mesh in enumerate(document.meshes):
        held = [at for at, primitive in enumerate(mesh.primitives) if _has_splats(primitive)]
        placements = []
        if held:
            placements = _placements(path, document.nodes, index, shown)
        for at in held:
            within = Place(path).to("meshes", index, "primitives", at)
            scene = _primitive(within, document, binary, mesh.primitives[at])
            yield from ((scene, placement) for placement in placements)


def placed(parts: Iterable[tuple[Noted, Float]]) -> Noted | None:
    """Join parts by their (4, 4) placements, in the axes of a .ply; return None without parts."""
    moved = []
    notes = []
    uneven = 0
    for (part, own), placement in parts:
        notes += [note for note in own if note not in notes]
        try:
            splats, exact = deformed(part, placement)
        except InputError as error:
            raise error.at(parameter=None, message=f"a node {error.message}") from None
        moved.append(splats)
        uneven += not exact
    if not moved:
        return None
    if uneven:
        parts_ = plural(uneven, "part")
        text = f"{parts_} scaled unevenly: colours by direction follow approximately"
        notes.append(Note("uneven_placement", uneven, text))
    scene = moved[0]
    if len(moved) > 1:
        scene = join(moved)
    return scene, tuple(notes)


def _primitive(
    within: Place,
    document: _Document,
    binary: bytes,
    primitive: _Primitive,
) -> Noted:
    """Read a primitive of splats, in the axes of a .ply, without its placement."""
    path = within.path
    place = within.to("extensions", EXTENSION)
    splats = checked(primitive.extensions.get(EXTENSION, {}), _Splatting, place)
    held = {*splats.extensions, *filter(_SPLATS.match, primitive.extensions)}
    unknown = held - {EXTENSION, *_SPZ_EXTENSIONS}
    if unknown:
        raise InputError(f"unsupported extension {min(unknown)!r}")
    if splats.quantized_position_scale != 1:
        raise place.to("quantizedPositionScale").error("is unsupported")
    if splats.kernel != "ellipse":
        raise InputError("unsupported kernel; expected 'ellipse'")
    name = next((name for name in _SPZ_EXTENSIONS if name in held), None)
    if name is None:
        scene, notes = _attributes_of(
            within.to("attributes"),
            document,
            binary,
            primitive.attributes,
        )
    else:
        extensions = primitive.extensions
        if name in splats.extensions:
            within = place
            extensions = splats.extensions
        place = within.to("extensions", name)
        packed = checked(extensions[name], _Compressed, place)
        view = _view(document, packed.buffer_view, place, "the SPZ")
        start = view.byte_offset
        scene, notes = spz.decoded(path, binary[start : start + view.byte_length])
        scene = _about_y(scene)
    if "lin" in str(splats.color_space).lower():
        notes = (LINEAR_NOTE, *notes)
    return scene, notes


def _attributes_of(
    place: Place,
    document: _Document,
    binary: bytes,
    names: Json,
) -> Noted:
    """Read the float or integer attributes of a primitive, in the axes of a .ply."""

    def values(name: str, width: int) -> Float32:
        if name not in names:
            raise InputError(f"attribute {name!r} is missing", path=place.path)
        index = checked(names[name], Whole, place.to(name))
        return _accessor(
            place.to(name),
            document,
            binary,
            index,
            name,
            width,
        )

    own = list(names)
    base = f"{EXTENSION}:SH_DEGREE_0_COEF_0"
    opacity = f"{EXTENSION}:OPACITY"
    names = {re.sub("^_", f"{EXTENSION}:", name): at for name, at in names.items()}
    degree = 0
    for band in (1, 2, 3):
        if f"{EXTENSION}:SH_DEGREE_{band}_COEF_0" in names:
            degree = band
    means = values("POSITION", 3)
    raw = Raw.empty(len(means), (degree + 1) ** 2 - 1)
    draft = base not in names and "COLOR_0" in names
    if draft:
        color = values("COLOR_0", 4)
        sh0 = (color[:, :3] - 0.5) / SH_C0
        opacities = color[:, 3]
    if not draft or opacity in names:
        opacities = values(opacity, 1)[:, 0]
    if not draft:
        sh0 = values(base, 3)
    scales = values(f"{EXTENSION}:SCALE", 3)
    notes = fill_linear(raw, scales, opacities, sh0)
    if draft:
        text = f"written by a draft of {EXTENSION} ({', '.join(own)})"
        notes.append(Note("first_draft", len(means), text))
    with np.errstate(invalid="ignore"):  # a signalling NaN
        raw.means[:] = means * _GLTF_TURN
        quats = values(f"{EXTENSION}:ROTATION", 4)[:, [3, 0, 1, 2]]
        raw.quats[:] = quats * (1, *_GLTF_TURN)
        for name, k in _harmonics(degree):
            raw.shN[:, k] = values(name, 3) * _SH_FLIPS[k]
    return cleaned(raw, notes)


def _entry(table: list[_Entry], index: int | None, place: Place) -> _Entry:
    """Return the entry of a table whose index stands at `place`."""
    if index is None or index >= len(table):
        raise place.error(f"is {index}, expected an index below {len(table)}")
    return table[index]


def _view(
    document: _Document,
    index: int | None,
    place: Place,
    what: str,
) -> _View:
    """Return the buffer view whose index is a property of `place`; it must lie in the binary chunk."""
    view = _entry(document.buffer_views, index, place.to("bufferView"))
    within = Place(place.path).to("bufferViews", index or 0, "buffer")
    buffer = _entry(document.buffers, view.buffer, within)
    if view.buffer or buffer.get("uri") is not None:
        raise InputError(f"{what} lies outside the file", path=place.path)
    return view


def _accessor(
    place: Place,
    document: _Document,
    binary: bytes,
    index: int,
    name: str,
    width: int,
) -> Float32:
    """Return the (count, width) values of an accessor; normalised integers become fractions."""
    path = place.path
    accessor = _entry(document.accessors, index, place)
    dtype = np.dtype(_DTYPES.get(accessor.component_type, "V1"))
    is_dense = accessor.sparse is None
    if dtype.kind == "V" or _TYPES.get(accessor.type) != width or not is_dense:
        raise InputError(f"attribute {name!r} has an unsupported type")
    place = Place(path).to("accessors", index)
    view = _view(document, accessor.buffer_view, place, f"attribute {name!r}")
    row = width * dtype.itemsize
    step: int = row
    if view.byte_stride is not None:
        step = view.byte_stride
    start = view.byte_offset + accessor.byte_offset
    if step < row:
        raise InputError(f"attribute {name!r} has a stride of {step} bytes, less than its elements")
    count = accessor.count
    if count and start + step * (count - 1) + row > len(binary):
        raise damaged(f"truncated: attribute {name!r} ends past the file")
    rows = np.ndarray(
        (count, width),
        dtype,
        binary,
        start,
        strides=(step, dtype.itemsize),
    )
    values = rows.astype(np.float32)
    if not accessor.normalized:
        return values
    largest = np.float32(np.iinfo(dtype).max)
    return np.maximum(values / largest, np.float32(-1))


def _nodes_shown(path: Path, document: _Document) -> set[int]:
    """Return the nodes of the shown scene and below; all, if there are no scenes, or it shows no splats."""
    every = set(range(len(document.nodes)))
    if not document.scenes:
        return every
    scene = _entry(document.scenes, document.scene, Place(path).to("scene"))
    ahead = list(scene.nodes)
    found = set()
    place = Place(path).to("scenes", document.scene, "nodes")
    while ahead:
        at = ahead.pop()
        if at not in found:
            ahead += _entry(document.nodes, at, place).children
            found.add(int(at))
    meshes = [
        index
        for index, mesh in enumerate(document.meshes)
        if any(map(_has_splats, mesh.primitives))
    ]
    if any(document.nodes[at].mesh in meshes for at in found):
        return found
    return every


def _placements(
    path: Path,
    nodes: list[_Node],
    mesh: int,
    seen: set[int],
) -> list[Float]:
    """Return the (4, 4) placements by a mesh's `seen` nodes and their ancestors, in the axes of a .ply."""
    parents: dict[int, int] = {}
    for i, node in enumerate(nodes):
        for k, child in enumerate(node.children):
            _entry(nodes, child, Place(path).to("nodes", i, "children", k))
            if parents.setdefault(child, i) != i:
                raise InputError(f"node {child} has 2 parents")
    found = []
    holders = [i for i, node in enumerate(nodes) if node.mesh == mesh]
    if not holders:
        return [np.eye(4)]
    for shown in holders:
        if shown not in seen:
            continue
        at: int | None = shown
        total = np.eye(4)
        above = set()
        with np.errstate(over="ignore", invalid="ignore"):
            while at is not None:
                if at in above:
                    raise InputError(f"node {at} is its own ancestor")
                above.add(at)
                total = _local(nodes[at]) @ total
                at = parents.get(at)
        if not np.isfinite(total[:3, 3]).all():
            raise InputError(f"invalid translation {tuple(total[:3, 3].tolist())}")
        turn = (*_GLTF_TURN, 1)
        found.append(total * np.outer(turn, turn))
    return found


def _local(node: _Node) -> Float:
    if node.matrix is not None:
        return np.array(node.matrix).reshape(4, 4).T
    matrix = np.eye(4)
    matrix[:3, 3] = node.translation
    quat = np.array(node.rotation)[[3, 0, 1, 2]]
    matrix[:3, :3] = rotation_matrices(quat[None])[0] * node.scale
    return matrix
