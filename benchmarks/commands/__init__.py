"""The commands of `python -m benchmarks`; importing this package registers them."""

from importlib import import_module

from benchmarks.commands.group import bench as app

__all__ = ["app"]

for _name in ("raster", "simplify", "run", "select", "recover", "ship", "register", "synth"):
    import_module(f"{__name__}.{_name}")
