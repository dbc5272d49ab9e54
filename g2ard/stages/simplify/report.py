"""Reports of simplification."""

from dataclasses import dataclass, field

from g2ard.io.reports import LEFT_OUT, Report


@dataclass(frozen=True)
class SimplifyRound(Report):
    """Report of one round: before − dropped − merged − trimmed = after.

    Args:
        dropped: dropped for low opacity.
        trimmed: trimmed for low priority.
        cells: `paper`: number of locality cells; 0 if none were needed.
        refused: `paper`: groups rejected, by guard.
        skipped_alone: `paper`: rows alone in their cell and colour bin.
        undone_groups: `paper`: merges undone to reach the budget.
        clamped_opacities: `paper`: merged rows whose α was limited to 0.99.
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
    """Report of a simplification.

    Args:
        merged_members: input rows that share an output row.
        protected: flagged output rows.
        nonfinite_rows: input rows dropped because they are not finite.
        infinite_logits: infinite logits, taken as α = 0 or 1.
        clamped_opacities: merged rows whose α was limited to 0.99, losing what `max_growth` could not absorb.
        growth: `default`, `fast`: the largest growth of a merged row's area, see `SimplifyConfig.max_growth`.
        opacity_lost: share of the light that the scene's opaque pixels stop but the result lets through, if
            it was measured.
        fitted: rows whose opacity (or area, at full opacity) was fitted to visibility.
        unseen: kept input rows that no view sees; None without views.
        faded: merged rows with α < 1/255 although a member's was not.
        skipped: `alone`: unmerged rows; `sh_bands`: bands of zeros, not computed; for `paper`, `coverages`:
            groups already rejected by the cheaper guard, and rounds that needed no `binnings` or `trims`.
        seconds: in the pipeline, time of the stage including visibility.
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
    growth: float | None = field(default=None, metadata=LEFT_OUT)
    opacity_lost: float | None = field(default=None, metadata=LEFT_OUT)
    seconds: float | None = field(default=None, metadata=LEFT_OUT)
