"""The compiled kernels. Private: the public functions of `g2ard` check and document what goes in here."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.rendering.renderer import RasterSettings
from g2ard.rendering.visibility import SampledVisibility
from g2ard.scene.splats import Splats
from g2ard.stages.lift import LiftConfig
from g2ard.stages.recover.anchors import Regularizers
from g2ard.stages.recover.config import Rates
from g2ard.stages.recover.engine import Photometric
from g2ard.stages.select.surfaces import CoverageOptions
from g2ard.stages.simplify.config import SimplifyConfig

__version__: str

def defaults() -> dict[str, dict[str, Any]]: ...
def set_num_threads(threads: int) -> None: ...
def num_threads() -> int: ...
def set_device(name: str, max_binding: int | None = None, timed: bool = False) -> None: ...
def device_state() -> dict[str, Any]: ...
def device_notes() -> list[str]: ...
def adapters() -> list[dict[str, Any]] | None: ...
def lift_points(
    points: NDArray[np.float64],
    config: LiftConfig,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]: ...
def codebook(
    values: NDArray[np.float32], count: int, weights: NDArray[np.float32] | None = None
) -> NDArray[np.float32]: ...
def palette(
    points: NDArray[np.float32],
    count: int,
    steps: int,
    weights: NDArray[np.float32] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.uint32]]: ...
def knn(
    points: NDArray[np.float64], k: int, progress: Callable[[int, int], None] | None = None
) -> NDArray[np.uint32]: ...
def cast_rays(
    steps: NDArray[np.int8],
    shape: list[int],
    low: list[float],
    cell: float,
    eyes: NDArray[np.float64],
    directions: NDArray[np.float64],
) -> NDArray[np.float64]: ...
def simplify_flags(
    scene: Scene,
    cells: int,
    config: SimplifyConfig,
    progress: Callable[[int, int], None] | None = None,
) -> NDArray[np.bool_]: ...
def simplify_paper(
    scene: Scene,
    schedule: list[int],
    cells: int,
    config: SimplifyConfig,
    protected: NDArray[np.bool_] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]: ...
def simplify_pairwise(
    scene: Scene,
    schedule: list[int],
    config: SimplifyConfig,
    protected: NDArray[np.bool_] | None = None,
    visibility: SampledVisibility | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]: ...

class TileFrame:
    def __init__(
        self, unit: float, pixel_size: float, floor: float, even: float, *importance: float
    ) -> None: ...
    @staticmethod
    def of_sample(scene: Scene, config: SimplifyConfig) -> TileFrame: ...
    def with_views(
        self, pixel_size: float, weight: float, mass: float, per_pixel: float
    ) -> TileFrame: ...
    def values(self) -> list[float]: ...

class TileMerging:
    def __init__(
        self,
        scene: Scene,
        frame: TileFrame,
        config: SimplifyConfig,
        visibility: SampledVisibility | None = None,
    ) -> None: ...
    def sums(self) -> tuple[float, float, float]: ...
    def run_costs(self, mean_run: float) -> NDArray[np.float32]: ...
    def plan(
        self,
        runs: int,
        schedule: list[int],
        costs: NDArray[np.float32],
        progress: Callable[[int, int], None] | None = None,
    ) -> tuple[NDArray[np.uint32], NDArray[np.uint32], NDArray[np.uint32], NDArray[np.float32]]: ...
    def assemble(
        self, of: NDArray[np.uint32], count: int, progress: Callable[[int, int], None] | None = None
    ) -> dict[str, Any]: ...

class Scene:
    def __init__(
        self, splats: Splats, known: tuple[NDArray[np.uint32], list[float]] | None = None
    ) -> None: ...
    @property
    def bounds(self) -> list[float]: ...
    @property
    def origin(self) -> list[float]: ...
    @property
    def order(self) -> NDArray[np.uint32]: ...

class VisibilityAccumulator:
    def __init__(self, scene: Scene) -> None: ...
    def add(
        self,
        views: list[_View],
        options: RasterSettings,
        progress: Callable[[int, int], None] | None = None,
    ) -> int: ...
    def by_row(self) -> tuple[_F32, _F32]: ...

_F32 = NDArray[np.float32]
_Arrays = tuple[_F32, ...]
_Corners = tuple[list[float], list[float]]
_View = tuple[list[list[float]], list[float], tuple[int, int], float]

def instruction_sets() -> list[str]: ...

class RowBounds:
    def __init__(self, arrays: _Arrays) -> None: ...

class Rasterizer:
    def __init__(self, isa: str | None = None) -> None: ...
    def forward(
        self,
        arrays: _Arrays,
        view: _View,
        options: RasterSettings,
        background: list[float],
        depths: int = 1,
        bounds: RowBounds | None = None,
    ) -> tuple[_F32, _F32, _F32 | None, _F32 | None]: ...
    def image(
        self,
        scene: _Arrays,
        view: _View,
        options: RasterSettings,
        background: list[float],
        bounds: RowBounds | None = None,
    ) -> _F32: ...
    def draw(
        self,
        arrays: _Arrays,
        view: _View,
        options: RasterSettings,
        corners: _Corners,
        planes: tuple[_F32, _F32],
        bounds: RowBounds | None = None,
    ) -> None: ...
    def backward(
        self, arrays: _Arrays, image: _F32, alpha: _F32 | None = None, depth: _F32 | None = None
    ) -> list[_F32]: ...

def adam_rows(
    attributes: list[tuple[Any, ...]],
    counts: NDArray[np.int64],
    momentum: float,
) -> int: ...

class Trainer:
    def __init__(
        self,
        arrays: _Arrays,
        objective: Photometric,
        units: _F32 | None = None,
        isa: str | None = None,
    ) -> None: ...
    def freeze(self, frozen: NDArray[np.bool_]) -> None: ...
    def anchor(self, means: _F32, frames: _F32, r_parallel: _F32, r_perp: _F32) -> None: ...
    def step(
        self,
        view: _View,
        target: _F32,
        rates: Rates,
        regularizers: Regularizers | None = None,
        mask: NDArray[np.bool_] | None = None,
        relative: float | None = None,
        number: int | None = None,
    ) -> tuple[float, int]: ...
    def arrays(self) -> list[_F32]: ...
    def steps(self) -> NDArray[np.uint32]: ...
    def state(self, part: str | None = None) -> dict[str, NDArray[Any]]: ...
    def load(self, state: dict[str, NDArray[Any]]) -> None: ...
    @property
    def skipped(self) -> int: ...

def light_on(light: _F32, view: _View, options: RasterSettings, corners: _Corners) -> float: ...
def reaching(
    means: _F32, scales: _F32, opacities: _F32, views: list[_View], corners: _Corners
) -> NDArray[np.bool_]: ...
def accumulate(
    arrays: _Arrays,
    views: list[_View],
    options: RasterSettings,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]: ...
def accumulate_each(
    arrays: _Arrays,
    views: list[_View],
    options: RasterSettings,
    progress: Callable[[int, int], None] | None = None,
) -> list[dict[str, Any]]: ...
def l1_ssim(
    image: _F32, target: _F32, ssim_weight: float, mask: NDArray[np.bool_] | None = None
) -> tuple[float, _F32]: ...
def ssim(image: _F32, target: _F32, mask: NDArray[np.bool_] | None = None) -> float: ...
def psnr(image: _F32, target: _F32) -> float: ...
def steps(image: _F32, target: _F32, mask: NDArray[np.bool_] | None = None) -> list[float]: ...
def contrasts(
    image: _F32, target: _F32, mask: NDArray[np.bool_] | None = None
) -> NDArray[np.float64]: ...

_F64 = NDArray[np.float64]
_Surface = tuple[_F64, _F64, _F64, _F64, float]
_Gaussians = tuple[NDArray[Any], ...]

def select_surface(scene: _Gaussians, cells: int) -> dict[str, Any]: ...
def select_view_statistics(
    scene: _Gaussians,
    views: list[tuple[Any, ...]],
    progress: Callable[[int, int], None] | None = None,
) -> _F32: ...
def select_visible(
    scene: _Gaussians,
    surface: _Surface,
    views: list[tuple[Any, ...]],
    *,
    tolerance: float,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[NDArray[np.uint64], NDArray[np.uint32]]: ...
def select_greedy(
    surface: _Surface,
    views: tuple[NDArray[np.uint64], NDArray[np.uint32], _F64],
    k: int,
    config: CoverageOptions,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[NDArray[np.uint32], _F64, int]: ...
def select_light(
    received: _F32, before: _F64, k: int, progress: Callable[[int, int], None] | None = None
) -> tuple[NDArray[np.uint32], _F64]: ...

_Grey = NDArray[np.float64]
_Mask = NDArray[np.bool_]
_Lens = tuple[float, float, float, float]

def shot(
    image: _F32, alpha: _F32, depth: _F32, min_alpha: float, max_edge: float
) -> tuple[_Grey, _Grey, _Mask]: ...
def normal_equations(
    photo: tuple[_Grey, _Grey, _Grey, _Mask],
    shot: tuple[_Grey, _Grey, _Mask],
    lens: _Lens,
    light: tuple[float, float],
    scale: float | None = None,
) -> tuple[list[list[float]], list[float], float, float, float]: ...
def flow(shot: tuple[_Grey, _Grey, _Mask], lens: _Lens, xi: list[float]) -> float: ...
def local_zncc(a: _Grey, b: _Grey, mask: _Mask, side: int) -> float: ...
