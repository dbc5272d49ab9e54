"""What takes a scene in one piece, and is refused where it is worked on in tiles."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from g2ard.errors import InputError
from g2ard.policy.tile_memory import cut_into

if TYPE_CHECKING:
    from g2ard.policy.budget import Budget
    from g2ard.policy.distill_options import DistillOptions

__all__ = ["refuse_whole", "whole_budgets", "whole_method", "whole_options"]


def refuse_whole(scene: Path, options: Sequence[str]) -> None:
    """Refuse what tiles do not have.

    Args:
        scene: its file, or a folder of tiles.
        options: those that were given and take the scene in one piece, as they are typed.

    Raises:
        InputError: there are some.
    """
    if not options:
        return
    from g2ard.io.stream import open_stream
    from g2ard.tiles.store import MANIFEST

    one = cut_into(scene if (scene / MANIFEST).is_file() else None, open_stream(scene).count)
    takes = "takes" if len(options) == 1 else "take"
    raise InputError(
        f"{scene}: {' and '.join(options)} {takes} the scene in one piece, and it is worked on in tiles; "
        f"{one} gives one piece"
    )


def whole_budgets(budgets: Sequence[Budget]) -> list[str]:
    """Budgets that only the whole scene can tell: bytes and qualities.

    >>> from g2ard.policy.budget import Budget
    >>> whole_budgets([Budget(fit="web")]), whole_budgets([Budget(min_psnr=30, min_ssim=0.9)])
    ([], ['--min-psnr 30', '--min-ssim 0.9'])
    """
    given = {
        name: value
        for budget in budgets
        for name, value in (
            ("--fit", budget.fit if budget.bytes else None),
            ("--min-psnr", budget.min_psnr),
            ("--min-ssim", budget.min_ssim),
        )
    }
    return [f"{name} {value}" for name, value in given.items() if value is not None]


def whole_method(method: str | None, preset: str | None) -> list[str]:
    """A method of simplification other than `default`, or the preset that brings it."""
    if preset is not None and preset.startswith("paper"):
        return [f"--preset {preset}"]
    return [f"--method {method}"] if method not in (None, "default") else []


def whole_options(options: DistillOptions) -> list[str]:
    """Those of a distillation. Renders are what tiles learn from, so that `photos=False` is none of them."""
    whole = whole_method(options.method, options.preset)
    by_preset = bool(whole) and whole[0].startswith("--preset")
    given = {
        "-k": options.views_count is not None and not by_preset,
        "--schedule paper": options.schedule == "paper" and not by_preset,
        "--clean": options.clean,
        "--photos": bool(options.photos),
        "--reselect": options.reselect,
        "--recovery-time": options.recovery_time is not None,
        "--device cuda": options.engine != "fused",
    }
    return whole + [name for name, there in given.items() if there]
