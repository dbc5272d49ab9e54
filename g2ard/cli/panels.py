"""The options that `--help` shows, and the topics that group the others in `--help-all`."""

from copy import copy
from inspect import Parameter
from typing import Annotated, Any, get_args

from typer.core import TyperCommand

USED: dict[str, tuple[str, ...]] = {
    "distill": (
        *("output", "count", "ratio", "fit", "views"),
        *("images", "photos", "size", "schedule", "time", "format", "resume"),
    ),
    "simplify": ("output", "count", "ratio", "fit", "views", "method", "no_views", "overwrite"),
    "recover": (
        *("output", "views", "teacher", "photos", "images"),
        *("size", "schedule", "steps", "recovery_time", "background", "resume"),
    ),
    "adapt": ("output", "views", "teacher", "images", "size", "steps", "background", "resume"),
    "register": (
        "output",
        "photos",
        "poses",
        "pool",
        "focal",
        "intrinsics",
        "size",
        "matcher",
        "report",
    ),
    "lift": ("output", "box", "where", "color", "overwrite"),
    "ingest": ("output", "tile_rows", "overwrite"),
    "convert": (
        *("overwrite", "sh_degree", "box", "sphere", "where", "color"),
        *("scale", "rotate", "translate", "from_axes", "to_axes"),
    ),
    "clean": ("output", "only", "strength", "split_sky", "preview", "dry_run", "overwrite"),
    "poses": ("output", "looks", "kind", "size", "fov", "up", "format", "overwrite"),
    "select": ("output", "k", "views", "images", "split", "preset", "format", "overwrite"),
    "render": (
        *("output", "sheet", "looks", "views", "turn"),
        *("size", "background", "split", "depth", "overwrite"),
    ),
    "view": ("output", "views", "start", "background", "up", "overwrite"),
    "lod": (
        "output",
        "kind",
        "ratios",
        "recover",
        "views",
        "size",
        "place",
        "environment",
        "resume",
    ),
    "evaluate": (
        *("output", "views", "teacher", "photos", "images"),
        *("split", "size", "background", "lpips", "json"),
    ),
    "compare": ("output", "views", "looks", "size", "background", "overwrite"),
    "info": ("devices", "images", "json"),
}
"""Command → at most twelve options that people use, in order of use; `--help` shows these."""

_PANELS = {
    "Budget": ("count", "ratio", "ratios", "fit", "min_psnr", "min_ssim"),
    "Views": (
        *(
            "views",
            "images",
            "alpha",
            "teacher",
            "photos",
            "held_out",
            "split",
            "size",
            "background",
        ),
        *("up", "focus", "no_views", "poses", "pool", "intrinsics", "focal", "views_format"),
    ),
    "Method": (
        *("method", "preset", "keep_region", "clean", "anchors", "convention"),
        *("matcher", "refine", "passes", "accept"),
        *("neighbors", "spread", "normal_ratio", "max_anisotropy", "opacity"),
    ),
    "Recovery": (
        *("recover", "schedule", "steps", "time", "recovery_time", "weighted", "engine"),
        *("tolerance", "prior_views", "sh_degree"),
    ),
    "Output": (
        *("output", "format", "keep", "page", "parents", "resume", "dry_run", "report", "truth"),
        *("environment", "most", "extent", "least", "layout", "spz_version", "compress"),
        *("depth", "around", "fps"),
    ),
    "Geometry": (
        *("box", "sphere", "invert", "where", "color", "transform"),
        *("scale", "rotate", "translate", "recentre", "from_axes", "to_axes"),
    ),
    "Large scenes": ("memory", "workers", "tile_rows", "scheduler", "work"),
    "Common": (
        *("overwrite", "json", "config", "print_config", "set", "render_model"),
        *("seed", "threads", "device", "quiet", "verbose"),
    ),
}
"""Topic → its options, in the order of `--help-all`."""

_TOPICS: dict[str, str] = {}
for _topic, _names in _PANELS.items():
    _TOPICS |= dict.fromkeys(_names, _topic)


def ordered(command: str, parameters: list[Parameter]) -> list[Parameter]:
    """Return a command's parameters with used options first, the others by topic."""
    used = USED[command]
    topics = list(_PANELS)

    def place(parameter: Parameter) -> tuple[int, int, int]:
        if parameter.name in used:
            return 0, used.index(parameter.name), 0
        topic = _TOPICS.get(parameter.name, "Output")
        names = _PANELS[topic]
        return (
            1,
            topics.index(topic),
            names.index(parameter.name) if parameter.name in names else len(names),
        )

    return sorted(parameters, key=place)  # stable: arguments are shown apart


def in_panel(command: str, parameter: Parameter) -> Parameter:
    """Return a parameter with its option in the panel of its topic; used ones are in the first panel."""
    kind, option = get_args(parameter.annotation)
    if type(option).__name__ == "OptionInfo":
        option = copy(option)  # several commands share it
        used = parameter.name in USED[command]
        option.rich_help_panel = None if used else _TOPICS.get(parameter.name, "Output")
    return parameter.replace(annotation=Annotated[kind, option])


_FORMER = {("distill", "--view"): "--page", ("distill", "--no-view"): "--no-page"}
"""Command and a flag's former spelling, which scripts still use → its spelling."""


class Command(TyperCommand):
    """A command whose `--help` shows the options people use, and `--help-all` all of them."""

    _all = False

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Show all options for `--help-all`; take a flag by its former spelling."""
        args = [_FORMER.get((str(self.name), word), word) for word in args]
        self._all = "--help-all" in args
        if self._all:
            args = ["--help"]
        return super().parse_args(ctx, args)

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Print the help with the used options or all of them."""
        params = self.params
        epilog = self.epilog
        used = USED.get(str(self.name), ())
        rest = [p for p in params if p.param_type_name == "option" and p.name not in used]
        if not self._all and rest:
            self.params = [p for p in params if p not in rest]
            self.epilog = f"{epilog}\n\nAll options: {ctx.command_path} --help-all"
        try:
            super().format_help(ctx, formatter)
        finally:
            self.params = params
            self.epilog = epilog
