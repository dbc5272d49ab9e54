"""Reader and writer for OpenUSD's ParticleField3DGaussianSplat: .usda as text, .usdc through usd-core.

The written stage has y up and z back, as SPZ: y and z change sign, as do the quaternion's y and z and every
harmonic odd in them. Scales and opacities are linear. Band 0 precedes the other bands, as in a .ply.
"""

import re
import zipfile
from contextlib import suppress
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from g2ard.arrays import Float, Float32
from g2ard.config.choices import AXES
from g2ard.errors import InputError, OutputError, missing
from g2ard.io.atomic import atomic_output
from g2ard.io.glb import LINEAR_NOTE, placed
from g2ard.io.judge import choose_white, fill_linear
from g2ard.io.packing import rounding, unit_quats, writable
from g2ard.io.sanitize import Raw, cleaned
from g2ard.io.signs import MESH, SCAN
from g2ard.io.spz import FLIPS
from g2ard.io.types import Note, Noted
from g2ard.progress import Progress, plural, silent
from g2ard.scene.splats import SH_C0, Splats
from g2ard.scene.transform import as_stored, restored

_SCHEMA = "ParticleField3DGaussianSplat"
_KERNEL = "ParticleFieldKernelGaussianEllipsoidAPI"
_NAME = "Splats"
_SH = "radiance:sphericalHarmonics"
_COLOR = "primvars:displayColor"
_USD_TURN = np.array([1.0, -1, -1])
_QUAT_TURN = np.array([1.0, 1, -1, -1])
_AXES = "g2ardAxes"  # name of the axes that the scene is turned to, in the layer's custom data
_TEXT_ROWS = 8192  # rows formatted together as text
_EXTENT_SIGMAS = 3.0  # extent of a Gaussian, as a multiple of its largest scale


def write(
    path: Path,
    splats: Splats,
    *,
    overwrite: bool = False,
    progress: Progress = silent,
) -> float:
    """Write a .usda, or a .usdc if usd-core is installed; equal scenes give equal text.

    `offset` becomes the prim's translation; the layer's custom data name axes other than those of a .ply, to
    which reading turns. Units are metres. Return the largest change of a position by
    rounding.
    """
    error = rounding(splats, writable(splats).narrowed())
    splats = as_stored(splats)
    binary = path.suffix.lower() != ".usda"
    pxr = _pxr() if binary else None
    with atomic_output(path, overwrite) as temporary:
        if pxr is not None:
            try:
                _save(pxr, temporary, splats, progress)
            except (pxr.Tf.ErrorException, RuntimeError) as error:
                reason = str(error).strip().splitlines()[-1].strip()
                raise OutputError(f"cannot write: {reason}") from error
        else:
            with temporary.open("w", encoding="utf-8", newline="\n") as file:
                _print(file, splats, progress)
    return error


def _attributes(splats: Splats) -> dict[str, tuple[str, Float32]]:
    """Return the type and the values of each array attribute; quaternions are w x y z."""
    means = (splats.means * _USD_TURN).astype(np.float32)
    reach = _EXTENT_SIGMAS * splats.scales.max(axis=1, keepdims=True)
    extent = np.stack([(means - reach).min(axis=0), (means + reach).max(axis=0)])
    quats = unit_quats(splats.quats) * _QUAT_TURN
    rest = splats.shN * FLIPS[: splats.shN.shape[1], None]
    bands = np.concatenate([splats.sh0, rest], axis=1)
    return {
        "extent": ("float3[]", extent),
        "positions": ("point3f[]", means),
        "orientations": ("quatf[]", quats.astype(np.float32)),
        "scales": ("float3[]", splats.scales.astype(np.float32)),
        "opacities": ("float[]", splats.opacities[:, None]),
        f"{_SH}Coefficients": ("float3[]", bands.reshape(-1, 3)),
    }


def _print(file: TextIO, splats: Splats, progress: Progress) -> None:
    own = ""
    if splats.axes != "RDF":
        own = f'    customLayerData = {{\n        string {_AXES} = "{splats.axes}"\n    }}\n'
    file.write(
        f'#usda 1.0\n(\n{own}    defaultPrim = "{_NAME}"\n    metersPerUnit = 1\n    upAxis = "Y"\n)\n\n'
        f'def {_SCHEMA} "{_NAME}"\n{{\n'
        f"    uniform int {_SH}Degree = {splats.sh_degree}\n"
        '    uniform token projectionModeHint = "perspective"\n'
        '    uniform token sortingModeHint = "zDepth"\n'
    )
    arrays = _attributes(splats)
    done = 0
    total = sum(len(values) for _, values in arrays.values())
    for name, (kind, values) in arrays.items():
        row = ", ".join(["%.9g"] * values.shape[1])
        if values.shape[1] > 1:
            row = f"({row})"
        file.write(f"    {kind} {name} = [")
        for start in range(0, len(values), _TEXT_ROWS):
            block = values[start : start + _TEXT_ROWS]
            if start:
                file.write(", ")
            file.write(", ".join([row] * len(block)) % tuple(block.ravel().tolist()))
            done += len(block)
            progress("pack", done, total)
        file.write("]\n")
    if splats.offset.any():
        shift = ", ".join(repr(float(v)) for v in splats.offset * _USD_TURN)
        file.write(
            f"    double3 xformOp:translate = ({shift})\n"
            '    uniform token[] xformOpOrder = ["xformOp:translate"]\n'
        )
    file.write("}\n")


def _save(
    pxr: Any,
    path: Path,
    splats: Splats,
    progress: Progress,
) -> None:
    stage = pxr.Usd.Stage.CreateNew(str(path))
    pxr.UsdGeom.SetStageUpAxis(stage, pxr.UsdGeom.Tokens.y)
    pxr.UsdGeom.SetStageMetersPerUnit(stage, 1)
    field = pxr.UsdVol.ParticleField3DGaussianSplat.Define(stage, f"/{_NAME}")
    prim = field.GetPrim()
    stage.SetDefaultPrim(prim)
    prim.GetAttribute(f"{_SH}Degree").Set(splats.sh_degree)
    prim.GetAttribute("projectionModeHint").Set("perspective")
    prim.GetAttribute("sortingModeHint").Set("zDepth")
    arrays = {"float[]": pxr.Vt.FloatArray, "quatf[]": pxr.Vt.QuatfArray}
    attributes = _attributes(splats)
    for done, (name, (kind, values)) in enumerate(attributes.items(), 1):
        progress("pack", done, len(attributes))
        if kind == "quatf[]":
            values = values[:, [1, 2, 3, 0]]  # usd-core's memory order
        elif kind == "float[]":
            values = values[:, 0]
        array = arrays.get(kind, pxr.Vt.Vec3fArray)
        prim.GetAttribute(name).Set(array.FromNumpy(np.ascontiguousarray(values)))
    if splats.offset.any():
        shift = (splats.offset * _USD_TURN).tolist()
        field.AddTranslateOp().Set(pxr.Gf.Vec3d(*shift))
    if splats.axes != "RDF":
        stage.GetRootLayer().customLayerData = {_AXES: splats.axes}
    stage.GetRootLayer().Save()


def read(path: Path) -> Noted:
    """Read all visible ParticleField3DGaussianSplat of a stage, in the axes of a .ply; needs usd-core.

    Instances are read as often as they occur. Of time samples, the earliest count.
    """
    pxr = _pxr()
    try:
        stage = pxr.Usd.Stage.Open(str(path))
    except pxr.Tf.ErrorException as error:
        raise _not_a_stage(error) from error
    which = pxr.Usd.TraverseInstanceProxies(pxr.Usd.PrimDefaultPredicate)
    held = list(stage.Traverse(which))
    fields = [prim for prim in held if _is_field(prim)]
    shown = [prim for prim in fields if _visible(pxr, prim)]
    parts = ((_read_prim(pxr, prim), _to_ply(pxr, stage, prim)) for prim in shown)
    found = placed(parts)
    if found is None:
        raise InputError(_nothing(path, held, len(fields)))
    scene, notes = found
    axes = stage.GetRootLayer().customLayerData.get(_AXES)
    if axes in AXES:
        scene = restored(scene, axes)
    hidden = len(fields) - len(shown)
    if hidden:
        text = f"{plural(hidden, 'invisible prim')} ignored"
        notes = (*notes, Note("invisible_prims", hidden, text))
    return scene, notes


def _not_a_stage(error: Exception) -> InputError:
    """Return the error for a file that OpenUSD cannot open, with the line if it states one."""
    text = str(error).strip()
    at = re.search(r":(\d+):\d+: |\bon line (\d+)\b", text)
    if at is None:
        return InputError(f"not an OpenUSD stage ({text.splitlines()[-1].strip()})")
    return InputError("is not valid OpenUSD text", index=int(at[1] or at[2]), item="line")


def _is_field(prim: Any) -> bool:
    kind = prim.GetTypeName()
    if kind == "ParticleField":
        return _KERNEL in prim.GetAppliedSchemas()
    return bool(kind == _SCHEMA)


def _visible(pxr: Any, prim: Any) -> bool:
    time = pxr.Usd.TimeCode.EarliestTime()
    visibility = pxr.UsdGeom.Imageable(prim).ComputeVisibility(time)
    return bool(visibility != pxr.UsdGeom.Tokens.invisible)


def _nothing(path: Path, held: list[Any], fields: int) -> str:
    """Return why a stage has no splats that can be read: what it holds instead."""
    if fields:
        return f"has {plural(fields, 'prim')} of type {_SCHEMA}, all invisible"
    words = list[str]()
    for prim in held:
        names = (prim.GetTypeName(), *prim.GetPropertyNames(), *prim.GetAppliedSchemas())
        words += [str(name).lower() for name in names]
    if path.suffix.lower() == ".usdz":
        with suppress(zipfile.BadZipFile), zipfile.ZipFile(path) as archive:
            words += [name.lower() for name in archive.namelist()]
    if any("nurec" in word for word in words):
        return "holds a NuRec volume, which only Omniverse reads; export the scene as .ply or ParticleField"
    if any(word in each for each in words for word in ("surfel", "surflet")):
        return f"holds surfels (flat particles), which are not supported; export the scene as .ply or {_SCHEMA}"
    types = sorted({str(prim.GetTypeName()) for prim in held} - {"", "Xform", "Scope"})
    text = f"has no prim of type {_SCHEMA}"
    if types:
        text += f", only {', '.join(types[:4])}"
    if "Mesh" in types:
        text += f": {MESH}"
    elif "Points" in types:
        text += f": {SCAN}"
    return text


def _read_prim(pxr: Any, prim: Any) -> Noted:
    means = _values(pxr, prim, "positions", 3, None)
    count = len(means)
    notes = []
    degree = _earliest(pxr, prim.GetAttribute(f"{_SH}Degree"))
    stored = [_given(pxr, prim, f"{_SH}Coefficients{half}") for half in ("", "h")]
    coefficients = any(values is not None for values in stored)
    if degree is not None and coefficients:
        degree = int(degree)
    else:
        degree = 0
    if not 0 <= degree <= 3:
        raise InputError(f"unsupported SH degree {degree}; expected 0 to 3")
    size = (degree + 1) ** 2
    raw = Raw.empty(count, size - 1)
    raw.means[:] = means * _USD_TURN
    quats = _values(pxr, prim, "orientations", 4, count)
    raw.quats[:] = quats[:, [3, 0, 1, 2]] * _QUAT_TURN
    alphas = _values(pxr, prim, "opacities", 1, count)[:, 0]
    if coefficients:
        values = _values(pxr, prim, f"{_SH}Coefficients", 3, count * size)
        bands = values.reshape(count, size, 3)
        base = bands[:, 0]
        raw.shN[:] = bands[:, 1:] * FLIPS[: size - 1, None]
    else:
        rgb = _values(pxr, prim, _COLOR, 3, None)
        if len(rgb) not in (1, count):
            raise InputError(f"has {len(rgb):,} values, expected {count:,}", property=_COLOR)
        rgb = rgb / choose_white(rgb, (1.0, 255.0))
        base = np.broadcast_to((rgb - 0.5) / SH_C0, (count, 3))
        text = "colours are those of displayColor, taken as sRGB"
        notes.append(Note("display_color", count, text))
    scales = _values(pxr, prim, "scales", 3, count)
    notes += fill_linear(raw, scales, alphas, base)
    if _color_space(pxr, prim).lower().startswith("lin"):
        notes.append(LINEAR_NOTE)
    return cleaned(raw, notes)


def _color_space(pxr: Any, prim: Any) -> str:
    """Return the colour space that the colours, the prim or its closest ancestor name, or an empty string."""
    for name in (f"{_SH}Coefficients", f"{_SH}Coefficientsh", _COLOR):
        attribute = prim.GetAttribute(name)
        if attribute and attribute.HasColorSpace():
            return str(attribute.GetColorSpace())
    while prim:
        name = _earliest(pxr, prim.GetAttribute("colorSpace:name"))
        if name:
            return str(name)
        prim = prim.GetParent()
    return ""


def _earliest(pxr: Any, attribute: Any) -> Any:
    if not attribute:
        return None
    return attribute.Get(pxr.Usd.TimeCode.EarliestTime())


def _given(pxr: Any, prim: Any, name: str) -> Any:
    """Return the earliest value of an attribute with a value in it, or None."""
    values = _earliest(pxr, prim.GetAttribute(name))
    if values is not None and len(values):
        return values
    return None


def _values(
    pxr: Any,
    prim: Any,
    name: str,
    width: int,
    count: int | None,
) -> Float32:
    """Return the (count, width) values of an attribute in float, or in half with an h after its name."""
    for found in (name, f"{name}h"):
        values = _given(pxr, prim, found)
        if values is None:
            continue
        rows = np.asarray(values, np.float32).reshape(-1, width)
        if count is not None and len(rows) != count:
            raise InputError(f"has {len(rows):,} values, expected {count:,}", property=name)
        return rows
    raise InputError(f"attribute {name!r} of {prim.GetPath()} is missing or empty")


def _to_ply(pxr: Any, stage: Any, prim: Any) -> Float:
    """Return the (4, 4) matrix from the prim's flipped axes to the axes of a .ply."""
    cache = pxr.UsdGeom.XformCache(pxr.Usd.TimeCode.EarliestTime())
    world = np.array(cache.GetLocalToWorldTransform(prim)).T  # USD multiplies rows
    flip = np.diag([*_USD_TURN, 1.0])
    upright = np.eye(4)
    if pxr.UsdGeom.GetStageUpAxis(stage) == pxr.UsdGeom.Tokens.z:
        upright[1:3, 1:3] = [[0, 1], [-1, 0]]
    return flip @ upright @ world @ flip


def _pxr() -> Any:
    try:
        import pxr
        from pxr import Gf, Tf, Usd, UsdGeom, UsdVol, Vt  # noqa: F401
    except ImportError as error:
        raise missing("reading OpenUSD, or writing .usdc,", "usd-core") from error
    return pxr
