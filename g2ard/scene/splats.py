"""The scene type shared by all stages."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from g2ard.arrays import Float, Float32, Int, Mask, Values
from g2ard.config.choices import AXES, RENDER_MODELS, Axes, RenderModel
from g2ard.errors import InputError, require
from g2ard.progress import plural
from g2ard.system.cached import cached_property
from g2ard.system.keys import UNKEYED, key_of, keyed
from g2ard.system.shown import Shown

SH_C0 = 0.28209479177387814
"""Band-0 spherical harmonic: colour = 0.5 + SH_C0 · sh0."""

DRAWN_LOGIT = -5.54
"""Logit below which α < 1/255, which no renderer draws."""

# deviation of a quaternion's length from 1 that counts as rounding: a few ulps of float32
_UNIT_SLACK = 1e-6
_FINE_STEP = 1e-4  # rounding of positions that nothing shows, as a share of a Gaussian's scale
_COLOR_SLACK = 1e-5  # excess of a colour over [0, 1] that counts as rounding

_FAR_SPREADS = 16.0
"""Distance from the origin, in spreads, beyond which points are far."""

_SAMPLE = 65_536
"""Number of points that decide."""

ARRAYS = ("means", "quats", "scales", "logit_opacities", "sh0", "shN")
"""Names of the arrays with a row per Gaussian."""

_DEGREE_OF_REST = {0: 0, 3: 1, 8: 2, 15: 3}


@dataclass(frozen=True, eq=False)
class Splats(Shown):
    """N Gaussians as a structure of arrays.

    Args:
        means: (N, 3) float32 or float64, scene units, relative to `offset`. Kernels and files take float32;
            see `narrowed`.
        quats: (N, 4) float32 wxyz of any nonzero length; g2ard returns and writes unit quaternions.
        scales: (N, 3) float32, linear standard deviations along the rotated axes.
        logit_opacities: (N,) float32; opacity = sigmoid(logit).
        sh0: (N, 1, 3) float32, band-0 coefficients; colour = 0.5 + SH_C0·sh0 + higher bands.
        shN: (N, K−1, 3) float32, K−1 in {0, 3, 8, 15}: SH degree 0–3.
        offset: (3,) float64, world = means + offset. Large map coordinates (UTM) go here.
        render_model: the rendering that the scene was trained for: "classic", or "antialiased" with
            Mip-Splatting's factor on opacities. All renders follow it.
        up: (3,) direction away from the ground, if the scene's file states it.
        axes: axes of the coordinates. Trained scenes are "RDF", as files store them. Scans are "RFU", z up:
            their files are turned y down for viewers and name these axes, and reading turns them back.

    Other arrays of numbers are converted to these types.

    Raises:
        InputError: values that are not numbers, mismatched array shapes, an invalid offset, or an unknown
            render model.

    >>> s = Splats.create(means=np.zeros((2, 3)), scales=np.ones((2, 3)))
    >>> len(s), s.sh_degree, s.opacities
    (2, 0, array([0.5, 0.5], dtype=float32))
    """

    means: Values
    quats: Float32
    scales: Float32
    logit_opacities: Float32
    sh0: Float32
    shN: Float32
    offset: Float = field(default_factory=lambda: np.zeros(3))
    render_model: RenderModel = "classic"
    up: tuple[float, float, float] | None = field(default=None, metadata=UNKEYED)
    axes: Axes = field(default="RDF", metadata=UNKEYED)

    def __post_init__(self) -> None:
        for name in ARRAYS:
            object.__setattr__(self, name, _as_floats(name, getattr(self, name)))
        offset = _as_floats("offset", self.offset, np.float64)
        is_point = offset.shape == (3,) and bool(np.isfinite(offset).all())
        require("offset", self.offset, is_point, "3 finite numbers")
        object.__setattr__(self, "offset", offset)
        require(
            "means",
            self.means.shape,
            self.means.ndim == 2 and self.means.shape[1] == 3,
            "shape (N, 3)",
        )
        n = len(self.means)
        if self.shN.ndim == 3:
            rest = self.shN.shape[1]
        else:
            rest = -1
        for name, shape in (
            ("quats", (n, 4)),
            ("scales", (n, 3)),
            ("logit_opacities", (n,)),
            ("sh0", (n, 1, 3)),
            ("shN", (n, rest, 3)),
        ):
            got = getattr(self, name).shape
            require(name, got, got == shape, f"shape {shape}")
        require("shN", rest, rest in _DEGREE_OF_REST, "0, 3, 8 or 15 coefficients")
        model = self.render_model
        require("render_model", repr(model), model in RENDER_MODELS, " or ".join(RENDER_MODELS))
        require("axes", repr(self.axes), self.axes in AXES, f"one of {', '.join(AXES)}")

    @classmethod
    def create(
        cls,
        means: ArrayLike,
        *,
        quats: ArrayLike | None = None,
        scales: ArrayLike,
        logit_opacities: ArrayLike | None = None,
        sh0: ArrayLike | None = None,
        shN: ArrayLike | None = None,
        offset: ArrayLike = (0.0, 0.0, 0.0),
        render_model: RenderModel = "classic",
    ) -> Splats:
        """Create from array-likes; by default no rotation, opacity 0.5, mid grey, SH degree 0."""
        points = np.asarray(means)
        if points.dtype != np.float64:
            points = points.astype(np.float32)
        points = np.ascontiguousarray(points)
        n = len(points)

        def rows(value: ArrayLike | None, default: ArrayLike, shape: tuple[int, ...]) -> Float32:
            if value is None:
                return np.ascontiguousarray(np.broadcast_to(np.asarray(default, np.float32), shape))
            return np.ascontiguousarray(value, dtype=np.float32)

        return cls(
            means=points,
            quats=rows(quats, [1, 0, 0, 0], (n, 4)),
            scales=rows(scales, 1, (n, 3)),
            logit_opacities=rows(logit_opacities, 0, (n,)),
            sh0=rows(sh0, 0, (n, 1, 3)),
            shN=rows(shN, 0, (n, 0, 3)),
            offset=np.array(offset, dtype=np.float64),
            render_model=render_model,
        )

    def __len__(self) -> int:
        return len(self.means)

    def __repr__(self) -> str:
        return f"Splats({plural(len(self), 'Gaussian')}, SH degree {self.sh_degree})"

    @property
    def sh_degree(self) -> int:
        """SH degree, 0 to 3."""
        return _DEGREE_OF_REST[self.shN.shape[1]]

    @property
    def antialiased(self) -> bool:
        """Whether the render model is "antialiased"."""
        return self.render_model == "antialiased"

    @property
    def opacities(self) -> Float32:
        """Opacities in [0, 1], (N,): the sigmoid of `logit_opacities`, without overflow."""
        x = self.logit_opacities.astype(np.float64)
        e = np.exp(-np.abs(x))
        opacities = np.where(
            x >= 0,
            1 / (1 + e),
            e / (1 + e),
        )
        return opacities.astype(np.float32)

    @property
    def log_scales(self) -> Float32:
        """Natural logarithms of `scales`, (N, 3), as files store them."""
        return np.log(self.scales.astype(np.float64)).astype(np.float32)

    @property
    def colors(self) -> Float32:
        """Base colours 0.5 + SH_C0·sh0, (N, 3), not clamped."""
        return (0.5 + SH_C0 * self.sh0[:, 0]).astype(np.float32)

    @property
    def positions(self) -> Float:
        """Means in world coordinates, (N, 3): with the offset."""
        return self.means.astype(np.float64) + self.offset

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays in float32, as in a .ply."""
        return 4 * len(self) * (14 + 3 * self.shN.shape[1])

    def fingerprint(self) -> str:
        """Return a hash of all arrays and the render model.

        It is computed once; later changes of arrays in place do not affect it.
        """
        return self._digest

    @cached_property
    def _digest(self) -> str:
        return key_of(keyed(self))

    def take(self, index: Any) -> Splats:
        """Return the rows that `index` selects (a mask, a slice or indices), in its order."""
        return replace(self, **{name: getattr(self, name)[index] for name in ARRAYS})

    def with_sh_degree(self, degree: int) -> Splats:
        """Return the scene with higher bands cut off or padded with zeros.

        Raises:
            InputError: the degree is not 0–3.
        """
        if degree not in range(4):
            raise InputError(f"SH degree: expected 0 to 3, got {degree}")
        rest = (degree + 1) ** 2 - 1
        if rest == self.shN.shape[1]:
            return self
        shN = np.zeros((len(self), rest, 3), np.float32)
        keep = min(rest, self.shN.shape[1])
        shN[:, :keep] = self.shN[:, :keep]
        return replace(self, shN=shN)

    def recentred(self, offset: ArrayLike) -> Splats:
        """Return the scene with means relative to another offset (subtracted in float64)."""
        target = np.asarray(offset, np.float64)
        shift = self.offset - target
        if not shift.any():
            means = self.means
        else:
            means = self.means.astype(np.float64) + shift
        return replace(self, means=means.astype(self.means.dtype), offset=target)

    def narrowed(self, offset: ArrayLike | None = None) -> Splats:
        """Return the scene with float32 means, which kernels and files take.

        The `far_middle` of means that float32 would round goes into `offset`, so that it holds the rest.

        Args:
            offset: the resulting offset; None chooses it, and keeps that of float32 means.

        >>> far = Splats.create(np.array([[5.4e6, 0, 0], [5.4e6 + 3.3, 0, 0]]), scales=np.ones((2, 3)))
        >>> near = far.narrowed()
        >>> near.means.round(3)[:, 0], near.offset.tolist()
        (array([-2. ,  1.3], dtype=float32), [5400002.0, 0.0, 0.0])
        """
        if offset is None:
            if self.means.dtype == np.float32:
                return self
            with np.errstate(over="ignore"):
                exact = self.means.astype(np.float32)
            if np.array_equal(exact, self.means, equal_nan=True):
                return replace(self, means=exact)
            finite = self.scales[np.isfinite(self.scales).all(1)]
            if len(finite):
                size = float(np.median(finite.max(1)))
            else:
                size = 0.0
            shift = far_middle(self.means, size)
            if shift.any():
                offset = self.offset + shift
            else:
                offset = self.offset
        moved = self.recentred(offset)
        return replace(moved, means=np.ascontiguousarray(moved.means, np.float32))

    def finite_rows(self) -> Mask:
        """Return the (N,) mask of rows with finite values; infinite logits count as finite (α = 0 or 1)."""
        ok = np.isfinite(self.means).all(1) & ~np.isnan(self.logit_opacities)
        for name in ("quats", "scales", "sh0", "shN"):
            ok &= np.isfinite(getattr(self, name)).reshape(len(self), -1).all(1)
        return ok

    def visible_rows(self) -> Int:
        """Return the rows whose opacity is above 1/255, which renderers draw."""
        return np.flatnonzero(self.opacities > 1 / 255)


class HasSplats(Protocol):
    """A result with a scene, such as `Simplified` or `Distilled`."""

    @property
    def splats(self) -> Splats: ...


def scene_of(scene: Splats | HasSplats, parameter: str = "splats") -> Splats:
    """Return a scene, or that of a result; errors name it `parameter`.

    >>> scene_of(Splats.create([[0, 0, 0]], scales=[[1, 1, 1]]))
    Splats(1 Gaussian, SH degree 0)
    """
    found = scene if isinstance(scene, Splats) else getattr(scene, "splats", None)
    if not isinstance(found, Splats):
        raise InputError(
            f"expected Splats or a result with splats, got {type(scene).__name__}",
            parameter=parameter,
        )
    return found


def _as_floats(name: str, values: Any, kind: type[Any] | None = None) -> Values:
    """Return an array as float32; as `kind`, if given; means of more than 24 bits as float64."""
    dtype = getattr(values, "dtype", None)
    if kind is None:
        if name == "means" and dtype not in (np.float32, np.float16):
            kind = np.float64
        else:
            kind = np.float32
    if isinstance(values, np.ndarray) and dtype == kind:
        return values
    try:
        found = np.asarray(values)
        if found.dtype.kind not in "biuf":
            raise TypeError
        with np.errstate(over="ignore"):  # becomes infinite, which is reported as not finite
            return found.astype(kind)
    except (TypeError, ValueError):
        text = f"expected an array of numbers, got a value of type {type(values).__name__}"
        raise InputError(text, parameter=name) from None


def check_finite(splats: Splats, parameter: str) -> None:
    """Raise an `InputError` with the first row that is not finite."""
    bad = np.flatnonzero(~splats.finite_rows())
    if len(bad):
        text = f"is the first of {len(bad)} with a non-finite value"
        raise InputError(text, parameter=parameter, index=int(bad[0]))


def unit_colors(colors: ArrayLike) -> Float:
    """Return colours in [0, 1]: bytes divided by 255, 16-bit integers by 65,535, others as they are.

    >>> unit_colors(np.uint8([[255, 51, 0]])).tolist()
    [[1.0, 0.2, 0.0]]
    """
    given = np.asarray(colors)
    values = given.astype(np.float64)
    if given.dtype in (np.uint8, np.uint16):
        return values / np.iinfo(given.dtype).max
    with np.errstate(invalid="ignore"):
        wrong = (values < -_COLOR_SLACK) | (values > 1 + _COLOR_SLACK)
    wrong &= np.isfinite(values)
    if wrong.any():
        row = np.argwhere(wrong)[0]
        raise InputError(
            f"has {values[tuple(row)]:g}, expected 0 to 1",
            parameter="colors",
            index=int(row[0]),
            hint="divide by the largest value, or pass uint8",
        )
    return values


def far_middle(points: Values, size: float = 0.0) -> Float:
    """Return the median of (N, 3) points far from the origin, in whole units; zero for others.

    Points are far if it exceeds 16 times their spread: float32 then loses 4 bits and more. For points less
    than a unit apart, it is a multiple of a smaller power of two. Percentiles of a sample decide, so that
    outliers have no effect. Points are not far if float32's steps there are below 1e-4 of `size`, that of a
    Gaussian.

    >>> far_middle(np.array([[6.5e6, 0.2, 0], [6.5e6 + 3, 0.4, 0]])).tolist()
    [6500002.0, 0.0, 0.0]
    >>> far_middle(np.array([[30, 0.2, 0], [33, 0.4, 0]])).tolist()
    [0.0, 0.0, 0.0]
    """
    sample = points[:: max(1, len(points) // _SAMPLE)].astype(np.float64)
    sample = sample[np.isfinite(sample).all(1)]
    none = np.zeros(3)
    if not len(sample):
        return none
    low, middle, high = np.percentile(sample, (1, 50, 99), axis=0)
    farthest = np.abs(middle).max()
    spread = float(np.linalg.norm(high - low))
    if not farthest > _FAR_SPREADS * spread:
        return none
    if np.spacing(np.float32(farthest)) <= _FINE_STEP * size:
        return none
    if spread > 0:
        unit = 2.0 ** np.floor(np.log2(spread))
    else:
        unit = 1.0
    unit = max(unit, float(np.spacing(farthest)))
    unit = min(1.0, unit)
    return np.rint(middle / unit) * unit


def unit_quats(quats: Float32) -> Float32:
    """Normalise (N, 4) quaternions wxyz.

    Rows within 1e-6 of length 1 keep every bit, so that writing and reading change nothing. Zeros become the
    identity. Rows that are not finite are kept for writers to report.

    >>> unit_quats(np.float32([[-2, 0, 0, 0], [0, 3e30, 4e30, 0], [0, 0, 0, 0]])).round(6).tolist()
    [[-1.0, 0.0, 0.0, 0.0], [0.0, 0.6000000238418579, 0.800000011920929, 0.0], [1.0, 0.0, 0.0, 0.0]]
    """
    lengths = np.linalg.norm(quats.astype(np.float64), axis=1)
    off = np.abs(lengths - 1) > _UNIT_SLACK
    off &= np.isfinite(lengths)
    if not off.any():
        return quats
    zero = lengths == 0
    divisors = np.where(zero, 1.0, lengths)[off]
    unit = quats.copy()
    unit[off] = quats[off] / divisors[:, None]
    unit[zero] = (1, 0, 0, 0)
    return unit
