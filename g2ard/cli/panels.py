"""Panels that group options in `--help`."""

from typing import Any, get_args

COMMON = "Common"

GROUPED = ("distill", "simplify", "recover", "adapt", "register", "lod")
"""Commands whose own options are grouped."""

_PANELS = {
    "Budget": ("count", "ratio", "ratios", "fit", "min_psnr", "min_ssim"),
    "Views": (
        *("views", "images", "alpha", "teacher", "photos", "held_out", "split", "size", "background"),
        *("up", "focus", "no_views", "poses", "pool", "intrinsics", "focal"),
    ),
    "Method": (
        *("method", "preset", "keep_region", "clean", "anchors"),
        *("matcher", "refine", "passes", "accept", "protocol"),
    ),
    "Recovery": (
        *("recover", "schedule", "steps", "recovery_time", "weighted", "engine"),
        *("tolerance", "prior_views", "sh_degree"),
    ),
    "Output": (
        *("output", "format", "keep", "view", "parents", "resume", "dry_run", "report", "truth"),
        *("metres_per_unit", "environment", "most", "extent", "least"),
    ),
    "Large scenes": ("memory", "workers", "tile_rows", "scheduler", "work"),
}


def into_panels(name: str, annotation: Any, panel: str | None = None) -> None:
    """Put a parameter's option into `panel`, by default the one that lists its name."""
    found = panel or next((title for title, names in _PANELS.items() if name in names), None)
    for option in get_args(annotation)[1:]:
        option.rich_help_panel = found
