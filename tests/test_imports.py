"""Imports: packages only import packages before them, and there are no cycles within a package."""

import ast
from collections.abc import Iterator
from pathlib import Path

import g2ard

ROOT = Path(g2ard.__file__).parent

LAYERS = (
    "_core",
    "errors",
    "progress",
    "system",
    "config",
    "scene",
    "io",
    "rendering",
    "poses",
    "stages",
    "report",
    "pipeline",
    "tiles",
    "levels",
    "viewer",
    "jobs",
    "cli",
)
"""Packages and modules of `g2ard`, lowest first. Each imports only those before it."""


def modules() -> dict[str, Path]:
    """Every module of the package by its full name."""
    found = {}
    for path in sorted(ROOT.rglob("*.py")):
        parts = ("g2ard", *path.relative_to(ROOT).with_suffix("").parts)
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imported(path: Path) -> Iterator[str]:
    """Return what a module imports of g2ard, also in functions and for type checkers."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "g2ard":
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.startswith("g2ard"))


def test_packages_import_only_layers_below() -> None:
    wrong = []
    for module, path in modules().items():
        if module in ("g2ard", "g2ard.__main__"):  # above all layers
            continue
        package = module.split(".")[1]
        below = LAYERS[: LAYERS.index(package) + 1]
        wrong += [f"{module} imports {name}" for name in imported(path) if name.split(".")[1] not in below]
    assert wrong == []


def test_architecture_lists_the_layers() -> None:
    text = (ROOT.parent / "ARCHITECTURE.md").read_text(encoding="utf-8")
    assert ", ".join(f"`{layer}`" for layer in LAYERS) in text


def test_no_import_cycles() -> None:
    known = modules()
    edges: dict[str, set[str]] = {}
    for module, path in known.items():
        targets = {name if name in known else name.rpartition(".")[0] for name in imported(path)}
        edges[module] = targets & known.keys() - {module, "g2ard"}
    tops = [module for module in edges if not edges[module]]
    while tops:  # remove modules that import nothing, until none is left
        edges = {module: targets - set(tops) for module, targets in edges.items() if module not in tops}
        tops = [module for module in edges if not edges[module]]
    assert not edges


def test_stages_do_not_import_each_other() -> None:
    stages = {name: path for name, path in modules().items() if name.startswith("g2ard.stages.")}
    own = {name: ".".join(name.split(".")[:3]) for name in stages}
    named = ((module, name) for module, path in stages.items() for name in imported(path))
    wrong = [
        f"{m} imports {n}" for m, n in named if n.startswith("g2ard.stages.") and not n.startswith(own[m])
    ]
    assert wrong == []
