"""Training anew by MCMC at an exact count (Kheradmand et al., 3D Gaussian Splatting as MCMC, 2024).

With `gsplat`, gsplat's rasteriser and strategy train on an NVIDIA GPU; otherwise `g2ard.rasterize`
and the strategy of this module on the CPU. Rates and weights are those of gsplat's trainer for this strategy.
They hold for cameras within a unit sphere, so training is in such coordinates.
"""

from __future__ import annotations

import math
import time
from dataclasses import replace
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from g2ard.config.choices import BLACK, Colour
from g2ard.errors import InputError, require_torch
from g2ard.rendering.renderer import RasterSettings
from g2ard.rendering.targets import Targets, mask_of
from g2ard.scene.cameras import Cameras
from g2ard.scene.samples import evenly_spaced
from g2ard.scene.splats import Splats
from g2ard.scene.transform import transform
from g2ard.stages.recover.loop import draw_views
from g2ard.stages.recover.optimize import Watch

if TYPE_CHECKING:
    from torch import Tensor

_RATES = {
    "means": 1.6e-4,
    "scales": 5e-3,
    "quats": 1e-3,
    "opacities": 5e-2,
    "sh0": 2.5e-3,
    "shN": 1.25e-4,
}
"""Learning rates of Adam; that of the means falls to a hundredth."""
_EXTENT = 1.1
"""Factor of the means' rate: how far cameras reach, and a tenth more."""
_OPACITY, _SIZE = 0.5, 0.1
"""Opacity of a start, and its radius in distances to the nearest points."""
_OPACITY_WEIGHT, _SCALE_WEIGHT, _SSIM_WEIGHT = 0.01, 0.01, 0.2
_SH_DEGREE, _STEPS_PER_DEGREE = 3, 1000
_NEAR = 0.01
_NEIGHBOURS, _ROWS = 3, 1024
"""Neighbours that tell a point's distance, and points whose distances are computed at once."""
_WATCHED = 25
"""Steps between calls of `watch`, for which a GPU has to be waited for."""

_FIRST_MOVE, _LAST_MOVE, _MOVES = 500, 5 / 6, 100
"""First and last step of relocations, the latter as a share of all steps, and steps between them."""
_DEAD, _NOISE, _GATE = 0.005, 5e5, 100.0
"""Opacity from which a Gaussian lives, and strength and steepness of the noise."""
_MOST_COPIES = 51

_SSIM_WINDOW, _SSIM_SIGMA = 11, 1.5
_SSIM_C1, _SSIM_C2 = 0.01**2, 0.03**2

DEVICE = "cuda"
"""torch's name of the device that gsplat uses."""


def has_gsplat() -> bool:
    """Return whether gsplat is installed and there is a GPU for it."""
    if find_spec("gsplat") is None or find_spec("torch") is None:
        return False
    import torch

    return torch.cuda.is_available()


def train(
    prior: Splats,
    count: int,
    targets: Targets,
    steps: int,
    *,
    gsplat: bool = False,
    background: Colour = BLACK,
    seed: int = 0,
    watch: Watch | None = None,
) -> tuple[Splats, float]:
    """Train `count` Gaussians from points of a scene, and return them with the seconds without `watch`.

    Args:
        prior: scene whose centres and colours are the start; nothing else of it is used.
        count: Gaussians of the start and of the result, at most the prior's.
        targets: photos or renders, with cameras in world coordinates.
        steps: steps of one view each, for which the rates are scheduled.
        gsplat: whether to train on an NVIDIA GPU with gsplat, otherwise on the CPU.
        watch: called after every 25th step, as by `g2ard.recover`; its time does not count.

    Raises:
        InputError: more Gaussians than the prior has, or `gsplat` without gsplat or a CUDA device.
        MissingDependencyError: torch is not installed.
    """
    require_torch("training anew")
    import torch

    if gsplat and not has_gsplat():
        raise InputError("gsplat needs an NVIDIA GPU, torch for CUDA, and the package gsplat")
    if not 1 <= count <= len(prior):
        raise InputError(f"count: expected 1 to {len(prior)}, got {count}")
    torch.manual_seed(seed)
    middle, extent = _frame(targets.cameras)
    views = [_tensors(targets, view, gsplat) for view in range(len(targets.cameras))]
    spent, now = 0.0, time.monotonic()
    training = _Training(
        prior, count, _within(targets.cameras, middle, extent), middle, extent, steps, gsplat
    )
    for step in range(steps):
        epoch, turn = divmod(step, len(views))
        if turn == 0:
            order = draw_views(seed, epoch, len(views))
        view = int(order[turn])
        training.step(step, view, *views[view], background)
        if watch is not None and (step + 1) % _WATCHED == 0:
            training.wait()
            spent += time.monotonic() - now
            watch(step + 1, spent, training.splats)
            now = time.monotonic()
    training.wait()
    return training.splats(), spent + time.monotonic() - now


class _Training:
    """Parameters, optimisers and strategy of a run, in coordinates where cameras reach a distance of 1."""

    def __init__(
        self,
        prior: Splats,
        count: int,
        cameras: Cameras,
        middle: NDArray[np.float64],
        extent: float,
        steps: int,
        gpu: bool,
    ) -> None:
        import torch

        device = _device(gpu)
        self._cameras, self._middle, self._extent = cameras, middle, extent
        self._steps, self._gpu = steps, gpu
        self._settings = RasterSettings(antialiased=False, near=_NEAR)
        rows = evenly_spaced(len(prior), count)
        means = (prior.means[rows].astype(np.float64) + prior.offset - middle) / extent
        points = torch.tensor(means, dtype=torch.float32, device=device)
        colours = torch.tensor(prior.sh0[rows], dtype=torch.float32, device=device)
        start = {
            "means": points,
            "scales": (_SIZE * _distances(points)).clamp_min(1e-9).log()[:, None].repeat(1, 3),
            "quats": torch.nn.functional.normalize(
                torch.randn(count, 4, device=points.device), dim=1
            ),
            "opacities": torch.logit(torch.full((count,), _OPACITY, device=points.device)),
            "sh0": colours,
            "shN": torch.zeros(count, (_SH_DEGREE + 1) ** 2 - 1, 3, device=points.device),
        }
        self._values: Any = torch.nn.ParameterDict(
            {name: torch.nn.Parameter(value.contiguous()) for name, value in start.items()}
        )
        rates = {**_RATES, "means": _RATES["means"] * _EXTENT}
        self._optimizers = {
            name: torch.optim.Adam(
                [{"params": self._values[name], "lr": rate, "name": name}], eps=1e-15, fused=True
            )
            for name, rate in rates.items()
        }
        self._strategy = _strategy(gpu, count, round(_LAST_MOVE * steps))
        self._strategy.check_sanity(self._values, self._optimizers)
        self._state = self._strategy.initialize_state()

    def step(
        self, step: int, view: int, target: Tensor, mask: Tensor | None, background: Colour
    ) -> None:
        """Take one step on a view, then let the strategy relocate and perturb Gaussians."""
        values = self._values
        known = (min(step // _STEPS_PER_DEGREE, _SH_DEGREE) + 1) ** 2 - 1
        parameters = {
            "means": values["means"],
            "quats": values["quats"],
            "log_scales": values["scales"],
            "logit_opacities": values["opacities"],
            "sh0": values["sh0"],
            "shN": values["shN"][:, :known],
        }
        image = self._rendered(parameters, view, background)
        if mask is not None:
            image, target = image * mask, target * mask
        loss = l1_ssim(image, target, _SSIM_WEIGHT)
        loss = loss + _OPACITY_WEIGHT * values["opacities"].sigmoid().mean()
        loss = loss + _SCALE_WEIGHT * values["scales"].exp().mean()
        loss.backward()
        rate = _RATES["means"] * _EXTENT * 0.01 ** ((step + 1) / self._steps)
        for optimizer in self._optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        self._optimizers["means"].param_groups[0]["lr"] = rate
        self._strategy.step_post_backward(values, self._optimizers, self._state, step, {}, lr=rate)

    def _rendered(self, parameters: dict[str, Tensor], view: int, background: Colour) -> Tensor:
        if self._gpu:
            return _rasterized(parameters, self._cameras, view, background, self._settings)
        from g2ard.stages.recover.rasterize import rasterize

        image, _, _ = rasterize(
            **parameters,
            cameras=self._cameras,
            index=view,
            background=background,
            settings=self._settings,
        )
        return image

    def wait(self) -> None:
        """Wait for a GPU that is at work."""
        import torch

        if torch.cuda.is_available():
            torch.cuda.synchronize()

    def splats(self) -> Splats:
        """Return the scene in world coordinates."""
        arrays = {name: value.detach().cpu().numpy() for name, value in self._values.items()}
        scene = Splats.create(
            arrays["means"],
            quats=arrays["quats"],
            scales=np.exp(arrays["scales"]),
            logit_opacities=arrays["opacities"],
            sh0=arrays["sh0"],
            shN=arrays["shN"],
        )
        world = np.diag([self._extent] * 3 + [1.0])
        world[:3, 3] = self._middle
        return transform(scene, world)


class _Strategy:
    """Relocation and noise as in the paper (eqs. 8 and 9), with the interface of gsplat's `MCMCStrategy`."""

    def __init__(self, last_move: int) -> None:
        self._last_move = last_move

    def check_sanity(self, values: Any, optimizers: Any) -> None:
        """Do nothing; `_Training` has made them fit."""

    def initialize_state(self) -> dict[str, Any]:
        """Return the coefficients of `relocated`."""
        import torch

        coefficients = torch.zeros(_MOST_COPIES, _MOST_COPIES, dtype=torch.float64)
        for copies in range(1, _MOST_COPIES + 1):
            for k in range(copies):
                found = sum(math.comb(i - 1, k) for i in range(k + 1, copies + 1))
                coefficients[copies - 1, k] = found * (-1) ** k / math.sqrt(k + 1)
        return {"coefficients": coefficients}

    def step_post_backward(
        self, values: Any, optimizers: Any, state: dict[str, Any], step: int, info: Any, lr: float
    ) -> None:
        """Move dead Gaussians onto living ones every 100th step, then add noise to all means."""
        import torch

        with torch.no_grad():
            if _FIRST_MOVE < step < self._last_move and step % _MOVES == 0:
                _relocate(values, optimizers, state["coefficients"])
            opacities = values["opacities"].sigmoid()
            gate = torch.sigmoid(-_GATE * (opacities - _DEAD))
            noise = torch.randn_like(values["means"]) * (gate * lr * _NOISE)[:, None]
            turns = _rotations(values["quats"])
            variances = (2 * values["scales"]).exp()
            values["means"] += (turns @ (variances * (noise[:, None] @ turns)[:, 0])[..., None])[
                ..., 0
            ]


def _device(gpu: bool) -> str:
    return DEVICE if gpu else "cpu"


def _strategy(gpu: bool, count: int, last_move: int) -> Any:
    """Return gsplat's strategy for a GPU, or this module's for the CPU."""
    if not gpu:
        return _Strategy(last_move)
    from gsplat import MCMCStrategy

    return MCMCStrategy(
        cap_max=count,
        noise_lr=_NOISE,
        refine_start_iter=_FIRST_MOVE,
        refine_stop_iter=last_move,
        refine_every=_MOVES,
        min_opacity=_DEAD,
    )


def _rasterized(
    parameters: dict[str, Tensor],
    cameras: Cameras,
    view: int,
    background: Any,
    settings: RasterSettings,
) -> Tensor:
    """Render one view (H, W, 3) with gsplat on an NVIDIA GPU, differentiably.

    Args:
        parameters: means, quats, log_scales, logit_opacities, sh0 and shN, on the device.
        settings: only the near plane and antialiasing; gsplat has its own conventions.
    """
    import torch
    from gsplat import rasterization

    device = parameters["means"].device
    coefficients = torch.cat([parameters["sh0"], parameters["shN"]], 1)
    image, _, _ = rasterization(
        means=parameters["means"],
        quats=parameters["quats"],
        scales=parameters["log_scales"].exp(),
        opacities=parameters["logit_opacities"].sigmoid(),
        colors=coefficients,
        viewmats=torch.from_numpy(cameras.viewmats[view]).float().to(device)[None],
        Ks=torch.from_numpy(cameras.Ks[view]).float().to(device)[None],
        width=int(cameras.widths[view]),
        height=int(cameras.heights[view]),
        sh_degree=round(coefficients.shape[1] ** 0.5) - 1,
        backgrounds=torch.tensor([background], dtype=torch.float32, device=device),
        near_plane=settings.near_of(view),
        rasterize_mode="antialiased" if settings.antialiased else "classic",
        packed=False,
    )
    return image[0]


def l1_ssim(image: Tensor, target: Tensor, ssim_weight: float) -> Tensor:
    """Compute `g2ard.stages.recover.losses.l1_ssim` with torch operations, on any device."""
    import torch
    from torch.nn.functional import conv2d

    x, y = (t.permute(2, 0, 1)[:, None] for t in (image, target))
    offsets = torch.arange(_SSIM_WINDOW, device=image.device, dtype=image.dtype) - _SSIM_WINDOW // 2
    weights = torch.exp(-(offsets**2) / (2 * _SSIM_SIGMA**2))
    weights = weights / weights.sum()

    def blurred(t: Tensor) -> Tensor:
        t = conv2d(t, weights.view(1, 1, 1, -1), padding=(0, _SSIM_WINDOW // 2))
        return conv2d(t, weights.view(1, 1, -1, 1), padding=(_SSIM_WINDOW // 2, 0))

    mean_x, mean_y = blurred(x), blurred(y)
    var_x = (blurred(x * x) - mean_x**2).clamp_min(0)
    var_y = (blurred(y * y) - mean_y**2).clamp_min(0)
    both = blurred(x * y) - mean_x * mean_y
    above = (2 * mean_x * mean_y + _SSIM_C1) * (2 * both + _SSIM_C2)
    ssim = above / ((mean_x**2 + mean_y**2 + _SSIM_C1) * (var_x + var_y + _SSIM_C2))
    return ((1 - ssim_weight) * (x - y).abs() + ssim_weight * (1 - ssim)).mean()


def _relocate(values: Any, optimizers: Any, coefficients: Tensor) -> None:
    """Move dead Gaussians onto living ones drawn by opacity; all copies of one look as it did alone."""
    import torch

    opacities = values["opacities"].sigmoid()
    dead, living = (torch.nonzero(mask)[:, 0] for mask in (opacities <= _DEAD, opacities > _DEAD))
    if not len(dead) or not len(living):
        return
    onto = living[torch.multinomial(opacities[living], len(dead), replacement=True)]
    copies = torch.bincount(onto, minlength=len(opacities))[onto] + 1
    opacity, shrink = relocated(opacities[onto], copies, coefficients)
    values["opacities"][onto] = torch.logit(opacity.clamp(_DEAD, 1 - 1e-7))
    values["scales"][onto] += shrink.log()[:, None]
    for name, value in values.items():
        value[dead] = value[onto]
        for moment in optimizers[name].state[value].values():
            if moment.shape == value.shape:
                moment[onto] = 0


def relocated(opacities: Tensor, copies: Tensor, coefficients: Tensor) -> tuple[Tensor, Tensor]:
    """Return the opacity of each of several equal Gaussians that replace one, and the factor of their scales.

    Together they take the light of the one at its centre, 1 − (1 − o′)ⁿ = o, and over its extent (eq. 9).

    Args:
        opacities: (M,) opacities of Gaussians to replace.
        copies: (M,) counts of Gaussians that replace them, cut at 51.
        coefficients: those of `_Strategy.initialize_state`.

    >>> import torch
    >>> table = _Strategy(0).initialize_state()["coefficients"]
    >>> opacity, shrink = relocated(torch.tensor([0.75, 0.75]), torch.tensor([1, 2]), table)
    >>> opacity.tolist(), [round(factor, 4) for factor in shrink.tolist()]
    ([0.75, 0.5], [1.0, 0.9111])
    """
    import torch

    copies = copies.clamp(max=len(coefficients))
    before = opacities.double()
    after = 1 - (1 - before) ** (1 / copies)
    powers = after[:, None] ** torch.arange(1, len(coefficients) + 1)
    shrink = before / (coefficients[copies - 1] * powers).sum(dim=1)
    return after.float(), shrink.float()


def _rotations(quats: Tensor) -> Tensor:
    """Return the (N, 3, 3) rotations of quaternions wxyz of any length."""
    import torch

    w, x, y, z = torch.nn.functional.normalize(quats, dim=1).unbind(1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)


def _frame(cameras: Cameras) -> tuple[NDArray[np.float64], float]:
    """Return the middle of the cameras, and the distance of the farthest from it."""
    positions = cameras.positions
    middle = positions.mean(axis=0)
    extent = float(np.linalg.norm(positions - middle, axis=1).max())
    return middle, extent or 1.0


def _within(cameras: Cameras, middle: NDArray[np.float64], extent: float) -> Cameras:
    """Return the cameras relative to `middle`, in units of `extent`."""
    viewmats = cameras.recentred(middle).viewmats.copy()
    viewmats[:, :3, 3] /= extent
    return replace(cameras, viewmats=viewmats)


def _tensors(targets: Targets, view: int, gpu: bool) -> tuple[Tensor, Tensor | None]:
    """Return the target of a view and its (H, W, 1) mask, if it has one, on the device."""
    import torch

    mask, device = mask_of(targets, view), _device(gpu)
    image = torch.tensor(targets[view], dtype=torch.float32, device=device)
    if mask is None:
        return image, None
    return image, torch.tensor(mask, dtype=torch.float32, device=device)[..., None]


def _distances(points: Tensor) -> Tensor:
    """Return the root mean square distance of each point to its nearest neighbours."""
    import torch

    near = min(_NEIGHBOURS + 1, len(points))
    found: list[Tensor] = []
    for first in range(0, len(points), _ROWS):
        part = torch.cdist(points[first : first + _ROWS], points)
        found.append(part.topk(near, largest=False).values[:, 1:].square().mean(dim=1).sqrt())
    return torch.cat(found)
