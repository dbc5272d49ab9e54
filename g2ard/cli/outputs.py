"""Where results go: one place for each budget, named by a pattern where there are several."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from g2ard.cli.frame import Run
from g2ard.cli.usage import in_flags

if TYPE_CHECKING:
    from g2ard.cli.budget_options import Counts, Ratios
    from g2ard.policy.budget import Budget


def budgets_of(
    counts: list[Counts] | None,
    ratios: list[Ratios] | None,
    fit: str | None = None,
    min_psnr: float | None = None,
    min_ssim: float | None = None,
) -> list[Budget]:
    """Usage check, before anything is read: budgets of one kind, and at least one."""
    from g2ard.errors import InputError
    from g2ard.policy.budget import Budget

    quality = min_psnr is not None or min_ssim is not None
    if [bool(counts), bool(ratios), fit is not None, quality].count(True) != 1:
        raise typer.BadParameter(
            "give the budget as either -n COUNT or -r RATIO, or as --fit, or as --min-psnr and --min-ssim"
        )
    if fit is not None or quality:
        try:
            return [Budget(fit=fit, min_psnr=min_psnr, min_ssim=min_ssim)]
        except InputError as error:
            raise typer.BadParameter(
                in_flags(error, {"fit": "--fit", "min_psnr": "--min-psnr", "min_ssim": "--min-ssim"})
            ) from None
    if counts:
        return [count.budget() for several in counts for count in several]
    return [Budget(ratio=ratio) for several in ratios or [] for ratio in several]


class Outputs:
    """One output for each budget: `{ratio}` and `{count}` in the name stand for the budget's.

    Args:
        run: the command.
        pattern: as given.
        budgets: what is asked for.
        name: of the option.
    """

    def __init__(self, run: Run, pattern: Path, budgets: Sequence[Budget], *, name: str = "--output") -> None:
        self._run, self._pattern, self._budgets = run, str(pattern), budgets
        self._checked: set[Path] = set()
        if strange := set(re.findall(r"{[^{}]*}", self._pattern)) - {"{ratio}", "{count}"}:
            raise typer.BadParameter(
                f"{name}: {min(strange)} stands for nothing; {{ratio}} and {{count}} stand for the budget's"
            )
        if len(set(budgets)) < len(budgets):
            raise typer.BadParameter(
                f"{name}: a budget is given twice, and would be written to the same place; give each once"
            )
        named = any(word in self._pattern for word in ("{ratio}", "{count}"))
        if named and any(budget.is_measured for budget in budgets):
            raise typer.BadParameter(f"{name}: {{ratio}} and {{count}} stand for budgets of -r and -n")
        by_count = budgets[0].ratio is None
        if len(budgets) > 1 and not named:
            raise typer.BadParameter(
                f"{name}: {len(budgets)} budgets want {{ratio}} or {{count}} in its name, such as "
                f"{_suggested(pattern, by_count=by_count)}"
                + ("; one number has no commas, or reads 10_000" if by_count else "")
            )

    def paths(self, total: int | None = None) -> list[Path]:
        """The places in the budgets' order; () as long as `total`, the scene's Gaussians, must be known."""
        if total is None and self._unknown():
            return []
        found = [Path(self._named(budget, total)) for budget in self._budgets]
        if len(set(found)) < len(found):
            raise typer.BadParameter(
                f"{self._pattern}: two budgets would be written to the same place; "
                "give budgets that differ more, or name both {ratio} and {count}"
            )
        return found

    def check(self, check: Callable[[Path, Budget], object], total: int | None = None) -> None:
        """Refuse places that cannot be written, each once, as soon as their names are known."""
        for path, budget in zip(self.paths(total), self._budgets, strict=False):
            if path not in self._checked:
                check(path, budget)
                self._checked.add(path)

    def _unknown(self) -> bool:
        by_ratio = self._budgets[0].ratio is not None
        return ("{count}" if by_ratio else "{ratio}") in self._pattern or (
            "{count}" in self._pattern and any(budget.count is None for budget in self._budgets)
        )

    def _named(self, budget: Budget, total: int | None) -> str:
        name = self._pattern
        if "{ratio}" in name:
            ratio = budget.ratio if budget.ratio is not None else (total or 0) / budget.of(total or 0)
            name = name.replace("{ratio}", f"{ratio:.4g}")
        if "{count}" in name:
            count = budget.count if budget.count is not None else budget.of(total or 0)
            name = name.replace("{count}", str(count))
        return name


def _suggested(pattern: Path, *, by_count: bool) -> str:
    word = "{count}" if by_count else "{ratio}x"
    return str(pattern.with_name(f"{pattern.stem}_{word}{pattern.suffix}"))
