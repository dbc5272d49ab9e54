"""What a distillation can be asked for beside its scene and budget."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from g2ard.config.choices import Engine

if TYPE_CHECKING:
    from g2ard.policy.inputs import Views

    Colour = tuple[float, float, float]
    Function = TypeVar("Function", bound=Callable[..., Any])

__all__ = ["DistillOptions", "takes_options"]


@dataclass(frozen=True, eq=False, kw_only=True)
class DistillOptions:
    """What `distill` can be asked for beside its budget: each field is a keyword of it.

    Args:
        format: of the file that `fit` speaks of: ply, compressed.ply, sog, spz, glb or splat.
        clean: first take out what no picture of the scene needs (`g2ard.stages.clean`).
        views: cameras in world coordinates, or where they lie; None takes those beside the scene, else makes
            a pool of poses; "made" always makes one. Their test split is held out.
        photos: True for the views' photos as targets, and no view without one; False for the scene's renders;
            None for the photo of each view that has one, and the scene's render of the others (sec. 3.1). A
            cloud has no renders to learn from: its lift is no picture of the place.
        held_out: views to score on instead.
        views_count: how many views recovery looks at: a count, a share in (0, 1] or "auto"; None for all, or
            for what the preset says.
        policy: how those are chosen, see `g2ard.select`; "auto" if None.
        weighted: draw views by weights, their own or the selection's; True if None.
        reselect: choose views again from every round's scene.
        method: of simplification: default, fast or paper; "default" if None.
        keep_region: spheres (x, y, z, r) and boxes (x, y, z, x, y, z), world coordinates, which get more of
            the budget, as if views stood √keep_times times as near.
        preset: which regularisers hold the geometry: auto (measured), trained, lift, noisy; paper,
            paper-trained, paper-lift and paper-noisy are the paper's, and turn all that is None here to
            what the paper has.
        schedule: of recovery: fast, default, best or paper; "default" if None.
        steps: the final horizon.
        recovery_time: seconds that all recovery is fitted into; the result then depends on the machine.
        sh_degree: of the result; None keeps the scene's, and takes 3 from a cloud or for the paper's.
        size: pixels that the longer side of views is shrunk to.
        background: RGB in [0, 1] behind the scene.
        constants: by full name, as `--set` has them, such as {"rates.means": 1e-3}.
        beside: where to look for cameras, if `scene` is no path.
        up: (3,) away from the ground, for poses that are made; None to estimate it.
        seed: of all that is random.
        engine: what takes recovery's steps, see `RecoverConfig`.
    """

    format: str = "ply"
    clean: bool = False
    views: Views | None = None
    photos: bool | None = None
    held_out: Views | None = None
    views_count: int | float | Literal["auto"] | None = None
    policy: str | None = None
    weighted: bool | None = None
    reselect: bool = False
    method: str | None = None
    keep_region: Sequence[Sequence[float]] = ()
    preset: str = "auto"
    schedule: str | None = None
    steps: int | None = None
    recovery_time: float | None = None
    sh_degree: int | None = None
    size: int | None = None
    background: Colour = (0.0, 0.0, 0.0)
    constants: Mapping[str, Any] | None = None
    beside: str | Path | None = None
    up: Sequence[float] | None = None
    seed: int = 0
    engine: Engine = "fused"

    def by_preset(self) -> dict[str, Any]:
        """The fields that a preset decides where they are None: method, schedule, policy, views_count and
        weighted, as they are or as the preset has them."""
        usual = _PAPER if self.preset.startswith("paper") else _DEFAULT
        return {name: usual[name] if (own := getattr(self, name)) is None else own for name in usual}


_DEFAULT: dict[str, Any] = {
    "method": "default",
    "schedule": "default",
    "policy": "auto",
    "views_count": None,
    "weighted": True,
}
_PAPER: dict[str, Any] = {
    "method": "paper",
    "schedule": "paper",
    "policy": "directional",
    "views_count": 0.5,
    "weighted": False,
}
"""What an option that is None means, under the paper's presets and else."""


def takes_options(function: Function) -> Function:
    """Show the fields of `DistillOptions` as the keywords that `**options` of a function takes."""
    own = inspect.signature(function)
    named = [p for p in own.parameters.values() if p.kind is not p.VAR_KEYWORD]
    keywords = [
        inspect.Parameter(f.name, inspect.Parameter.KEYWORD_ONLY, default=f.default, annotation=f.type)
        for f in fields(DistillOptions)
    ]
    function.__signature__ = own.replace(parameters=[*named, *keywords])  # type: ignore[attr-defined]
    return function
