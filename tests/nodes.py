"""Count the package's syntax-tree nodes by folder: `make lint` prints how much each capability holds."""

import ast
from collections import Counter
from pathlib import Path


def count(package: Path) -> Counter[str]:
    """Return the nodes that `ast.walk` visits in the .py files of each folder of a package."""
    nodes: Counter[str] = Counter()
    for path in package.rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"), str(path))
        nodes[path.parent.relative_to(package.parent).as_posix()] += sum(1 for _ in ast.walk(tree))
    return nodes


if __name__ == "__main__":
    nodes = count(Path(__file__).parents[1] / "g2ard")
    for folder, found in sorted(nodes.items()):
        print(f"{found:9,}  {folder}")
    print(f"{nodes.total():9,}  nodes in all")
