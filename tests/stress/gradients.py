"""Gradients of the rasteriser and of its float64 twin against finite differences, case by random case."""

from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray

from reference.raster import Oracle
from stress.scenes import NAMES, Params, Problem, random_problem, weighted

__all__ = ["ENGINE_TOLERANCE", "TWIN_TOLERANCE", "Tally", "check_problem", "crossings"]

TWIN_TOLERANCE, ENGINE_TOLERANCE = 1e-6, 1e-3
"""Tolerance as a share of max(|g|, 1e-3 of the class's largest |g|)."""

CENTRAL = ((-2, 1 / 12), (-1, -8 / 12), (1, 8 / 12), (2, -1 / 12))
FORWARD = ((0, -25 / 12), (1, 48 / 12), (2, -36 / 12), (3, 16 / 12), (4, -3 / 12))
BACKWARD = tuple((-at, -weight) for at, weight in FORWARD)
"""Fourth order all: the third is the second from the other side."""

LADDER = (1.0, 0.5, 0.25, 0.125, 1 / 16, 1 / 32, 1 / 64)
"""Steps tried, in the class's own unit, until two of them agree."""

LONGER = (8.0, 4.0, 2.0, *LADDER[:2])
"""Tried where the shorter ones drown in rounding."""


@dataclass
class Tally:
    """Results of the cases of one parameter class."""

    central: int = 0
    one_sided: int = 0
    lively: int = 0
    unsettled: int = 0
    crossed: Counter[str] = field(default_factory=Counter)
    worst_twin: float = 0.0
    worst_engine: float = 0.0
    failures: list[str] = field(default_factory=list)

    @property
    def checked(self) -> int:
        return self.central + self.one_sided


def crossings(a: Oracle, b: Oracle) -> list[str]:
    """Return the discrete decisions in which two renders differ; empty if they lie on one smooth piece."""
    mine, other = a.decisions, b.decisions
    if not torch.equal(mine["order"], other["order"]):
        same = torch.equal(mine["order"].sort().values, other["order"].sort().values)
        return ["sort" if same else "near plane"]
    kinds = ("tile", "skip", "stop", "clip", "dark", "clamp")
    return [kind for kind in kinds if kind in mine and not torch.equal(mine[kind], other[kind])]


@dataclass
class _Line:
    """The functional along one coordinate: renders are kept, for stencils share points."""

    problem: Problem
    name: str
    at: tuple[int, ...]
    unit: float

    def __post_init__(self) -> None:
        self.known: dict[float, tuple[float, Oracle]] = {}
        self.params: Params = {k: v.astype(np.float64) for k, v in self.problem.params.items()}
        self.start = self.params[self.name][self.at]

    def render(self, step: float) -> tuple[float, Oracle]:
        if step not in self.known:
            self.params[self.name][self.at] = self.start + step * self.unit
            with torch.no_grad():
                out, _ = self.problem.oracle(self.params)
                loss = float(self.problem.loss(out.image, out.alpha, out.depth))
            self.known[step] = loss, out
        return self.known[step]

    def noise(self, h: float) -> float:
        """Return the uncertainty of a slope due to rounding of the functional's terms."""
        out = self.render(0.0)[1]
        parts = torch.cat([out.image, out.alpha[..., None], out.depth[..., None]], -1)
        spread = float((parts * torch.from_numpy(self.problem.weights)).norm())
        return 2 * float(np.finfo(np.float64).eps) * spread / (h * self.unit)

    def slope(self, stencil: tuple[tuple[int, float], ...], h: float) -> float | str:
        """The derivative, or which decision changes within the stencil."""
        total, (start, base) = 0.0, self.render(0.0)
        for at, weight in stencil:
            loss, out = self.render(at * h)
            kinds = crossings(base, out)
            if kinds:
                return kinds[0]
            total += weight * (loss - start)
        return total / (h * self.unit)


def _settled(
    line: _Line,
    stencil: tuple[tuple[int, float], ...],
    scale: float,
    ladder: tuple[float, ...] = LADDER,
) -> float | str | None:
    """The slope on which two steps of the ladder agree best; None if none do, a kind if all of them cross."""
    slopes: list[float] = []
    kind = ""
    for h in ladder:
        slope = line.slope(stencil, h)
        if isinstance(slope, str):
            kind = kind or slope
            continue
        size = max(abs(slope), scale)
        if size and line.noise(h) > 0.5 * TWIN_TOLERANCE * size:
            break  # the smaller steps drown in the rounding of the sums
        slopes.append(slope)
        if len(slopes) > 1 and abs(slopes[-1] - slopes[-2]) <= 0.1 * TWIN_TOLERANCE * size:
            return slope
    if not slopes:
        return kind or None
    gaps = np.abs(np.diff(slopes))
    if len(gaps) and gaps.min() <= 0.5 * TWIN_TOLERANCE * max(
        abs(slopes[int(gaps.argmin())]), scale
    ):
        return slopes[int(gaps.argmin())]
    return None


def _unit(problem: Problem, name: str, row: int) -> float:
    """A step small beside what the functional bends over: a share of a pixel, of a logit, of a quaternion."""
    if name == "means":
        pose = problem.cameras.viewmats[0]
        depth = abs(problem.params["means"][row].astype(np.float64) @ pose[2, :3] + pose[2, 3])
        return 4e-3 * max(depth, 0.05) / float(problem.cameras.Ks[0, 1, 1])
    if name == "quats":
        scales = problem.params["log_scales"][row].astype(np.float64)
        aspect = float(np.exp(scales.min() - scales.max()))
        length = float(np.linalg.norm(problem.params["quats"][row].astype(np.float64)))
        return 4e-3 * length * max(aspect, 0.02)
    return {"log_scales": 4e-3, "logit_opacities": 4e-3, "sh0": 2e-2, "shN": 2e-2}[name]


def _check(
    problem: Problem,
    name: str,
    at: tuple[int, ...],
    gradients: tuple[NDArray[np.float64], NDArray[np.float32]],
    tally: Tally,
    label: str,
) -> None:
    twin, engine = (float(g[at]) for g in gradients)
    scale = 1e-3 * float(np.abs(gradients[0]).max())
    line = _Line(problem, name, at, _unit(problem, name, at[0]))
    # The issue's ±h decides what counts as crossed, not the smallest step of the ladder that still fits.
    first = line.slope(CENTRAL, LADDER[0])
    if isinstance(first, str):
        tally.crossed[first] += 1
        sides = [s for s in (FORWARD, BACKWARD) if not isinstance(line.slope(s, LADDER[0]), str)]
        if not sides:
            return
        stencil = sides[0]
        tally.one_sided += 1
    else:
        stencil = CENTRAL
        tally.central += 1
    slope = _settled(line, stencil, scale)
    if slope is None:
        slope = _settled(line, stencil, scale, LONGER)
    if slope is None or isinstance(slope, str):
        tally.unsettled += 1
        return
    size = max(abs(slope), scale)
    tally.lively += abs(slope) > scale
    if size == 0:
        errors = (0.0, 0.0) if twin == engine == 0 else (np.inf, np.inf)
    else:
        errors = abs(twin - slope) / size, abs(engine - slope) / size
    tally.worst_twin, tally.worst_engine = (
        max(tally.worst_twin, errors[0]),
        max(tally.worst_engine, errors[1]),
    )
    if errors[0] > TWIN_TOLERANCE or errors[1] > ENGINE_TOLERANCE:
        tally.failures.append(
            f"{label} {name}{list(at)}: differences {slope:.9g}, twin {twin:.9g}, engine {engine:.9g}, "
            f"scale {scale:.3g}"
        )


def check_problem(
    seed: int, per_class: int, tallies: dict[str, Tally]
) -> tuple[Problem, list[NDArray[np.float64]]]:
    """Check `per_class` coordinates of every class; returns the problem and its outputs' errors."""
    rng = np.random.default_rng((seed, 1))
    problem = random_problem(seed)
    edge = None
    if rng.random() < 0.3:
        problem, edge = _at_an_edge(problem, rng)
    out, tensors = problem.oracle(problem.params, grad=True)
    loss = problem.loss(out.image, out.alpha, out.depth)
    if loss.requires_grad:
        loss.backward()
    outputs, engine = problem.engine()
    shown = out.decisions["order"].numpy()
    for name, tensor in zip(NAMES, tensors, strict=True):
        if not tensor.numel():
            continue
        grad = tensor.grad if tensor.grad is not None else torch.zeros_like(tensor)
        places = [edge[1]] if edge is not None and edge[0] == name else []
        while len(places) < per_class:
            row = (
                rng.choice(shown)
                if len(shown) and rng.random() < 0.95
                else rng.integers(len(tensor))
            )
            places.append((int(row), *(int(rng.integers(s)) for s in tensor.shape[1:])))
        for at in places:
            _check(problem, name, at, (grad.numpy(), engine[name]), tallies[name], f"seed {seed}")
    sure = ~out.doubtful
    wanted = (out.image.detach(), out.alpha.detach(), out.depth.detach())
    errors = [
        ((a.double() - b).abs()[sure] / max(1.0, float(b.abs().max()))).flatten().numpy()
        for a, b in zip(outputs, wanted, strict=True)
    ]
    return problem, errors


def _at_an_edge(
    problem: Problem, rng: np.random.Generator
) -> tuple[Problem, tuple[str, tuple[int, ...]] | None]:
    """One coordinate moved to half a step from a clip, a dark colour or the field of view's clamp; which."""
    name, kind = [("logit_opacities", "clip"), ("sh0", "dark"), ("means", "clamp")][
        int(rng.integers(3))
    ]
    row = int(rng.integers(len(problem.params[name])))
    if kind == "clip":  # only a splat that covers a pixel's centre squarely can reach it
        row = int(problem.oracle(problem.params)[0].weight.amax(1).argmax())
    at = (row, *(int(rng.integers(s)) for s in problem.params[name].shape[1:]))
    line = _Line(problem, name, at, _unit(problem, name, row))
    base = line.render(0.0)[1]
    for reach in 40.0 * 2.0 ** np.arange(7):
        step = reach * rng.choice([-1, 1])
        if kind in crossings(base, line.render(step)[1]):
            break
    else:
        return problem, None
    low, high = 0.0, step
    for _ in range(40):
        middle = 0.5 * (low + high)
        if kind in crossings(base, line.render(middle)[1]):
            high = middle
        else:
            low = middle
    params = {k: v.copy() for k, v in problem.params.items()}
    params[name][at] = line.start + (low + rng.choice([-1, 1]) * 0.5) * line.unit
    return weighted(replace(problem, params=params), rng), (name, at)
