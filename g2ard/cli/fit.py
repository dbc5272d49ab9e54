"""Budgets as people have them: --fit 5MB, --fit quest3, --min-psnr 38, for commands that reduce a scene."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import typer

from g2ard.cli.options import Count, budget_of, one_budget

if TYPE_CHECKING:
    from pathlib import Path

    from g2ard.cli.frame import Run
    from g2ard.splats import Splats

__all__ = [
    "Asked",
    "FitOption",
    "MinPsnrOption",
    "MinSsimOption",
    "asked_budget",
    "check_budget",
    "shrunk_to_fit",
]

_BYTES = re.compile(r"(\d+(?:\.\d+)?)\s*([kKmMgG])[bB]")
_VIEWS, _SIDE = 12, 400

FitOption = Annotated[
    str | None,
    typer.Option("--fit", metavar="5MB|quest3|mobile|web", help="Budget: bytes of the file, or a device."),
]
MinPsnrOption = Annotated[
    float | None,
    typer.Option(min=1, help="Budget: the fewest that keep this PSNR, dB, against the scene itself."),
]
MinSsimOption = Annotated[
    float | None, typer.Option(min=0.01, max=0.9999, help="Budget: the fewest that keep this SSIM.")
]


@dataclass(frozen=True)
class Asked:
    """A budget that was asked for.

    Args:
        count: the Gaussians it means.
        judge: says what a scene gives of it; ends with status 3 where it asks for a quality that is not met.
    """

    count: int
    judge: Callable[[Splats], None]


def check_budget(
    count: Count | None,
    ratio: float | None,
    fit: str | None,
    min_psnr: float | None,
    min_ssim: float | None,
) -> None:
    """Usage check: one kind of budget, which makes sense."""
    wanted = min_psnr is not None or min_ssim is not None
    if (fit is not None) + wanted == 0:
        one_budget(count, ratio)
        return
    if (count, ratio) != (None, None) or (fit is not None and wanted):
        raise typer.BadParameter("give one budget: -n, -r, --fit, or --min-psnr and --min-ssim")
    if fit is not None:
        _bytes_of(fit)


def _bytes_of(fit: str) -> int | None:
    """Bytes, or None where a device is named.

    >>> _bytes_of("1.5MB"), _bytes_of("quest3")
    (1500000, None)
    """
    from g2ard.budget import DEVICES

    if fit.lower() in DEVICES:
        return None
    match = _BYTES.fullmatch(fit.strip())
    if match is None or not float(match[1]) > 0:
        raise typer.BadParameter(f"--fit: bytes such as 5MB or 800kB, or {', '.join(DEVICES)}, not {fit!r}")
    return round(float(match[1]) * {"k": 1e3, "m": 1e6, "g": 1e9}[match[2].lower()])


def asked_budget(
    run: Run,
    scene: Path,
    splats: Splats,
    name: str,
    count: Count | None,
    ratio: float | None,
    fit: str | None,
    min_psnr: float | None,
    min_ssim: float | None,
) -> Asked:
    """What a budget means for a scene; a line says it.

    Args:
        run: told.
        scene: where it is from.
        splats: the scene.
        name: of the file that is to be written.
        count: -n.
        ratio: -r.
        fit: --fit.
        min_psnr: --min-psnr.
        min_ssim: --min-ssim.

    Raises:
        InputError: the budget is above the scene's count, or nothing meets it.
    """
    if min_psnr is not None or min_ssim is not None:
        return _by_quality(run, splats, min_psnr or 0.0, min_ssim or 0.0)
    if fit is None:
        return Asked(budget_of(scene, count, ratio, len(splats)), lambda _: None)
    from g2ard.budget import DEVICES, count_for_bytes

    wanted = _bytes_of(fit)
    if wanted is None:
        found = min(DEVICES[fit.lower()], len(splats))
    else:
        found = count_for_bytes(splats, wanted, name, _fast)
    run.say(f"--fit {fit}: {'' if wanted is None else 'about '}{found:,} Gaussians")
    return Asked(found, lambda _: None)


def _by_quality(run: Run, splats: Splats, min_psnr: float, min_ssim: float) -> Asked:
    import numpy as np

    from g2ard.budget import Quality, count_for_quality, quality
    from g2ard.poses import plan_pool
    from g2ard.render import Renderer

    wanted = Quality(min_psnr, min_ssim)
    pool = plan_pool(splats, _VIEWS, seed=run.seed, rows=100_000, looks=True, progress=run.progress)
    cameras = pool.cameras.resized(_SIDE)
    found, near = count_for_quality(splats, wanted, cameras, _fast)
    run.say(f"{found:,} Gaussians should keep {near.psnr:.2f} dB, SSIM {near.ssim:.4f}")

    def judge(made: Splats) -> None:
        whole = Renderer(splats)
        renders = [np.clip(whole.image(cameras, i), 0, 1) for i in range(len(cameras))]
        got = quality(renders, made, cameras)
        told = f"{len(made):,} Gaussians: {got.psnr:.2f} dB, SSIM {got.ssim:.4f} in {len(cameras)} views"
        if not got.meets(wanted):
            run.unmet(f"{told}, which is less than was asked; give -n with more than {len(made):,}")
        run.say(told)

    return Asked(found, judge)


def _fast(splats: Splats, count: int) -> Splats:
    from g2ard.simplify import simplify

    return simplify(splats, count, method="fast").splats


def shrunk_to_fit(run: Run, splats: Splats, fit: str | None, name: str) -> Splats:
    """The scene, merged on by as much as its file would be too large for --fit."""
    from g2ard.budget import file_bytes

    wanted = None if fit is None else _bytes_of(fit)
    while wanted is not None and (size := file_bytes(splats, name)) > wanted:
        fewer = max(1, int(len(splats) * wanted / size * 0.99))
        run.say(f"{size:,} bytes: merged on from {len(splats):,} to {fewer:,} Gaussians")
        if fewer == len(splats):
            break
        splats = _fast(splats, fewer)
    return splats
