"""Count the files in which a parameter is relayed, and hold the limits: a part of `make lint`.

What travels together is one object, such as `GivenViews` or `ViewFiles`, that is made where it is decided.
"""

import ast
import sys
from pathlib import Path

LIMITS = {"photos": 10, "up": 15, "images": 13}
"""Name → most files with a parameter or keyword argument of that name: commands and public functions."""


def relayed(package: Path, name: str) -> set[Path]:
    """Return the files in which a parameter or keyword argument has this name."""
    trees = {
        path: ast.parse(path.read_text(encoding="utf-8"), str(path))
        for path in package.rglob("*.py")
    }
    named = ast.arg | ast.keyword
    return {
        path
        for path, tree in trees.items()
        if any(isinstance(node, named) and node.arg == name for node in ast.walk(tree))
    }


if __name__ == "__main__":
    found = {name: len(relayed(Path(__file__).parents[1] / "g2ard", name)) for name in LIMITS}
    print(", ".join(f"{name} in {count} files" for name, count in found.items()))
    sys.exit(any(found[name] > limit for name, limit in LIMITS.items()))
