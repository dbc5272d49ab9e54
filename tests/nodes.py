"""Count the package's syntax-tree nodes by folder, and how dense its lines are: `make lint` prints both."""

import ast
import io
import tokenize
from collections import Counter
from pathlib import Path

_EMPTY = {
    tokenize.COMMENT,
    tokenize.DEDENT,
    tokenize.ENCODING,
    tokenize.ENDMARKER,
    tokenize.INDENT,
    tokenize.NEWLINE,
    tokenize.NL,
}


def count_nodes(source: str) -> int:
    """Return how many nodes `ast.walk` visits."""
    return sum(1 for _ in ast.walk(ast.parse(source)))


def count_code_lines(source: str) -> int:
    """Return how many lines hold code.

    >>> count_code_lines('x = 1  # one\\n\\n# none\\n"A docstring."\\ny = (\\n    2\\n)\\n')
    4
    """
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in _EMPTY:
            lines.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(source)):
        if _is_docstring(node):
            lines.difference_update(range(node.lineno, node.end_lineno + 1))
    return len(lines)


def _is_docstring(node: ast.AST) -> bool:
    if not isinstance(node, ast.Expr) or not isinstance(node.value, ast.Constant):
        return False
    return isinstance(node.value.value, str)


def main() -> None:
    package = Path(__file__).parents[1] / "g2ard"
    nodes: Counter[str] = Counter()
    lines: Counter[str] = Counter()
    for path in package.rglob("*.py"):
        source = path.read_text(encoding="utf-8")
        folder = path.parent.relative_to(package.parent).as_posix()
        for name in (folder, "in all"):
            nodes[name] += count_nodes(source)
            lines[name] += count_code_lines(source)
    print("    nodes    lines  nodes per line of code")
    for name in sorted(nodes):
        print(f"{nodes[name]:9,}{lines[name]:9,}{nodes[name] / max(lines[name], 1):6.1f}  {name}")


if __name__ == "__main__":
    main()
