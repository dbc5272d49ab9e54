"""Which regularisers a prior needs: named, or chosen by measuring it."""

from __future__ import annotations

import numpy as np

from g2ard.errors import InputError
from g2ard.recover.anchors import PRESETS, Regularizers, needle
from g2ard.splats import Splats

__all__ = ["preset_for"]

_MANY_NEEDLES = 0.10
_UNIFORM_SPREAD = 1e-3


def preset_for(name: str, prior: Splats) -> tuple[Regularizers, str]:
    """The regularisers of preset `name`, and a line that says which and why.

    `auto` measures the prior: opacities all alike and no view-dependent colour mean an untrained lift; a
    needle share above 10 % means a noisy trained model; anything else is taken for a faithful one.

    Args:
        name: auto, trained, lift or noisy.
        prior: the scene recovery starts from.

    Returns:
        The weights and the reason.

    Raises:
        InputError: no such preset.
    """
    if name in PRESETS:
        return PRESETS[name], f"{name} (as asked)"
    if name != "auto":
        raise InputError(f"preset: expected auto, {', '.join(PRESETS)}, got {name!r}")
    spread = float(np.ptp(prior.opacities)) if len(prior) else 0.0
    share = needle(prior.scales)
    if spread < _UNIFORM_SPREAD and not prior.shN.any():
        return PRESETS["lift"], "lift (every opacity is alike: nothing was trained)"
    if share > _MANY_NEEDLES:
        return PRESETS["noisy"], f"noisy ({share:.0%} of the Gaussians are needles)"
    return PRESETS["trained"], f"trained ({share:.1%} of the Gaussians are needles)"
