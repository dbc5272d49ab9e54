"""Adam that skips Gaussians without a gradient."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from g2ard import _core

_BETAS, _EPS = (0.9, 0.999), 1e-15
_LARGEST_GRADIENT = 1e18
"""Largest gradient whose square fits float32."""


class SelectiveAdam(torch.optim.Optimizer):
    """`torch.optim.Adam` by rows (Gaussians), like in the fused engine.

    A row whose gradients are all zero keeps its values and moments, and each row has its own step count t: p
    ← p − lr · m/(1 − β₁ᵗ) / (√(v/(1 − β₂ᵗ)) + ε), with the bias terms in float64. A row with a gradient that
    is not finite, or over 1e18, is skipped too, and counted. A group's optional "share" multiplies its lr per
    row or value. On the CPU a step is one pass in Rust, with the bits of any number of threads.

    Args:
        parameters: (N, …) tensors by name; they become parameter groups in this order, with lr 0.

    >>> p = torch.zeros(3, 2, requires_grad=True)
    >>> adam = SelectiveAdam({"p": p})
    >>> adam.param_groups[0]["lr"] = 0.1
    >>> p.grad = torch.tensor([[1.0, -1.0], [0.0, 0.0], [torch.nan, 1.0]])
    >>> adam.step()
    >>> [[round(v, 6) + 0.0 for v in row] for row in p.tolist()], adam.skipped
    ([[-0.1, 0.1], [0.0, 0.0], [0.0, 0.0]], 1)
    """

    skipped = 0
    """Number of row steps skipped because a gradient was not finite; not part of `state_dict`."""

    counts: Tensor
    """(N,) int64 number of steps of each row; not part of `state_dict`."""

    def __init__(self, parameters: Mapping[str, Tensor]) -> None:
        groups = [{"params": [p], "name": name} for name, p in parameters.items()]
        super().__init__(groups, {"lr": 0.0})
        first = next(iter(parameters.values()))
        self.counts = torch.zeros(len(first), dtype=torch.int64, device=first.device)
        for p in parameters.values():
            self.state[p] = {"m": torch.zeros_like(p), "v": torch.zeros_like(p)}

    @torch.no_grad()
    def step(self, closure: Any = None) -> None:  # type: ignore[override]
        """Take one step for every row that has a gradient."""
        groups = [group for group in self.param_groups if group["params"][0].grad is not None]
        if self.counts.device.type == "cpu":
            self.skipped += _core.adam_rows([self._arrays(group) for group in groups], self.counts.numpy())
        else:
            self._step_in_torch(groups)

    def _step_in_torch(self, groups: list[dict[str, Any]]) -> None:
        """Take the kernel's step with torch's operations, for GPUs."""
        grads = [group["params"][0].grad.flatten().view(len(group["params"][0]), -1) for group in groups]
        touched = torch.stack([(grad != 0).any(1) for grad in grads]).any(0)
        sound = torch.stack([(grad.abs() <= _LARGEST_GRADIENT).all(1) for grad in grads]).all(0)
        self.skipped += int((touched & ~sound).sum())
        rows = (touched & sound).nonzero()[:, 0]
        self.counts[rows] += 1
        for group in groups:
            self._step_rows(group, rows)

    def _arrays(self, group: dict[str, Any]) -> tuple[Any, ...]:
        """Return values, moments, gradients, rate and share of a group for the kernel, without copies."""
        (p,), share = group["params"], group.get("share")
        held = (p.detach(), self.state[p]["m"], self.state[p]["v"], p.grad.contiguous())
        return *(t.numpy() for t in held), group["lr"], None if share is None else share.contiguous().numpy()

    def _step_rows(self, group: dict[str, Any], rows: Tensor) -> None:
        (p,), (beta1, beta2) = group["params"], _BETAS
        grad, (m, v) = p.grad[rows], (self.state[p][key] for key in ("m", "v"))
        steps = self.counts[rows].double().reshape(-1, *[1] * (grad.ndim - 1))
        bias1, bias2 = ((1 / (1 - beta**steps)).to(p.dtype) for beta in (beta1, beta2))
        m[rows] = m[rows].lerp_(grad, 1 - beta1)
        v[rows] = v[rows].mul_(beta2).addcmul_(grad, grad, value=1 - beta2)
        step = (m[rows] * bias1) / ((v[rows] * bias2).sqrt_() + _EPS)
        if group.get("share") is not None:
            step *= group["share"][rows]
        p[rows] -= group["lr"] * step
