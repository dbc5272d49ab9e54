"""One module per command; importing this package registers them, in the order `g2ard --help` lists them."""

from importlib import import_module

COMMANDS = (
    "distill",
    "simplify",
    "recover",
    "adapt",
    "lift",
    "poses",
    "select",
    "render",
    "evaluate",
    "info",
    "bench",
    "synth",
)

for _name in COMMANDS:
    import_module(f"{__name__}.{_name}")
