"""Random scenes and settings for the rasteriser."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from g2ard.rendering.renderer import RasterSettings
from g2ard.scene.cameras import Cameras, look_at
from g2ard.scene.splats import Splats
from reference import raster as reference

NAMES = ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN")
Params = dict[str, NDArray[Any]]


def scene(seed: int, n: int, degree: int = 3, *, size: float = 0.1, spread: float = 1.0) -> Params:
    """Random Gaussians around the origin, anisotropic, every colour channel lively."""
    rng = np.random.default_rng(seed)
    rest = (degree + 1) ** 2 - 1
    values = {
        "means": rng.normal(size=(n, 3)) * spread,
        "quats": rng.normal(size=(n, 4)) * np.exp(rng.normal(size=(n, 1))),
        "log_scales": np.log(size) + rng.normal(size=(n, 3)) * 0.8,
        "logit_opacities": rng.normal(size=n) * 2,
        "sh0": rng.normal(size=(n, 1, 3)),
        "shN": rng.normal(size=(n, rest, 3)) * 0.3,
    }
    return {k: v.astype(np.float32) for k, v in values.items()}


def camera(
    width: int, height: int, *, distance: float = 4.0, off: float = 0.0, seed: int = 0
) -> Cameras:
    rng = np.random.default_rng(seed)
    eye = rng.normal(size=3)
    eye *= distance / np.linalg.norm(eye)
    f = 0.9 * max(width, height)
    K = [[f, 0, width / 2 + off * width], [0, 1.1 * f, height / 2 - off * height], [0, 0, 1]]
    return Cameras.from_lists(
        [look_at(eye, rng.normal(size=3) * 0.2)], [K], [(width, height)], ["v"]
    )


def splats_of(p: Params) -> Splats:
    return Splats(
        means=p["means"],
        quats=p["quats"],
        scales=np.exp(p["log_scales"]),
        logit_opacities=p["logit_opacities"],
        sh0=p["sh0"],
        shN=p["shN"],
    )


def tensors_of(p: Params) -> list[torch.Tensor]:
    return [torch.from_numpy(p[k]).requires_grad_() for k in NAMES]


VARIANTS = {
    "default": RasterSettings(antialiased=False),
    "antialiased": RasterSettings(antialiased=True),
    "inria": RasterSettings(convention="inria", antialiased=False),
    "inria-antialiased": RasterSettings(convention="inria", antialiased=True),
    "clip-0.999": RasterSettings(antialiased=False, alpha_max=0.999, near=0.5),
}


def oracle(
    p: Params,
    cameras: Cameras,
    settings: RasterSettings,
    background: Any,
    *,
    grad: bool = False,
    clip_margin: float = 1e-4,
) -> tuple[reference.Oracle, list[torch.Tensor]]:
    """Return the naive render of a scene from its first view, and the tensors."""
    tensors = [torch.from_numpy(p[k].astype(np.float64)).requires_grad_(grad) for k in NAMES]
    out = reference.render(
        *tensors,
        viewmat=torch.from_numpy(cameras.viewmats[0]),
        K=torch.from_numpy(cameras.Ks[0]),
        width=int(cameras.widths[0]),
        height=int(cameras.heights[0]),
        near=settings.near_of(0),
        background=background,
        antialiased=bool(settings.antialiased),
        inria=settings.convention == "inria",
        alpha_max=settings.alpha_max,
        clip_margin=clip_margin,
    )
    return out, tensors


def gsplat_rasterization(**given: Any) -> tuple[torch.Tensor, None, None]:
    """Render gsplat's documented arguments with the naive oracle."""
    assert given["packed"] is False
    assert given["colors"].shape[1] == (given["sh_degree"] + 1) ** 2
    out = reference.render(
        *(given[name].double() for name in ("means", "quats")),
        given["scales"].double().log(),
        torch.logit(given["opacities"].double()),
        given["colors"][:, :1].double(),
        given["colors"][:, 1:].double(),
        viewmat=given["viewmats"][0].double(),
        K=given["Ks"][0].double(),
        width=given["width"],
        height=given["height"],
        background=tuple(given["backgrounds"][0].tolist()),
    )
    return out.image[None].float(), None, None
