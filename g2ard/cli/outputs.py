"""Output paths: one per budget, from a pattern if there are several."""

import re
from collections.abc import Callable, Sequence
from itertools import chain
from pathlib import Path

import typer

from g2ard.cli.budget_options import BUDGET_FLAGS, BUDGETS
from g2ard.cli.run import Run
from g2ard.jobs.budget import Budget


def read_budgets(run: Run, *, optional: bool = False) -> list[Budget]:
    """Return the budgets of the options, and check that exactly one kind is given, or none if `optional`."""
    counts, ratios, fit, min_psnr, min_ssim = (run.shared[name] for name in BUDGETS)
    quality = min_psnr is not None or min_ssim is not None
    kinds = [bool(counts), bool(ratios), fit is not None, quality].count(True)
    if not kinds and optional:
        return []
    if not kinds:
        raise typer.BadParameter(
            f"say how small the result is to be, as -r 10 does: {BUDGET_FLAGS}"
        )
    if kinds > 1:
        raise typer.BadParameter(f"the result can have one size alone; keep one of {BUDGET_FLAGS}")
    if fit is not None or quality:
        with run.usage():
            return [Budget(fit=fit, min_psnr=min_psnr, min_ssim=min_ssim)]
    if counts:
        return [count.budget() for count in chain.from_iterable(counts)]
    return [Budget(ratio=ratio) for ratio in chain.from_iterable(ratios or [])]


def read_budget(run: Run, *, optional: bool = False) -> Budget | None:
    """Return the budget of the options, and check that it is the only one; None if `optional` and missing."""
    budgets = read_budgets(run, optional=optional)
    if len(budgets) > 1:
        raise typer.BadParameter(
            "give one budget, and run the command once for each; commas separate counts, so write a single "
            "one as 10_000"
        )
    return next(iter(budgets), None)


def refuse_file(path: Path, what: str) -> None:
    """Raise a usage error if the name of an output folder is that of a scene's file; `what` it holds."""
    from g2ard.io.scene_formats import SUFFIXES

    if path.name.lower().endswith((*SUFFIXES, ".json", ".html")) and not path.is_dir():
        folder = path.with_name(path.name.split(".")[0] or "out")
        raise typer.BadParameter(
            f"--output: {path} names a file, but a folder is written ({what}); give {folder}"
        )


class Outputs:
    """Outputs of a command, one per budget; `{ratio}` and `{count}` in the pattern are the budget's.

    Args:
        check: called with the flag and each path before work begins, such as `Run.claim_scene`.
        name: flag of the pattern.
    """

    def __init__(
        self,
        pattern: Path,
        budgets: Sequence[Budget],
        check: Callable[[str, Path], object],
        *,
        name: str = "--output",
    ) -> None:
        self._pattern = str(pattern)
        self._budgets = budgets
        self._check = check
        self._name = name
        self._checked: set[Path] = set()
        # braces elsewhere, as of a GUID, mean themselves
        words = set(re.findall(r"{[a-z_]*}", pattern.name))
        if strange := words - {"{ratio}", "{count}"}:
            raise typer.BadParameter(
                f"{name}: unknown placeholder {min(strange)}; use {{ratio}} or {{count}}"
            )
        if len(set(budgets)) < len(budgets):
            raise typer.BadParameter(f"{name}: a budget is given twice; give each budget once")
        named = any(word in self._pattern for word in ("{ratio}", "{count}"))
        if named and any(budget.is_measured for budget in budgets):
            raise typer.BadParameter(f"{name}: {{ratio}} and {{count}} need a budget by -r or -n")
        by_count = budgets[0].ratio is None
        if len(budgets) > 1 and not named:
            word = "{count}" if by_count else "{ratio}x"
            raise typer.BadParameter(
                f"{name}: {len(budgets)} budgets need {{ratio}} or {{count}} in its name, such as "
                f"{pattern.with_name(f'{pattern.stem}_{word}{pattern.suffix}')}"
                + ("; commas separate counts, so write a single one as 10_000" if by_count else "")
            )

    def paths(self, total: int | None = None) -> list[Path]:
        """Return the paths in the order of the budgets.

        Args:
            total: Gaussians of the scene, by which ratios and counts convert into each other. If it is
                unknown (None) and names depend on it, the result is [].
        """
        if total is None and self._needs_total():
            return []
        found = [Path(self._fill_in(budget, total)) for budget in self._budgets]
        if len(set(found)) < len(found):
            raise typer.BadParameter(
                f"{self._pattern}: two budgets have the same output; "
                "give budgets that differ more, or use both {ratio} and {count}"
            )
        return found

    def check(self, total: int | None = None) -> None:
        """Check each path once, as soon as the paths are known."""
        for path in self.paths(total):
            if path not in self._checked:
                self._check(self._name, path)
                self._checked.add(path)

    def _needs_total(self) -> bool:
        """Return whether a name holds the count of a ratio, or the ratio of a count."""
        by_ratio = self._budgets[0].ratio is not None
        return ("{count}" if by_ratio else "{ratio}") in self._pattern or (
            "{count}" in self._pattern and any(budget.count is None for budget in self._budgets)
        )

    def _fill_in(self, budget: Budget, total: int | None) -> str:
        name = self._pattern
        if "{ratio}" in name:
            ratio = (
                budget.ratio if budget.ratio is not None else (total or 0) / budget.of(total or 0)
            )
            name = name.replace("{ratio}", f"{ratio:.4g}")
        if "{count}" in name:
            count = budget.count if budget.count is not None else budget.of(total or 0)
            name = name.replace("{count}", str(count))
        return name
