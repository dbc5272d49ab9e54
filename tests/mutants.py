"""Mutation tests: one-line changes at random, each of which some test should notice.

    pip install coverage
    python tests/mutants.py python --count 100 --seed 1
    python tests/mutants.py rust --count 50 --seed 1

The working tree is copied and does not change. For Python, the tests run once under coverage, about half an
hour on two cores. Each change is then tested by the tests that execute its line, those of its module and the
fastest first, in a fork of a process that has imported torch. For Rust, one build of the core's tests holds
all changes, and an environment variable selects one. Survivors need a look: slow tests, tests of other
packages and, for Rust, the tests of Python take no part, and some changes have no effect.
"""

import argparse
import ast
import importlib
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from helpers.project import ROOT

PACKAGES = ["config", "io", "jobs", "pipeline", "poses", "rendering", "scene", "stages", "tiles"]
MODULES = ["quantize", "select", "simplify", "train"]
TESTS_OF_SECONDS = 15
"""Limit for the tests of one change, in seconds that they took under coverage."""


class Change(NamedTuple):
    path: Path
    line: int
    old: str
    new: str


# --- Python

_COMPARED: dict[type, str] = {
    ast.Lt: "<=", ast.LtE: "<", ast.Gt: ">=", ast.GtE: ">", ast.Eq: "!=", ast.NotEq: "==",
    ast.In: "not in", ast.NotIn: "in", ast.Is: "is not", ast.IsNot: "is",
}  # fmt: skip
_COMPUTED: dict[type, str] = {
    ast.Add: "-", ast.Sub: "+", ast.Mult: "/", ast.Div: "*", ast.FloorDiv: "*", ast.Mod: "*",
    ast.LShift: ">>", ast.RShift: "<<",
}  # fmt: skip
_NAMED = {"min": "max", "minimum": "maximum", "any": "all", "ceil": "floor"}
_NAMED |= {new: old for old, new in _NAMED.items()}
_SAID = {"say", "progress", "require", "Note", "InputError", "OutputError", "UsageError"}


def _nodes(tree: ast.AST, module: bool = True) -> Iterator[ast.AST]:
    """Yield the nodes of statements that compute something; messages and annotations are left alone."""
    for child in ast.iter_child_nodes(tree):
        if isinstance(
            child, ast.Raise | ast.JoinedStr | ast.Assert | ast.arguments | ast.Import | ast.ImportFrom
        ):
            continue
        if isinstance(child, ast.Call) and getattr(child.func, "id", None) in _SAID:
            continue
        if isinstance(child, ast.AnnAssign):
            if child.value is not None and not isinstance(tree, ast.ClassDef):
                yield child.value
                yield from _nodes(child.value)
            continue
        if isinstance(child, ast.FunctionDef):
            for statement in child.body:
                yield statement
                yield from _nodes(statement)
            continue
        yield child
        yield from _nodes(child)


def _mutated(node: ast.AST, rng: random.Random) -> tuple[ast.expr, str] | None:
    """Return the expression of a node that changes, and its new source."""
    text = ast.unparse
    match node:
        case ast.Compare(ops=[op], comparators=[right]) if type(op) in _COMPARED:
            return node, f"({text(node.left)} {_COMPARED[type(op)]} {text(right)})"
        case ast.BinOp() if type(node.op) in _COMPUTED and not isinstance(
            node.left, ast.Constant | ast.JoinedStr
        ):
            return node, f"(({text(node.left)}) {_COMPUTED[type(node.op)]} ({text(node.right)}))"
        case ast.BoolOp():
            word = " or " if isinstance(node.op, ast.And) else " and "
            return node, f"({word.join(f'({text(value)})' for value in node.values)})"
        case ast.UnaryOp(op=ast.Not() | ast.USub()):
            return node, f"({text(node.operand)})"
        case ast.Constant(value=bool()):
            return node, str(not node.value)
        case ast.Constant(value=int()):
            return node, str(node.value + rng.choice([1, -1]))
        case ast.Constant(value=float()):
            return node, repr(node.value * rng.choice([0.5, 2.0]) if node.value else 1.0)
        case ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name)) if name in _NAMED:
            whole, head = text(node), text(node.func)
            return node, head.removesuffix(name) + _NAMED[name] + whole.removeprefix(head)
        case ast.IfExp():
            return node, f"({text(node.body)} if not ({text(node.test)}) else {text(node.orelse)})"
        case ast.If():
            return node.test, f"(not ({text(node.test)}))"
    return None


def python_changes(tree: Path, count: int, rng: random.Random) -> list[Change]:
    """Return `count` changes of different lines."""
    found = []
    for path in sorted(path for name in PACKAGES for path in (tree / "g2ard" / name).rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        lines = text.splitlines()
        for node in _nodes(ast.parse(text)):
            made = _mutated(node, rng)
            if made is not None and made[0].lineno == made[0].end_lineno:
                place, new = made
                raw = lines[place.lineno - 1].encode()
                line = (raw[: place.col_offset] + new.encode() + raw[place.end_col_offset :]).decode()
                found.append(Change(path, place.lineno, lines[place.lineno - 1], line))
    rng.shuffle(found)
    chosen: dict[tuple[Path, int], Change] = {}
    for change in found:
        if len(chosen) < count and _compiles(change):
            chosen.setdefault((change.path, change.line), change)
    return list(chosen.values())


def _text(change: Change) -> str:
    lines = change.path.read_text(encoding="utf-8").splitlines()
    lines[change.line - 1] = change.new
    return "\n".join(lines) + "\n"


def _compiles(change: Change) -> bool:
    try:
        ast.parse(_text(change))
    except SyntaxError:
        return False
    return True


# The run under coverage: this module is then a plugin of pytest (`-p mutants`).

_SKIPPED = re.compile(r"browser|cuda|fuzz|killed|documented|examples|goldens")
_LIMIT = {"test": 8, "file": 30}
"""Seconds of a test, and of all tests of a file, under coverage. Slower tests take no part."""
_used: dict[Path, float] = {}


class _TooLong(Exception):
    pass


def _covering() -> "coverage.Coverage":  # noqa: F821
    import coverage

    if not hasattr(_covering, "it"):
        sources = [str(ROOT / "g2ard" / name) for name in PACKAGES]
        _covering.it = coverage.Coverage(os.environ["G2ARD_COVERAGE"], source=sources, config_file=False)
    return _covering.it


def pytest_sessionstart() -> None:
    _covering().start()


def pytest_sessionfinish() -> None:
    _covering().stop()
    _covering().save()


def pytest_runtest_setup(item: "pytest.Item") -> None:  # noqa: F821
    import pytest

    if _used.get(item.path, 0) > _LIMIT["file"]:
        pytest.skip("its file takes long")


def pytest_runtest_logstart(nodeid: str) -> None:
    _covering().switch_context(nodeid)


def pytest_runtest_call(item: "pytest.Item") -> None:  # noqa: F821
    def stop(*_: object) -> None:
        raise _TooLong

    signal.signal(signal.SIGALRM, stop)
    signal.alarm(_LIMIT["test"])


def pytest_runtest_logreport(report: "pytest.TestReport") -> None:  # noqa: F821
    signal.alarm(0)
    path = ROOT / report.nodeid.partition("::")[0]
    _used[path] = _used.get(path, 0) + report.duration
    if report.when == "call":
        with Path(os.environ["G2ARD_COVERAGE"] + ".times").open("a") as out:
            out.write(json.dumps([report.nodeid, report.duration, report.outcome]) + "\n")


def cover(tree: Path, folder: Path) -> None:
    """Run the tests of every package under coverage; what stands in `folder` is kept."""
    folder.mkdir(exist_ok=True)
    for name in PACKAGES:
        tests = sorted(p for p in (tree / "tests" / name).glob("test_*.py") if not _SKIPPED.search(p.name))
        if not (folder / name).exists():
            print(f"coverage of {name}", flush=True)
            env = environment(tree) | {"G2ARD_COVERAGE": str(folder / name)}
            words = ["-p", "mutants", *map(str, tests), str(tree / "g2ard" / name)]
            subprocess.run(
                [sys.executable, "-m", "pytest", *_OPTIONS, *words],
                cwd=tree,
                env=env,
                stdout=subprocess.DEVNULL,
            )


class Covered:
    """Tests that execute each line, and their durations."""

    def __init__(self, folder: Path) -> None:
        from coverage import CoverageData

        self.seconds: dict[str, float] = {}
        for file in folder.glob("*.times"):
            for line in file.read_text().splitlines():
                test, seconds, outcome = json.loads(line)
                if outcome == "passed":
                    self.seconds[test] = seconds
        self.parts = [CoverageData(str(file)) for file in folder.iterdir() if not file.suffix]
        for part in self.parts:
            part.read()

    def tests(self, change: Change, module: str) -> list[str]:
        """Return tests of about `TESTS_OF_SECONDS`; those whose file is named like the module come first.

        A line that runs once, when its module is imported, is left to the tests that execute any line of it.
        """
        lines: set[str] = set()
        whole: set[str] = set()
        for part in self.parts:
            for number, contexts in part.contexts_by_lineno(str(change.path)).items():
                whole.update(contexts)
                if number == change.line:
                    lines.update(contexts)
        known = [test for test in (lines - {""} or whole) if test in self.seconds]
        near = {test for test in known if module in test.partition("::")[0]}
        chosen: list[str] = []
        left = float(TESTS_OF_SECONDS)
        for test in sorted(known, key=lambda test: (test not in near, self.seconds[test], test)):
            left -= self.seconds[test]
            if left > 0:
                chosen.append(test)
        return chosen


def run_python(tree: Path, changes: list[Change], covered: Covered) -> Iterator[tuple[Change, str]]:
    for change in changes:
        original, changed = change.path.read_text(encoding="utf-8"), _text(change)
        tests = covered.tests(change, change.path.stem)
        if not tests:
            yield change, "survived, no test executes it"
            continue
        doctests = [str(change.path)] if ">>>" in original else []
        try:
            change.path.write_text(changed, encoding="utf-8")
            yield change, _forked(["-x", *doctests, *tests], tree)
        finally:
            change.path.write_text(original, encoding="utf-8")


def _forked(words: list[str], tree: Path) -> str:
    """Run pytest in a fork of this process, which imports what takes long and is not g2ard only once."""
    for name in (
        "torch",
        "pytest",
        "hypothesis.extra.numpy",
        "plyfile",
        "PIL.Image",
        "rich.console",
        "typer",
    ):
        importlib.import_module(name)
    with tempfile.TemporaryFile("w+", errors="replace") as out:
        child = os.fork()
        if child == 0:
            os.setsid()
            for stream in (1, 2):
                os.dup2(out.fileno(), stream)
            os._exit(_pytest(words, tree))
        status = None
        until = time.monotonic() + _MOST_SECONDS
        while status is None and time.monotonic() < until:
            time.sleep(0.05)
            ended, found = os.waitpid(child, os.WNOHANG)
            status = os.waitstatus_to_exitcode(found) if ended else None
        if status is None:
            os.killpg(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return f"killed: not finished after {_MOST_SECONDS} s"
        out.seek(0)
        return _judged(status, out.read())


def _pytest(words: list[str], tree: Path) -> int:
    import pytest

    try:
        os.chdir(tree)
        os.environ.update(environment(tree))
        for name in [name for name in sys.modules if name.partition(".")[0] in ("helpers", "mutants")]:
            del sys.modules[name]
        sys.path[:] = [
            str(tree),
            *(path for path in sys.path if not Path(path).is_relative_to(ROOT / "tests")),
        ]
        sys.argv = ["pytest", *words]
        return int(pytest.main([*_OPTIONS, *words]))
    except BaseException:  # the fork must end here
        return 99
    finally:
        sys.stdout.flush()


def _judged(status: int, text: str) -> str:
    if status == 0:
        return "survived"
    lines = (line for line in text.splitlines() if re.match(r"FAILED|ERROR|test .* FAILED", line))
    return f"killed by {next(lines, f'status {status}')}"


_MOST_SECONDS = 180
_OPTIONS = ["-q", "-p", "no:cacheprovider", "--no-header"]


def environment(tree: Path) -> dict[str, str]:
    paths = [str(tree), str(tree / "tests"), os.environ.get("PYTHONPATH", "")]
    threads = {"RAYON_NUM_THREADS": "2", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    return {**os.environ, **threads, "PYTHONPATH": os.pathsep.join(paths), "PYTHONDONTWRITEBYTECODE": "1"}


# --- Rust

_SWAPPED = [
    (" < ", " <= "), (" > ", " >= "), (" == ", " != "), (" && ", " || "), (" + ", " - "), (" * ", " / "),
    (" += ", " -= "), (".min(", ".max("), (".any(", ".all("), (".floor()", ".ceil()"), ("true", "false"),
]  # fmt: skip
_SWAPPED += [(new, old) for old, new in _SWAPPED]
_SWAPPED += [("if !", "if "), ("..=", ".."), (" *= ", " /= "), (".sqrt()", ".abs()"), ("break", "continue")]
_FUNCTION = re.compile(r"^(\s*)(pub(\([^)]*\))? )?(unsafe )?fn \w+")
_NUMBER = re.compile(r"(?<![\w.\[])(\d+\.\d+|\d+)(?![\w.])")
_SWITCH = """
static MUTANT: std::sync::LazyLock<u32> =
    std::sync::LazyLock::new(|| std::env::var("G2ARD_MUTANT").map_or(0, |n| n.parse().unwrap()));
pub(crate) fn mutant(n: u32) -> bool {
    *MUTANT == n
}
"""


def _bodies(lines: list[str]) -> Iterator[tuple[int, int]]:
    """Yield the first line and the end of every function's body that can be written twice."""
    for i, line in enumerate(lines):
        if line == "mod tests {":
            return
        if not (function := _FUNCTION.match(line)):
            continue
        j = next(j for j in range(i, len(lines)) if lines[j].endswith(("{", ";", "}")))
        if lines[j].endswith("{") and "-> impl" not in " ".join(lines[i : j + 1]):
            yield j + 1, lines.index(function[1] + "}", j)


def _rust_lines(line: str) -> Iterator[str]:
    plain = re.sub(r'"[^"]*"', lambda text: "\0" * len(text[0]), line.partition("//")[0])
    if re.match(r"\s*(#|use |(debug_)?assert)", plain):
        return
    for old, new in _SWAPPED:
        for found in re.finditer(re.escape(old), plain):
            yield line[: found.start()] + new + line[found.end() :]
    for found in _NUMBER.finditer(plain):
        number = found[0]
        new = (str(2 * float(number)) if float(number) else "1.0") if "." in number else str(int(number) + 1)
        yield line[: found.start()] + new + line[found.end() :]


class RustChanges:
    """Changes of functions, each function's body written once more for each of its changes."""

    def __init__(self, tree: Path, rng: random.Random) -> None:
        self.tree, self.core = tree, tree / "rust/g2ard-core/src"
        self.texts = {path: path.read_text(encoding="utf-8") for path in self.core.rglob("*.rs")}
        self.bodies: dict[Change, tuple[int, int]] = {}
        for path in sorted(path for name in MODULES for path in (self.core / name).glob("*.rs")):
            lines = self.texts[path].split("\n")
            for start, end in _bodies(lines) if path.name != "tests.rs" else ():
                for at in range(start, end):
                    for new in _rust_lines(lines[at]):
                        self.bodies.setdefault(Change(path, at + 1, lines[at], new), (start, end))
        self.left = list(self.bodies)
        rng.shuffle(self.left)
        self.chosen: dict[int, Change] = {}
        self.drawn = 0

    def draw(self, count: int) -> None:
        """Write `count` changes that compile."""
        while True:
            while len(self.chosen) < count and self.left:
                change = self.left.pop()
                self.left = [c for c in self.left if (c.path, c.line) != (change.path, change.line)]
                self.drawn += 1
                self.chosen[self.drawn] = change
            wrong = self._errors(self._write())
            if not wrong:
                return
            for number in wrong:
                del self.chosen[number]

    def _write(self) -> dict[Path, list[tuple[int, int, int]]]:
        """Write the changed sources; return by file the lines of each change and its number."""
        places: dict[Path, list[tuple[int, int, int]]] = {}
        for path, text in self.texts.items():
            lines, out = text.split("\n"), []
            of = {n: c for n, c in self.chosen.items() if c.path == path}
            i = 0
            while i < len(lines):
                here = {n: c for n, c in of.items() if self.bodies[c][0] == i}
                if not here:
                    out.append(lines[i])
                    i += 1
                    continue
                start, end = self.bodies[next(iter(here.values()))]
                for number, change in here.items():
                    out.append(f"if crate::mutant({number}) {{")
                    first = len(out) + 1
                    out += [*lines[start : change.line - 1], change.new, *lines[change.line : end], "} else"]
                    places.setdefault(path, []).append((first, len(out), number))
                out += ["{", *lines[start:end], "}"]
                i = end
            path.write_text("\n".join(out), encoding="utf-8")
        library = self.core / "lib.rs"
        library.write_text(self.texts[library] + _SWITCH, encoding="utf-8")
        return places

    def _errors(self, places: dict[Path, list[tuple[int, int, int]]]) -> set[int]:
        """Return the numbers of the changes that do not compile."""
        words = [
            "cargo",
            "check",
            "--tests",
            "--profile",
            "bench",
            "-p",
            "g2ard-core",
            "--message-format=json",
        ]
        done = subprocess.run(words, cwd=self.tree, capture_output=True, text=True)
        wrong = set()
        for line in done.stdout.splitlines():
            told = json.loads(line).get("message", {})
            for span in told["spans"] if told.get("level") == "error" else []:
                for first, last, number in places.get(self.tree / span["file_name"], []):
                    if first <= span["line_start"] <= last:
                        wrong.add(number)
        if done.returncode and not wrong:
            raise SystemExit(done.stderr)
        return wrong

    def run(self) -> Iterator[tuple[Change, str]]:
        """Test each change by the tests of its module."""
        words = ["cargo", "test", "--profile", "bench", "-p", "g2ard-core", "--lib"]
        subprocess.run([*words, "--no-run"], cwd=self.tree, check=True)
        for number, change in sorted(self.chosen.items()):
            env = environment(self.tree) | {"G2ARD_MUTANT": str(number)}
            module = change.path.relative_to(self.core).parts[0]
            try:
                done = subprocess.run(
                    [*words, "--", f"{module}::"],
                    cwd=self.tree,
                    env=env,
                    capture_output=True,
                    text=True,
                    timeout=_MOST_SECONDS,
                )
            except subprocess.TimeoutExpired:
                yield change, f"killed: not finished after {_MOST_SECONDS} s"
            else:
                yield change, _judged(done.returncode, done.stdout)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("language", choices=["python", "rust"])
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--work", type=Path, default=Path(tempfile.gettempdir()) / "g2ard-mutants")
    chosen = parser.parse_args()
    tree = chosen.work / "tree"
    if not tree.exists():
        ignored = shutil.ignore_patterns(".git", ".venv", "target", "dist", "site", "bench", "__pycache__")
        shutil.copytree(ROOT, tree, ignore=ignored, symlinks=True)
    rng = random.Random(chosen.seed)
    if chosen.language == "python":
        changes = python_changes(tree, chosen.count, rng)
        cover(tree, chosen.work / "coverage")
        results = run_python(tree, changes, Covered(chosen.work / "coverage"))
    else:
        rust = RustChanges(tree, rng)
        rust.draw(chosen.count)
        results = rust.run()
    killed = 0
    for change, outcome in results:
        killed += outcome.startswith("killed")
        print(
            f"{change.path.relative_to(tree)}:{change.line}: {change.old.strip()}  ->  {change.new.strip()}"
        )
        print(f"    {outcome}", flush=True)
    print(f"killed {killed} of {chosen.count}")


if __name__ == "__main__":
    main()
