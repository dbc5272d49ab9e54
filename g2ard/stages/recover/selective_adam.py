"""Adam that skips Gaussians without a gradient."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from g2ard import _core

_BETAS, _EPS = (0.9, 0.999), 1e-15
_LARGEST_GRADIENT = 1e18
"""Largest gradient whose square fits float32."""


class SelectiveAdam:
    """`torch.optim.Adam` by rows (Gaussians), like in the fused engine.

    A row whose gradients are all zero keeps its values and moments, and each row has its own step count t: p
    ← p − lr · m/(1 − β₁ᵗ) / (√(v/(1 − β₂ᵗ)) + ε), with the bias terms in float64. A row with a gradient that
    is not finite, or over 1e18, is skipped too, and counted. On the CPU a step is one pass in Rust, with the
    bits of any number of threads.

    Args:
        parameters: (N, …) tensors by name.
    """

    skipped = 0
    """Number of row steps skipped because a gradient was not finite."""

    counts: Tensor
    """(N,) int64 number of steps of each row."""

    def __init__(self, parameters: Mapping[str, Tensor]) -> None:
        self._parameters = parameters
        self.moments = {
            f"{key}.{name}": torch.zeros_like(p) for name, p in parameters.items() for key in "mv"
        }
        first = next(iter(parameters.values()))
        self.counts = torch.zeros(len(first), dtype=torch.int64, device=first.device)

    @torch.no_grad()
    def step(self, rates: Mapping[str, float], shares: Mapping[str, Tensor]) -> None:
        """Take one step for every row that has a gradient.

        Args:
            rates: learning rate of each parameter.
            shares: factors on the rates of some parameters, per row or value.
        """
        if self.counts.device.type != "cpu":
            self._step_in_torch(rates, shares)
            return
        rows = [self._arrays(name, rates[name], shares.get(name)) for name in self._parameters]
        self.skipped += _core.adam_rows(rows, self.counts.numpy())

    def _arrays(self, name: str, rate: float, share: Tensor | None) -> tuple[Any, ...]:
        """Return a parameter, its moments, gradient, rate and share for the kernel, without copies."""
        p, m, v = self._parameters[name], self.moments[f"m.{name}"], self.moments[f"v.{name}"]
        assert p.grad is not None
        held = (t.numpy() for t in (p.detach(), m, v, p.grad.contiguous()))
        return *held, rate, None if share is None else share.contiguous().numpy()

    def _step_in_torch(self, rates: Mapping[str, float], shares: Mapping[str, Tensor]) -> None:
        """Take the kernel's step with torch's operations, for GPUs."""
        grads = {name: p.grad for name, p in self._parameters.items() if p.grad is not None}
        flat = [grad.flatten().view(len(grad), -1) for grad in grads.values()]
        touched = torch.stack([(grad != 0).any(1) for grad in flat]).any(0)
        sound = torch.stack([(grad.abs() <= _LARGEST_GRADIENT).all(1) for grad in flat]).all(0)
        self.skipped += int((touched & ~sound).sum())
        rows = (touched & sound).nonzero()[:, 0]
        self.counts[rows] += 1
        (beta1, beta2), p = _BETAS, self._parameters
        for name in grads:
            grad, m, v = grads[name][rows], self.moments[f"m.{name}"], self.moments[f"v.{name}"]
            steps = self.counts[rows].double().reshape(-1, *[1] * (grad.ndim - 1))
            bias1, bias2 = ((1 / (1 - beta**steps)).to(grad.dtype) for beta in (beta1, beta2))
            m[rows] = m[rows].lerp_(grad, 1 - beta1)
            v[rows] = v[rows].mul_(beta2).addcmul_(grad, grad, value=1 - beta2)
            step = (m[rows] * bias1) / ((v[rows] * bias2).sqrt_() + _EPS)
            if name in shares:
                step *= shares[name][rows]
            p[name][rows] -= rates[name] * step
