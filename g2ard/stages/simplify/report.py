"""What simplification tells of its work."""

from __future__ import annotations

from dataclasses import dataclass, field

from g2ard.report.base import LEFT_OUT, Report


@dataclass(frozen=True)
class SimplifyRound(Report):
    """One round: before − dropped − merged − trimmed = after.

    Args:
        before: Gaussians.
        dropped: for their opacity.
        merged: by how many merging shrank the scene.
        trimmed: for their priority.
        after: Gaussians.
        cells: `paper`: locality cells, 0 where none were needed.
        refused: `paper`: groups that a guard refused, by guard.
        skipped_alone: `paper`: rows without another in their cell and colour bin.
        undone_groups: `paper`: merges taken back, for the budget needs their rows.
        clamped_opacities: `paper`: merged α that reached 0.99.
    """

    before: int
    dropped: int
    merged: int
    trimmed: int
    after: int
    cells: int | None = field(default=None, metadata=LEFT_OUT)
    refused: dict[str, int] | None = field(default=None, metadata=LEFT_OUT)
    skipped_alone: int | None = field(default=None, metadata=LEFT_OUT)
    undone_groups: int | None = field(default=None, metadata=LEFT_OUT)
    clamped_opacities: int | None = field(default=None, metadata=LEFT_OUT)


@dataclass(frozen=True)
class SimplifyReport(Report):
    """A reduction in numbers.

    Args:
        input_count: Gaussians given.
        output_count: Gaussians left.
        merged_members: rows of the input that share an output row.
        rounds: one after another.
        protected: rows of the output that are flagged.
        nonfinite_rows: of the input, left out.
        infinite_logits: taken as α = 0 or 1.
        clamped_opacities: merged α that reached 0.99: what `max_growth` could not take was lost.
        fitted: rows whose opacity or, where that is full, area was fitted to what views see.
        unseen: rows of the input that are kept though no view sees them; None without views.
        faded: merged α < 1/255 where a member's was not.
        skipped: `alone`: rows passed on as they were; `sh_bands`: of zeros, left out of all sums; of the
            paper's, `coverages`: groups that the cheaper guard had refused; rounds without `binnings`, or
            `trims`: few rows were left already.
        seconds: in the pipeline, what the stage took, visibility included.
    """

    input_count: int
    output_count: int
    merged_members: int
    rounds: tuple[SimplifyRound, ...]
    protected: int
    nonfinite_rows: int
    infinite_logits: int
    clamped_opacities: int
    fitted: int
    unseen: int | None
    faded: int
    skipped: dict[str, int]
    seconds: float | None = field(default=None, metadata=LEFT_OUT)
