"""The dense scene of a run: the few operations that see all of it, whatever its size."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import ClassVar, Protocol

from g2ard.arrays import Mask, Values
from g2ard.config.choices import BLACK, Colour
from g2ard.errors import InputError
from g2ard.io.stream import PartsStream
from g2ard.progress import Progress, silent
from g2ard.rendering.targets import CACHE_BYTES, Targets, TeacherRenders
from g2ard.rendering.visibility import SampledVisibility, visibility_source
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats
from g2ard.stages.simplify import SimplifyConfig, simplify
from g2ard.stages.simplify.gaps import opacity_lost
from g2ard.stages.simplify.pairs import VisibilitySource
from g2ard.stages.simplify.reduce import SimplifyReport
from g2ard.system.keys import UNKEYED


class Merged(Protocol):
    """A scene merged to fewer Gaussians, such as `Simplified`."""

    @property
    def splats(self) -> Splats | PartsStream: ...
    @property
    def protected(self) -> Mask | None: ...
    @property
    def report(self) -> SimplifyReport: ...


class Dense(Protocol):
    """A dense scene, in memory or in tiles. What follows its merge needs no more of it than this.

    Attributes:
        sample: some of its Gaussians, on which views are planned and constants chosen, or all.
        total: number of its Gaussians.
        most_rows: a scene that is merged to at most so many Gaussians is in memory.
    """

    @property
    def sample(self) -> Splats: ...
    @property
    def total(self) -> int: ...
    @property
    def most_rows(self) -> float: ...

    def identity(self) -> list[str]:
        """Return what identifies the Gaussians that are not in the sample."""

    def merge(
        self,
        count: int,
        views: Cameras | None,
        config: SimplifyConfig,
        *,
        protected: Mask | None = None,
        final_budget: int | None = None,
        gaps: bool = False,
        progress: Progress = silent,
    ) -> Merged:
        """Merge the scene to a count; see `g2ard.stages.simplify.simplify`.

        Args:
            views: that weigh Gaussians by visibility; None for none.
        """

    def images(
        self, views: Cameras, background: Colour = BLACK, limit: int = CACHE_BYTES
    ) -> Targets:
        """Return the scene's images in some views, made on access; memory keeps `limit` bytes of them."""

    def opacity_lost(self, result: Splats, views: Cameras) -> float:
        """Return the share of light that a result lets through, see `g2ard.stages.simplify.gaps`."""

    def derive(self, scene: Splats | PartsStream, name: str) -> Dense:
        """Return a scene that was merged from this one as a dense scene."""


@dataclass(eq=False)
class InMemory:
    """A dense scene in memory."""

    splats: Splats
    most_rows: ClassVar[float] = math.inf
    _sources: dict[int, tuple[Cameras, VisibilitySource]] = field(
        default_factory=dict, metadata=UNKEYED
    )

    @property
    def sample(self) -> Splats:
        """All Gaussians."""
        return self.splats

    @property
    def total(self) -> int:
        """Number of Gaussians."""
        return len(self.splats)

    def identity(self) -> list[str]:
        """Return nothing, since all Gaussians are in the sample."""
        return []

    def merge(
        self,
        count: int,
        views: Cameras | None,
        config: SimplifyConfig,
        *,
        protected: Mask | None = None,
        final_budget: int | None = None,
        gaps: bool = False,
        progress: Progress = silent,
    ) -> Merged:
        """Merge the scene, see `Dense`. Visibility is measured once for all counts."""
        if views is not None and id(views) not in self._sources:
            source = visibility_source(views, progress=progress)
            self._sources = {id(views): (views, _Remembering(source, source.views))}
        return simplify(
            self.splats,
            count,
            config=config,
            visibility=None if views is None else self._sources[id(views)][1],
            protected=protected,
            final_budget=final_budget,
            gaps=gaps,
            progress=progress,
        )

    def images(
        self, views: Cameras, background: Colour = BLACK, limit: int = CACHE_BYTES
    ) -> Targets:
        """Return renders of the scene."""
        return TeacherRenders(self.splats, views, background=background, limit=limit, lazy=True)

    def opacity_lost(self, result: Splats, views: Cameras) -> float:
        """Return the share of light that a result lets through."""
        return opacity_lost(self.splats, result, views)

    def derive(self, scene: Splats | PartsStream, name: str) -> InMemory:
        """Return a scene that was merged from this one."""
        return InMemory(load_whole(scene))


class _Remembering:
    """A source of visibility that keeps that of its first scene, with which every reduction starts."""

    def __init__(self, source: VisibilitySource, views: Cameras) -> None:
        self.source = source
        self.views = views
        self.first: tuple[list[Values], SampledVisibility] | None = None

    def __call__(self, scene: Splats) -> SampledVisibility:
        # Scales are clamped anew by each reduction; a kept scene would keep its prepared copy, too.
        arrays = [scene.means, scene.quats, scene.logit_opacities]
        if self.first is not None and all(
            a is b for a, b in zip(self.first[0], arrays, strict=True)
        ):
            return self.first[1]
        seen = self.source(scene)
        if self.first is None:
            self.first = arrays, seen
        return seen


def as_dense(prior: Splats | Dense) -> Dense:
    """Return a dense scene: the given one, or one in memory of Gaussians."""
    if isinstance(prior, Splats):
        return InMemory(prior.narrowed())
    if not hasattr(type(prior), "merge"):
        raise InputError(f"expected Splats or tiles, got {type(prior).__name__}", parameter="prior")
    return prior


def load_whole(scene: Splats | PartsStream) -> Splats:
    """Return a merged scene in memory."""
    return scene.whole() if isinstance(scene, PartsStream) else scene
