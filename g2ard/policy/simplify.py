"""`g2ard.simplify`: the views that the stage weighs errors by, then the stage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from g2ard.policy.budget import Budget
from g2ard.policy.inputs import load_scene, say_regions
from g2ard.policy.views import cameras_for_looks
from g2ard.progress import Progress, Say, silent, unsaid
from g2ard.scene.splats import Splats

if TYPE_CHECKING:
    from g2ard.policy.inputs import Views
    from g2ard.stages.simplify import Simplified, SimplifyConfig, Visibility, VisibilitySource


def simplify(
    scene: Splats | str | Path,
    *,
    count: int | None = None,
    ratio: float | None = None,
    fit: str | None = None,
    min_psnr: float | None = None,
    min_ssim: float | None = None,
    format: str = "ply",
    views: Views | None = None,
    blind: bool = False,
    method: str | None = None,
    keep_region: Sequence[Sequence[float]] | None = None,
    config: SimplifyConfig | None = None,
    settings: Mapping[str, Any] | None = None,
    beside: str | Path | None = None,
    up: Sequence[float] | None = None,
    seed: int = 0,
    progress: Progress = silent,
    say: Say = unsaid,
) -> Simplified:
    """Reduce a scene to an exact number of Gaussians, as `g2ard simplify` does, to the bit; no images needed.

    The default method weighs errors by what is seen: from `views`, else from the cameras that lie beside the
    scene, else from a pool of poses of its own. `fast` looks only from given views, `paper` from none.

    Args:
        scene: the dense scene, or its path.
        count: Gaussians to keep, at most as many as there are.
        ratio: how many times fewer to keep, at least 1; the result has N/ratio, rounded to the nearest.
        fit: instead, about the most whose file has these bytes at most, such as "5MB"; or a device: quest3,
            mobile or web.
        min_psnr: instead, about the fewest that keep this PSNR, dB, against the scene in views of its own.
        min_ssim: the same of SSIM; with `min_psnr` both hold. `say` tells what the result has.
        format: of the file that `fit` speaks of: ply, compressed.ply, sog, spz, glb or splat.
        views: cameras in world coordinates, or where they lie, of which the training split is used;
            "made" makes a pool even if cameras lie beside the scene.
        blind: use no cameras at all.
        method: default, fast or paper; `g2ard.stages.simplify.simplify` says what they do.
        keep_region: spheres (x, y, z, r) and boxes (x, y, z, x, y, z), world coordinates, which get more of
            the budget, as if views stood √keep_times times as near.
        config: None means the method's own; `method` and `keep_region`, if given, win over it.
        settings: values of `config` by path, such as {"simplify.max_energy": 0.02}; they win over all.
        beside: where to look for cameras, if `scene` is no path; its folder and its trainer's are looked in.
        up: (3,) away from the ground, for poses that are made; None to estimate it.
        seed: of poses that are made.
        progress: told of planning, visibility and Gaussians shed.
        say: told in lines what was noticed and which views are used.

    Returns:
        The scene, where each row went, protection flags and a report.

    Raises:
        InputError: not exactly one kind of budget, one that does not fit, an unknown method, views
            that cannot be read, no such constant, or both `views` and `blind`.

    >>> import numpy as np
    >>> ball = np.random.default_rng(0).normal(size=(900, 3))
    >>> ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    >>> small = simplify(Splats.create(ball, scales=np.full((900, 3), 0.05)), ratio=10)
    >>> len(small.splats), small.parents.shape, small.report.output_count
    (90, (900,), 90)
    """
    from g2ard.config.presets import configured
    from g2ard.policy.fit import aim_of
    from g2ard.stages.simplify import SimplifyConfig

    fields = {"method": method, "keep_region": keep_region}
    given = {name: value for name, value in fields.items() if value is not None}
    config = configured(config or SimplifyConfig(), settings=given | dict(settings or {}))
    wanted = Budget(count, ratio, fit=fit, min_psnr=min_psnr, min_ssim=min_ssim)
    splats, beside, name = _scene(scene, beside, say)
    reduce = Reduction(
        splats,
        views=views,
        blind=blind,
        config=config,
        beside=beside,
        up=up,
        seed=seed,
        progress=progress,
        say=say,
    )
    file = f"scene.{format}"
    aim = aim_of(wanted, splats, name, file=file, reduce=reduce, seed=seed, progress=progress, say=say)
    small = aim.shrink_simplified(reduce(aim.count), say)
    if judgement := aim.judge(small.splats):
        say(judgement[1])
    return small


class Reduction:
    """A scene's reductions to any budget, each as `simplify` gives it: count → `Simplified`.

    Poses and what they see of the scene are found once, and the last two results stay.

    Args:
        splats: the dense scene.
        progress: told of planning, visibility and Gaussians shed.
        say: told in lines what was noticed and which views are used.

    The others are as for `simplify`.

    Raises:
        InputError: as `simplify`.
    """

    def __init__(
        self,
        splats: Splats,
        *,
        views: Views | None = None,
        blind: bool = False,
        config: SimplifyConfig | None = None,
        beside: str | Path | None = None,
        up: Sequence[float] | None = None,
        seed: int = 0,
        progress: Progress = silent,
        say: Say = unsaid,
    ) -> None:
        from g2ard.errors import InputError
        from g2ard.stages.simplify import SimplifyConfig

        if views is not None and blind:
            raise InputError("views, blind: blind uses no views")
        self.splats, self.blind = splats, blind
        self.config, self.progress = config or SimplifyConfig(), progress
        say_regions(splats, self.config, "the scene", say)
        self._plan = partial(
            cameras_for_looks,
            splats,
            views,
            self.config.method,
            beside=beside,
            up=up,
            seed=seed,
            progress=progress,
            say=say,
        )
        self._made: dict[int, Simplified] = {}

    def __call__(self, count: int) -> Simplified:
        """The scene at a budget."""
        from g2ard.stages.simplify import simplify as reduce

        if count not in self._made:
            made = reduce(
                self.splats,
                count,
                visibility=self._look if count < len(self.splats) else None,
                config=self.config,
                progress=self.progress,
            )
            self._made = dict([*self._made.items(), (count, made)][-2:])
        return self._made[count]

    @cached_property
    def _look(self) -> VisibilitySource | None:
        from g2ard.rendering.visibility import visibility_source

        cameras = None if self.blind else self._plan()
        return None if cameras is None else _remembering(visibility_source(cameras, progress=self.progress))


def _scene(
    scene: Splats | str | Path, beside: str | Path | None, say: Say
) -> tuple[Splats, str | Path | None, str]:
    """The scene, where cameras may lie beside it, and what errors call it."""
    if isinstance(scene, Splats):
        return scene, beside, "scene"
    return load_scene(scene, say), beside or scene, str(scene)


def _remembering(look: VisibilitySource) -> VisibilitySource:
    """What views see of the first scene is found once: reductions to other budgets begin with it too."""
    first: list[tuple[Splats, Visibility]] = []

    def remembered(scene: Splats) -> Visibility:
        if first and _same(first[0][0], scene):
            return first[0][1]
        seen = look(scene)
        if not first:
            first.append((scene, seen))
        return seen

    return remembered


def _same(a: Splats, b: Splats) -> bool:
    """Whether two scenes hold the very arrays of one: each reduction clamps scales anew, and colours are not
    looked at."""
    return all(getattr(a, name) is getattr(b, name) for name in ("means", "quats", "logit_opacities"))
