"""A slice of `make stress`: the same random cases, fewer of them."""

from collections.abc import Iterator

import pytest
import torch

from stress.gradients import Tally, check_problem
from stress.run import Outcome, stress
from stress.scenes import NAMES, Problem


@pytest.fixture(autouse=True)
def _one_torch_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def test_a_slice_of_the_stress_test() -> None:
    outcome = stress(150, first_seed=50_000, large=1)
    assert not outcome.failures, "\n".join(outcome.failures)
    assert outcome.checked >= 150
    assert sum(tally.lively for tally in outcome.tallies.values()) > 75
    assert outcome.table().count("\n") == len(NAMES) + 3


def test_the_stress_test_notices_a_wrong_gradient(monkeypatch: pytest.MonkeyPatch) -> None:
    honest = Problem.engine

    def off(self: Problem) -> object:
        outputs, gradients = honest(self)
        return outputs, {k: v * 1.002 for k, v in gradients.items()}

    monkeypatch.setattr(Problem, "engine", off)
    tallies = {name: Tally() for name in NAMES}
    for seed in range(50_000, 50_004):
        check_problem(seed, 2, tallies)
    assert all(tally.failures for tally in tallies.values())


def test_an_image_off_by_a_little_fails() -> None:
    import numpy as np

    outcome = Outcome()
    outcome.close([np.full(1000, 3e-6)])
    assert outcome.failures == ["image: 99.9th percentile 3.00e-06"]
