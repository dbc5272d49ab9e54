"""What takes the steps of a recovery, and which there are."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from g2ard.errors import InputError
from g2ard.splats import Splats
from g2ard.stages.recover.schedule import Rates

__all__ = ["Engine", "engine_class"]


class Engine(Protocol):
    """What takes steps: holds parameters and optimiser state."""

    def step(
        self,
        view: int,
        target: NDArray[np.float32],
        rates: Rates,
        *,
        regularize: bool,
        mask: NDArray[np.bool_] | None = None,
    ) -> float: ...

    def splats(self) -> Splats: ...

    def state(self) -> dict[str, NDArray[Any]]: ...

    def load(self, state: dict[str, NDArray[Any]]) -> None: ...

    @property
    def counts(self) -> NDArray[Any]: ...

    @property
    def skipped(self) -> int: ...


def engine_class(name: str) -> Any:
    """The class of an engine by its name in `RecoverConfig.engine`; its packages are imported only then."""
    if name == "fused":
        from g2ard.stages.recover.fused_engine import FusedEngine

        return FusedEngine
    if name == "torch":
        from g2ard.stages.recover.torch_engine import TorchEngine

        return TorchEngine
    if name == "gsplat":
        from g2ard.stages.recover.gsplat_engine import GsplatEngine

        return GsplatEngine
    raise InputError(f"engine: expected fused, torch or gsplat, got {name!r}")
