"""Options of budgets (-n 250k, -r 10, --fit 5MB, --min-psnr 38) and of scenes larger than memory."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import typer

from g2ard.jobs.budget import Budget

_COUNT = re.compile(r"(\d+(?:\.\d+)?)\s*([kKmM%]?)")
_GROUPED = re.compile(r"\d{1,3}(?:,\d{3})+|\d{1,3}(?:_\d{3})+")
_DOTTED = re.compile(r"[1-9]\d{0,2}(?:\.\d{3})+")


@dataclass(frozen=True)
class Count:
    """A count as typed: an absolute one (int), or a share of the scene in (0, 1] (float)."""

    value: int | float
    text: str

    @classmethod
    def parse(cls, text: str, shares: bool = True) -> Count:
        """Read 250000, 250,000, 250_000, 250k, 1.5M or 25%.

        >>> Count.parse("250k").value, Count.parse("25%").value, Count.parse("1.5M").value
        (250000, 0.25, 1500000)
        >>> Count.parse("1,234,567").value, Count.parse("250_000").value
        (1234567, 250000)
        """
        plain = text.strip()
        if _GROUPED.fullmatch(plain):
            plain = re.sub("[,_]", "", plain)
        if _DOTTED.fullmatch(plain):
            bare = plain.replace(".", "")
            raise typer.BadParameter(
                f"dots cannot separate thousands: write {bare} or {int(bare):_}, not {text!r}"
            )
        match = _COUNT.fullmatch(plain)
        if match is None or not float(match[1]) > 0 or (match[2] == "%" and not shares):
            such = "250000, 250k, 1.5M or 25%" if shares else "250000, 250k or 1.5M"
            raise typer.BadParameter(f"expected a positive count such as {such}, got {text!r}")
        number = float(match[1])
        unit = match[2].lower()
        if unit == "%":
            if number > 100:
                raise typer.BadParameter(f"expected at most 100%, got {text!r}")
            return cls(number / 100, text)
        if not unit and "." in match[1]:
            raise typer.BadParameter(
                f"expected a whole number, or a share such as 25%, got {text!r}"
            )
        number *= {"": 1, "k": 1_000, "m": 1_000_000}[unit]
        if number != round(number):
            raise typer.BadParameter(f"expected a whole number, got {text!r}")
        return cls(round(number), text)

    @classmethod
    def parse_absolute(cls, text: str) -> Count:
        """Read an absolute count, as `parse` does.

        >>> Count.parse_absolute("2M").value
        2000000
        """
        return cls.parse(text, shares=False)

    def budget(self) -> Budget:
        if isinstance(self.value, float):
            return Budget(share=self.value)
        return Budget(count=self.value)

    def __str__(self) -> str:
        return self.text


def parse_ratio(text: str) -> float:
    """Read 10 or 10x."""
    try:
        value = float(text.strip().rstrip("xX×"))
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value >= 1):
        raise typer.BadParameter(f"expected a ratio of at least 1, such as 10, got {text!r}")
    return value


class Counts(tuple[Count, ...]):
    """Counts in one argument, 10k,20k. Typer would read a plain tuple as several arguments."""

    @classmethod
    def parse(cls, text: str) -> Counts:
        """Read comma-separated counts; commas before a group such as 000 belong to a single number.

        >>> [count.value for count in Counts.parse("10k,20k")], len(Counts.parse("250,000"))
        ([10000, 20000], 1)
        """
        groups = text.strip().split(",")
        if _GROUPED.fullmatch(text.strip()) and any(group.startswith("0") for group in groups[1:]):
            return cls([Count.parse(text)])
        if any(re.fullmatch(r"0\d\d", group.strip()) for group in groups[1:]):
            raise typer.BadParameter(
                f"commas separate counts: write 5_000,4_000 or 5k,4k, not {text!r}"
            )
        return cls(Count.parse(part) for part in groups)


class Ratios(tuple[float, ...]):
    """Ratios in one argument, 5,10,20."""

    @classmethod
    def parse(cls, text: str) -> Ratios:
        return cls(parse_ratio(part) for part in text.split(","))


BUDGET_FLAGS = "-n COUNT, -r RATIO, --fit, or --min-psnr and --min-ssim"
"""Options of a budget, for messages."""

Options = dict[str, tuple[Any, ...]]
"""Name → type and option, followed by the default of an option that has one."""

BUDGETS: Options = {
    "count": (
        list[Counts],
        typer.Option(
            "-n",
            "--count",
            parser=Counts.parse,
            metavar="COUNT",
            help="Gaussians to keep: 250000, 250k, 1.5M or 25%.",
        ),
    ),
    "ratio": (
        list[Ratios],
        typer.Option(
            "-r",
            "--ratio",
            parser=Ratios.parse,
            metavar="RATIO",
            help="Reduction ratio: 10 keeps a tenth.",
        ),
    ),
    "fit": (
        str,
        typer.Option(
            metavar="5MB|page:10MB|DEVICE",
            help="Largest scene that fits the size of a file or of a page with it, or a device: "
            "quest3, visionpro, android, ios, mobile, web, desktop.",
        ),
    ),
    "min_psnr": (
        float,
        typer.Option(
            min=1, help="Smallest scene with at least this PSNR against the original, dB."
        ),
    ),
    "min_ssim": (
        float,
        typer.Option(min=0.01, max=0.9999, help="Smallest scene with at least this SSIM."),
    ),
}
"""Options of commands with budgets, see `g2ard.cli.command.command`."""

SEVERAL = {
    "count": " Several (10k,20k) need {count} in --output.",
    "ratio": " Several (5,10,20) need {ratio} in --output.",
}
"""Ends of the help texts of commands that take several budgets."""

TILES: Options = {
    "tile_rows": (
        Count,
        typer.Option(
            parser=Count.parse_absolute,
            metavar="COUNT",
            help="Maximum Gaussians per tile; larger scenes are processed in tiles. 5M by default.",
        ),
    ),
    "memory": (
        str,
        typer.Option(metavar="SIZE", help="Memory limit for all workers together, such as 4GB."),
    ),
    "workers": (
        int,
        typer.Option(
            min=1, help="Processes for tiles; by default as many as cores and memory allow."
        ),
    ),
    "scheduler": (
        str,
        typer.Option(
            metavar="ADDRESS",
            help="Dask scheduler for tiles: tcp://HOST:PORT or local (needs the extra `distributed`).",
        ),
    ),
    "work": (
        Path,
        typer.Option(
            metavar="DIR",
            help="Keep tiles and finished steps here, for other budgets; by default in .NAME.tiles beside "
            "the output, until the command succeeds.",
        ),
    ),
}
"""Options of commands that work in tiles, see `g2ard.cli.command.command`."""
