"""Imports: packages only import packages before them, and there are no cycles within a package."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import g2ard

ROOT = Path(g2ard.__file__).parent

LAYERS = (
    "_core",
    "arrays",
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
        wrong += [
            f"{module} imports {name}" for name in imported(path) if name.split(".")[1] not in below
        ]
    assert wrong == []


def test_architecture_lists_the_layers() -> None:
    text = (ROOT.parent / "ARCHITECTURE.md").read_text(encoding="utf-8")
    assert ", ".join(f"`{layer}`" for layer in LAYERS) in text


def test_architecture_names_files_that_exist() -> None:
    text = (ROOT.parent / "ARCHITECTURE.md").read_text(encoding="utf-8")
    code = [
        path.as_posix()
        for name in ("g2ard", "rust", "tests", "benchmarks")
        for path in (ROOT.parent / name).rglob("*")
    ]
    named = set(re.findall(r"`([\w/.-]+\.(?:py|rs|pyi))`", text))
    assert [
        name for name in sorted(named) if not any(path.endswith(f"/{name}") for path in code)
    ] == []


def rust_modules(source: Path) -> dict[str, Path]:
    """Every module of a crate by its path from the crate's root; the root itself is ''."""
    found = {}
    for path in source.rglob("*.rs"):
        *folder, name = path.relative_to(source).with_suffix("").parts
        if name != "tests":
            found["::".join(folder if name in ("mod", "lib") else [*folder, name])] = path
    return found


def rust_paths(text: str) -> Iterator[str]:
    """Return the paths of a file from `crate` or `super` on, without those of its tests."""
    text = re.sub(r"//[^\n]*", "", text.split("#[cfg(test)]\nmod tests {")[0])
    pending = re.findall(r"\b(?:crate|super)::(?:[\w:]+|\{)[^;]*;", text)
    while pending:
        path = re.sub(r"\s", "", pending.pop())
        if opened := re.match(r"([\w:]*)\{(.*)\}", path):
            pending += [
                opened[1] + part for part in re.findall(r"(?:[^,{}]|\{[^}]*\})+", opened[2])
            ]
        else:
            yield path.partition(";")[0]
    yield from re.findall(r"\b(?:crate|super)(?:::\w+)+", text)


def rust_imports(known: dict[str, Path], module: str) -> set[str]:
    """Return the modules that a module uses, without those around it."""
    found = set()
    for path in rust_paths(known[module].read_text(encoding="utf-8")):
        at = [] if path.startswith("crate") else module.split("::")
        for word in path.split("::"):
            if word == "super":
                at = at[:-1]
            elif word != "crate" and "::".join([*at, word]) in known:
                at = [*at, word]
        found.add("::".join(at))
    return {name for name in found if not f"{module}::".startswith(f"{name}::") and name}


@pytest.mark.parametrize("crate", ["python", "g2ard-core", "g2ard-gpu", "g2ard-py"])
def test_no_import_cycles(crate: str) -> None:
    edges: dict[str, set[str]] = {}
    known = modules() if crate == "python" else rust_modules(ROOT.parent / "rust" / crate / "src")
    assert len(known) > 5
    for module, path in known.items():
        if crate == "python":
            targets = {
                name if name in known else name.rpartition(".")[0] for name in imported(path)
            }
            edges[module] = targets & known.keys() - {module, "g2ard"}
        else:
            edges[module] = rust_imports(known, module)
    tops = [module for module in edges if not edges[module]]
    while tops:  # remove modules that import nothing, until none is left
        edges = {
            module: targets - set(tops) for module, targets in edges.items() if module not in tops
        }
        tops = [module for module in edges if not edges[module]]
    assert not edges


def test_modules_are_imported_by_their_own_names() -> None:
    """`from g2ard.io import judge` would import all that the package's face imports."""
    known = modules()
    faces = {
        name for name, path in known.items() if path.name == "__init__.py" and [*imported(path)]
    }
    wrong = [
        f"{module} imports {node.module}.{alias.name}"
        for module, path in known.items()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom) and node.module in faces
        for alias in node.names
        if f"{node.module}.{alias.name}" in {*known, "g2ard._core"}
    ]
    assert wrong == []


def test_stages_do_not_import_each_other() -> None:
    stages = {name: path for name, path in modules().items() if name.startswith("g2ard.stages.")}
    own = {name: ".".join(name.split(".")[:3]) for name in stages}
    named = ((module, name) for module, path in stages.items() for name in imported(path))
    wrong = [
        f"{m} imports {n}"
        for m, n in named
        if n.startswith("g2ard.stages.") and not n.startswith(own[m])
    ]
    assert wrong == []
