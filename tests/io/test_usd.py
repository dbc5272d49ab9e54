"""OpenUSD as written, read by a parser of the test's own and by usd-core where it is installed."""

import ast
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from g2ard.errors import InputError
from g2ard.io import read_splats, write_splats
from g2ard.io.packing import unit_quats
from g2ard.rendering.renderer import Renderer
from g2ard.scene.cameras import Camera
from g2ard.scene.splats import Splats
from g2ard.scene.transform import transform
from helpers import ply_files
from helpers.faults import faulty
from helpers.opened import read_scene
from reference.rotations import covariances


def scene(degree: int = 3, offset: tuple[float, float, float] = (0, 0, 0)) -> Splats:
    made = ply_files.scene(40, degree, degree, offset)
    return replace(made, means=made.means.astype(np.float32))


def attributes(path: Path) -> dict[str, np.ndarray]:
    """Parse the numbers of a .usda with one prim."""
    lines = re.findall(
        r"^    (?:uniform )?(?!uniform)(\S+) (\S+) = (.*)$", path.read_text(), re.MULTILINE
    )
    return {
        name: np.array(ast.literal_eval(v), float) for kind, name, v in lines if "token" not in kind
    }


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_usda_holds_the_scene_with_y_up(tmp_path: Path, degree: int) -> None:
    truth = scene(degree, (443_000.0, 5_411_000.5, 120.25))
    write_splats(tmp_path / "a.usda", truth)
    found = attributes(tmp_path / "a.usda")
    half = np.diag([1.0, -1, -1, 1])
    turned = transform(replace(truth, offset=np.zeros(3)), half)
    np.testing.assert_array_equal(found["positions"].astype(np.float32), turned.means)
    np.testing.assert_array_equal(found["scales"].astype(np.float32), truth.scales)
    np.testing.assert_array_equal(found["opacities"].astype(np.float32), truth.opacities)
    np.testing.assert_array_equal(found["xformOp:translate"], [443_000.0, -5_411_000.5, -120.25])
    np.testing.assert_allclose(np.linalg.norm(found["orientations"], axis=1), 1, atol=1e-6)
    spread = covariances(found["orientations"], found["scales"])
    np.testing.assert_allclose(spread, covariances(turned.quats, turned.scales), atol=1e-7)
    harmonics = found["radiance:sphericalHarmonicsCoefficients"].reshape(40, -1, 3)
    assert found["radiance:sphericalHarmonicsDegree"] == degree
    np.testing.assert_allclose(harmonics[:, 1:], turned.shN, atol=1e-6)
    np.testing.assert_array_equal(harmonics[:, :1].astype(np.float32), truth.sh0)
    assert (found["extent"][0] <= turned.means.min(0)).all()
    assert (found["extent"][1] >= turned.means.max(0)).all()


@pytest.mark.parametrize("name", ["a.usda", "a.usdc"])
@pytest.mark.parametrize("degree", [0, 2, 3])
def test_usd_core_reads_every_value_back(tmp_path: Path, name: str, degree: int) -> None:
    pytest.importorskip("pxr")
    from pxr import Usd, UsdValidation

    truth = scene(degree, (443_000.0, 5_411_000.5, 120.25))
    write_splats(tmp_path / name, truth)
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    stage = Usd.Stage.Open(str(tmp_path / name))
    assert not UsdValidation.ValidationContext(validators).Validate(stage)
    found = read_splats(tmp_path / name)
    for field in ("means", "sh0", "shN", "offset"):
        np.testing.assert_array_equal(getattr(found, field), getattr(truth, field))
    np.testing.assert_allclose(found.scales, truth.scales, rtol=1e-5)
    np.testing.assert_allclose(found.opacities, truth.opacities, atol=1e-6)
    np.testing.assert_allclose(unit_quats(found.quats), unit_quats(truth.quats), atol=1e-6)


def test_a_stage_with_z_up_and_a_turned_parent_looks_the_same(tmp_path: Path) -> None:
    pytest.importorskip("pxr")
    truth = scene(3)
    write_splats(tmp_path / "a.usda", truth)
    text = (tmp_path / "a.usda").read_text().replace('upAxis = "Y"', 'upAxis = "Z"')
    turn = (
        "    double xformOp:rotateX = 90\n"
        + '    uniform token[] xformOpOrder = ["xformOp:rotateX"]\n'
    )
    (tmp_path / "b.usda").write_text(text.rstrip().rstrip("}") + turn + "}\n")
    camera = Camera.facing([0.5, 0.3, -6], [0, 0, 0], width=64, height=64, fov=50)
    wanted, got = (
        Renderer(s).render(camera).image for s in (truth, read_splats(tmp_path / "b.usda"))
    )
    np.testing.assert_allclose(got, wanted, atol=1e-4)


def prims(folder: Path, *fields: str, world: str = "") -> Path:
    head = '#usda 1.0\n(\n    defaultPrim = "W"\n    upAxis = "Y"\n)\ndef Xform "W"\n{\n'
    (folder / "b.usda").write_text(head + world + "".join(fields) + "}\n")
    return folder / "b.usda"


def prim(
    folder: Path, name: str, truth: Splats, more: str = "", word: str = "def", meta: str = ""
) -> str:
    write_splats(folder / "one.usda", truth, overwrite=True)
    body = (folder / "one.usda").read_text().partition("\n{\n")[2].rstrip().removesuffix("}")
    return f'{word} ParticleField3DGaussianSplat "{name}" {meta}\n{{\n{body}{more}}}\n'


def op(kind: str, *values: float) -> str:
    listed = f"({', '.join(map(str, values))})"
    return f'double3 xformOp:{kind} = {listed}\nuniform token[] xformOpOrder = ["xformOp:{kind}"]\n'


HIDDEN = 'token visibility = "invisible"\n'


@pytest.mark.parametrize("count", [2, 3])
@pytest.mark.parametrize("hidden", [0, 1])
def test_all_visible_prims_are_joined(tmp_path: Path, count: int, hidden: int) -> None:
    pytest.importorskip("pxr")
    parts = [scene(k) for k in range(count)]
    text = [
        prim(tmp_path, f"p{k}", part, op("translate", 4 * k, 0, 0)) for k, part in enumerate(parts)
    ]
    text += [prim(tmp_path, f"h{k}", scene(1), HIDDEN) for k in range(hidden)]
    found = read_scene(prims(tmp_path, *text))
    assert [note.code for note in found.notes] == ["invisible_prims"] * hidden
    whole = np.concatenate([part.means + np.array([4.0 * k, 0, 0]) for k, part in enumerate(parts)])
    np.testing.assert_allclose(found.splats.means + found.splats.offset, whole, atol=1e-5)
    assert found.splats.sh_degree == max(part.sh_degree for part in parts)


def test_a_placement_that_flattens_names_the_file(tmp_path: Path) -> None:
    pytest.importorskip("pxr")
    path = prims(tmp_path, prim(tmp_path, "a", scene(0), op("scale", 1, 0, 1)))
    with faulty(path, "flattens"):
        read_scene(path)


def test_instances_and_the_earliest_time_are_read(tmp_path: Path) -> None:
    pytest.importorskip("pxr")
    truth = scene(1)
    proto = f'class "proto"\n{{\n{prim(tmp_path, "a", truth)}}}\n'
    meta = "(\n instanceable = true\n references = </W/proto>\n)"
    places = [f'def Xform "i{k}" {meta}\n{{\n{op("translate", 3 + k, 0, 0)}}}\n' for k in range(2)]
    found = read_splats(prims(tmp_path, *places, world=proto))
    whole = np.concatenate([truth.means + np.array([3.0 + k, 0, 0]) for k in range(2)])
    np.testing.assert_allclose(found.means + found.offset, whole, atol=1e-5)
    late = replace(truth, means=truth.means + 5)
    values = [re.search(r"positions = (\[.*\])", prim(tmp_path, "a", s))[1] for s in (truth, late)]
    text = prim(tmp_path, "a", truth).replace(
        f"positions = {values[0]}", f"positions.timeSamples = {{ 2: {values[0]}, 7: {values[1]} }}"
    )
    np.testing.assert_allclose(read_splats(prims(tmp_path, text)).means, truth.means, atol=1e-6)


@pytest.mark.parametrize(
    "space", ["lin_rec709_scene", "lin_rec2020_scene", "linear", "srgb_rec709_scene"]
)
@pytest.mark.parametrize("of", ["prim", "parent", "colours"])
def test_linear_colours_are_noted(tmp_path: Path, space: str, of: str) -> None:
    pytest.importorskip("pxr")
    named, api = (
        f'uniform token colorSpace:name = "{space}"\n',
        '( prepend apiSchemas = ["ColorSpaceAPI"] )',
    )
    text = prim(tmp_path, "a", scene(1), *([named, "def", api] if of == "prim" else []))
    if of == "parent":
        text = f'def Xform "p" {api}\n{{\n{named}{text}}}\n'
    elif of == "colours":
        text = re.sub(r"(Coefficients = .*)", rf'\1 ( colorSpace = "{space}" )', text)
    codes = [note.code for note in read_scene(prims(tmp_path, text)).notes]
    assert codes == ["linear_colors"] * space.startswith("lin")


def test_what_a_stage_holds_instead_is_named(tmp_path: Path) -> None:
    pytest.importorskip("pxr")
    surflet = '( prepend apiSchemas = ["ParticleFieldKernelGaussianSurfletAPI"] )'
    for text, message in (
        ('def Volume "v"\n{\n custom asset omni:nurec:data = @m.nurec@\n}\n', "NuRec"),
        ('def Volume "v"\n{\n def OmniNuRecFieldAsset "f"\n {\n }\n}\n', "NuRec"),
        (f'def ParticleField "f" {surflet}\n{{\n}}\n', "surfels"),
        ('def Mesh "m"\n{\n}\n', "only Mesh"),
    ):
        with pytest.raises(InputError, match=message):
            read_scene(prims(tmp_path, text))
    with pytest.raises(InputError, match="all invisible"):
        read_scene(prims(tmp_path, prim(tmp_path, "a", scene(0), HIDDEN)))
    (tmp_path / "c.usda").write_text('#usda 1.0\ndef Xform "W"\n{\n    float[] a = [1, 2\n}\n')
    with faulty(tmp_path / "c.usda", (None, 5)):
        read_scene(tmp_path / "c.usda")


def test_a_nurec_archive_is_named(tmp_path: Path) -> None:
    pytest.importorskip("pxr")
    from pxr import Sdf, Usd

    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    stage.DefinePrim("/v", "Volume")
    stage.GetRootLayer().Save()
    (tmp_path / "model.nurec").write_bytes(b"x")
    with Sdf.ZipFileWriter.CreateNew(str(tmp_path / "a.usdz")) as archive:
        for name in ("a.usda", "model.nurec"):
            archive.AddFile(str(tmp_path / name), name)
    with pytest.raises(InputError, match="NuRec"):
        read_scene(tmp_path / "a.usdz")


def test_a_field_is_known_by_its_kernel(tmp_path: Path) -> None:
    pytest.importorskip("pxr")
    truth = scene(2)
    kernel = "ParticleFieldKernelGaussianEllipsoidAPI"
    text = prim(tmp_path, "a", truth, meta=f'( prepend apiSchemas = ["{kernel}"] )')
    path = prims(tmp_path, text.replace("ParticleField3DGaussianSplat", "ParticleField"))
    np.testing.assert_allclose(read_splats(path).shN, truth.shN, atol=1e-6)
