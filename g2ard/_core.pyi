"""The compiled kernels. Private: the public functions of `g2ard` check and document what goes in here."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.splats import Splats

__version__: str

def set_num_threads(threads: int) -> None: ...
def num_threads() -> int: ...
def lift_points(
    points: NDArray[np.float64],
    *,
    neighbors: int,
    normal_ratio: float,
    max_anisotropy: float,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]: ...
def simplify_flags(
    scene: Splats,
    cells: int,
    threshold: float,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> NDArray[np.bool_]: ...
def simplify_paper(
    scene: Splats,
    schedule: list[int],
    *,
    protected: NDArray[np.bool_] | None,
    min_opacity: float,
    color_bin: float,
    max_energy: float,
    min_coverage: float,
    flag_threshold: float,
    protection: float,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]: ...
