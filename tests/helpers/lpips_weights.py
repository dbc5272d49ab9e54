"""Random LPIPS weights under their published names."""

import torch

ALEX = (
    (0, 3, 4, 11, 4, 2),
    (3, 4, 5, 5, 1, 2),
    (6, 5, 6, 3, 1, 1),
    (8, 6, 4, 3, 1, 1),
    (10, 4, 4, 3, 1, 1),
)
"""Index, channels in and out, kernel, stride, padding."""


def weights(seed: int = 0) -> tuple[dict, dict]:
    g = torch.Generator().manual_seed(seed)
    backbone = {}
    for i, inside, out, kernel, _, _ in ALEX:
        backbone[f"features.{i}.weight"] = (
            torch.randn(out, inside, kernel, kernel, generator=g) * 0.2
        )
        backbone[f"features.{i}.bias"] = torch.randn(out, generator=g) * 0.1
    linear = {
        f"lin{k}.model.1.weight": torch.rand(1, row[2], 1, 1, generator=g)
        for k, row in enumerate(ALEX)
    }
    return backbone, linear
