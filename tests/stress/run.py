"""`make stress`: thousands of random gradient cases, image errors, and bits at any number of threads.

    python tests/stress/run.py --cases 12000

Ends with a table of counts and worst errors per parameter class; exit status 1 if anything is out of bounds.
"""

import argparse
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

if __name__ == "__main__":
    sys.path[:0] = [
        str(Path(__file__).resolve().parents[1]),
        str(Path(__file__).resolve().parents[2]),
    ]

import numpy as np
import torch

from stress.bits import differing, large_problem
from stress.gradients import ENGINE_TOLERANCE, TWIN_TOLERANCE, Tally, check_problem
from stress.scenes import NAMES

__all__ = ["IMAGE_TOLERANCE", "Outcome", "stress"]

IMAGE_TOLERANCE = 2e-6
"""99.9th percentile of the error of image, alpha and depth (in units of the deepest pixel)."""

MOST_UNSETTLED = 1e-3
"""Share of cases whose finite differences may fail to converge; such a case tells nothing of the gradient."""

_PER_CLASS = 3


@dataclass
class Outcome:
    """Results of a run."""

    tallies: dict[str, Tally] = field(default_factory=lambda: {name: Tally() for name in NAMES})
    problems: int = 0
    pixels: int = 0
    image_error: float = 0.0
    worst_image_error: float = 0.0
    bit_checks: int = 0
    failures: list[str] = field(default_factory=list)

    @property
    def checked(self) -> int:
        return sum(tally.checked - tally.unsettled for tally in self.tallies.values())

    def close(self, errors: list[np.ndarray]) -> None:
        """Return the verdict over all cases."""
        every = np.concatenate(errors)
        self.pixels, self.worst_image_error = len(every), float(every.max())
        self.image_error = float(np.quantile(every, 0.999))
        for tally in self.tallies.values():
            self.failures += tally.failures
        unsettled = sum(tally.unsettled for tally in self.tallies.values())
        if unsettled > MOST_UNSETTLED * self.checked:
            self.failures.append(
                f"{unsettled} of {self.checked} cases: finite differences did not converge"
            )
        if not self.image_error < IMAGE_TOLERANCE:
            self.failures.append(f"image: 99.9th percentile {self.image_error:.2e}")

    def table(self) -> str:
        names = ("cases", "one-sided", "lively", "unsettled", "twin", "engine")
        lines = [
            f"{'class':<16}" + "".join(f"{name:>10}" for name in names) + "  crossed within ±h"
        ]
        for name, t in self.tallies.items():
            kinds = ", ".join(f"{kind} {count}" for kind, count in t.crossed.most_common())
            lines.append(
                f"{name:<16}{t.checked - t.unsettled:>10}{t.one_sided:>10}{t.lively:>10}{t.unsettled:>10}"
                f"{t.worst_twin:>10.1e}{t.worst_engine:>10.1e}  {kinds}"
            )
        lines += [
            f"{self.checked} cases of {self.problems} scenes within {TWIN_TOLERANCE:g} (twin) and "
            f"{ENGINE_TOLERANCE:g} (engine), but for {sum(len(t.failures) for t in self.tallies.values())}",
            f"image, alpha, depth: 99.9th percentile {self.image_error:.2e}, worst "
            f"{self.worst_image_error:.2e} of {self.pixels} values",
            f"same bits at 1, 2 and 8 threads: {self.bit_checks} scenes",
        ]
        return "\n".join(lines)


def stress(cases: int, *, first_seed: int = 0, large: int = 4, report: bool = False) -> Outcome:
    """Random problems until `cases` coordinates have been checked, then bits on `large` larger scenes."""
    outcome, errors = Outcome(), []
    began = told = time.monotonic()
    while outcome.checked < cases:
        problem, error = check_problem(first_seed + outcome.problems, _PER_CLASS, outcome.tallies)
        errors += error
        if outcome.problems % 4 == 0:
            _check_bits(outcome, f"seed {first_seed + outcome.problems}", differing(problem))
        outcome.problems += 1
        if report and time.monotonic() - told > 15:
            told = time.monotonic()
            print(
                f"{outcome.checked} of {cases} cases, {told - began:.0f} s",
                file=sys.stderr,
                flush=True,
            )
    for seed in range(first_seed, first_seed + large):
        _check_bits(outcome, f"large {seed}", differing(large_problem(seed)))
    outcome.close(errors)
    return outcome


def _check_bits(outcome: Outcome, label: str, differences: list[str]) -> None:
    outcome.bit_checks += 1
    if differences:
        outcome.failures.append(f"{label}: bits depend on threads: {', '.join(differences)}")


def main() -> int:
    parser = argparse.ArgumentParser(
        description="Gradients against finite differences, case by random case."
    )
    parser.add_argument("--cases", type=int, default=12_000)
    parser.add_argument("--seed", type=int, default=0, help="of the first scene")
    options = parser.parse_args()
    # tensors of a few hundred values: more threads only wait for each other
    torch.set_num_threads(1)
    outcome = stress(options.cases, first_seed=options.seed, large=20, report=True)
    print(outcome.table())
    for failure in outcome.failures:
        print(f"FAILED  {failure}")
    return 1 if outcome.failures else 0


if __name__ == "__main__":
    sys.exit(main())
