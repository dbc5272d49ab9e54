"""One module per command, registered on import in the order of `g2ard --help`."""

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
    "compare",
    "info",
)


def register_commands(asked: str | None = None) -> None:
    """Register the command `asked`, or all commands if there is no such command."""
    for name in (asked,) if asked in COMMANDS else COMMANDS:
        import_module(f"{__name__}.{name}")
