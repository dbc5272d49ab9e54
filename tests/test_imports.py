"""Imports: no cycles, stages import only foundations, and `import g2ard` loads nothing heavy."""

import ast
from collections.abc import Iterator
from pathlib import Path

import g2ard

ROOT = Path(g2ard.__file__).parent

FOUNDATIONS = {
    "_core",
    "__version__",
    "config",
    "errors",
    "io",
    "progress",
    "rendering",
    "report",
    "scene",
    "system",
}


def modules() -> dict[str, Path]:
    """Every module of the package by its full name."""
    found = {}
    for path in sorted(ROOT.rglob("*.py")):
        parts = ("g2ard", *path.relative_to(ROOT).with_suffix("").parts)
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imported(path: Path) -> Iterator[str]:
    """Return what a module imports of g2ard, also in functions, except for type checkers."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            node.body = []
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "g2ard":
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.startswith("g2ard"))


def graph() -> dict[str, set[str]]:
    """Module → the modules that it imports; a name that is no module stands for the module it lies in."""
    known = modules()
    edges: dict[str, set[str]] = {}
    for module, path in known.items():
        targets = {name if name in known else name.rpartition(".")[0] for name in imported(path)}
        edges[module] = targets & known.keys() - {module}
    return edges


def reachable(edges: dict[str, set[str]], start: str) -> set[str]:
    """Return all modules that a module imports, directly or not."""
    seen: set[str] = set()
    waiting = list(edges[start])
    while waiting:
        module = waiting.pop()
        if module not in seen:
            seen.add(module)
            waiting += edges[module]
    return seen


def test_no_import_cycles() -> None:
    edges = graph()
    del edges["g2ard"]  # it loads the public names only when they are used
    edges = {module: targets - {"g2ard"} for module, targets in edges.items()}
    assert not {module for module in edges if module in reachable(edges, module)}


def test_stages_import_only_foundations() -> None:
    wrong = []
    for module, path in modules().items():
        if not module.startswith("g2ard.stages."):
            continue
        stage = ".".join(module.split(".")[:3])
        for name in imported(path):
            package = name.split(".")[1]
            if package not in FOUNDATIONS and not name.startswith(stage):
                wrong.append(f"{module} imports {name}")
    assert wrong == []
