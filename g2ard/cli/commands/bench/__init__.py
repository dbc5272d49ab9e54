"""`g2ard bench`: time against the machine's limits, and against error; importing registers the commands."""

from importlib import import_module

for _name in ("raster", "simplify", "run", "select", "recover", "ship", "register"):
    import_module(f"{__name__}.{_name}")
