"""One module per command; importing it registers the command, in the order `g2ard --help` lists them."""

from importlib import import_module

__all__ = ["COMMANDS", "register_commands"]

COMMANDS = (
    "distill",
    "simplify",
    "recover",
    "adapt",
    "register",
    "lift",
    "ingest",
    "convert",
    "clean",
    "poses",
    "select",
    "render",
    "view",
    "lod",
    "evaluate",
    "info",
)


def register_commands(asked: str | None = None) -> None:
    """Put the command `asked` on the app; all of them if it is none."""
    for name in (asked,) if asked in COMMANDS else COMMANDS:
        import_module(f"{__name__}.{name}")
