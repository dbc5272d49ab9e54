"""Budgets by what people have: --fit 5MB, --fit quest3, --min-psnr 38."""

from __future__ import annotations

from typing import Annotated

import typer

__all__ = ["FitOption", "MinPsnrOption", "MinSsimOption"]

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
