"""OpenUSD as written, read by a parser of the test's own and by usd-core where it is installed."""

import ast
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from g2ard.io import read_splats, write_splats
from g2ard.io.packing import unit_quats
from g2ard.rendering.renderer import Renderer
from g2ard.scene.cameras import Camera
from g2ard.scene.splats import Splats
from g2ard.scene.transform import transform
from reference.rotations import covariances


def scene(degree: int = 3, offset: tuple[float, float, float] = (0, 0, 0)) -> Splats:
    rng = np.random.default_rng(degree)
    return Splats.create(
        rng.normal(size=(40, 3)).astype(np.float32),
        quats=rng.normal(size=(40, 4)),
        scales=rng.uniform(0.05, 0.4, (40, 3)),
        logit_opacities=rng.normal(size=40),
        sh0=rng.normal(size=(40, 1, 3)),
        shN=rng.normal(0, 0.3, (40, (degree + 1) ** 2 - 1, 3)),
        offset=offset,
    )


def attributes(path: Path) -> dict[str, np.ndarray]:
    """Parse the numbers of a .usda with one prim."""
    lines = re.findall(r"^    (?:uniform )?(?!uniform)(\S+) (\S+) = (.*)$", path.read_text(), re.MULTILINE)
    return {name: np.array(ast.literal_eval(v), float) for kind, name, v in lines if "token" not in kind}


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
    turn = "    double xformOp:rotateX = 90\n" + '    uniform token[] xformOpOrder = ["xformOp:rotateX"]\n'
    (tmp_path / "b.usda").write_text(text.rstrip().rstrip("}") + turn + "}\n")
    camera = Camera.facing([0.5, 0.3, -6], [0, 0, 0], width=64, height=64, fov=50)
    wanted, got = (Renderer(s).render(camera).image for s in (truth, read_splats(tmp_path / "b.usda")))
    np.testing.assert_allclose(got, wanted, atol=1e-4)
