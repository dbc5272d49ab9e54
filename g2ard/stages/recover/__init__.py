"""Recovery: optimisation of a fixed set of Gaussians against photos or a teacher's renders."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from g2ard.stages.recover.config import RecoverConfig
    from g2ard.stages.recover.optimize import Recovered, recover

__all__ = ["RecoverConfig", "Recovered", "recover"]


def __getattr__(name: str) -> Any:  # load numpy only when recovery is used
    if name in __all__:
        from g2ard.stages.recover import config, optimize

        return getattr(config if name == "RecoverConfig" else optimize, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
