"""Choice of the engine that runs recovery's steps: fused, torch or gsplat."""

from collections.abc import Callable

from g2ard.config.choices import ENGINES
from g2ard.errors import InputError, require_torch
from g2ard.stages.recover.engine import Engine, Objective


def engine_class(name: str) -> Callable[[Objective], Engine]:
    """Return the engine class of a name in `RecoverConfig.engine`, importing its packages on demand."""
    if name == "fused":
        from g2ard.stages.recover.fused_engine import FusedEngine

        return FusedEngine
    if name == "torch":
        require_torch("engine 'torch'")
        from g2ard.stages.recover.torch_engine import TorchEngine

        return TorchEngine
    if name == "gsplat":
        require_torch("engine 'gsplat'", "torch gsplat")
        from g2ard.stages.recover.gsplat_engine import GsplatEngine

        return GsplatEngine
    raise InputError(f"expected {', '.join(ENGINES)}, got {name!r}", parameter="engine")
