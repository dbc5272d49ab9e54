"""Record what commands and calls write on small scenes, and compare it later.

    python tests/goldens.py record                 # write tests/goldens.json
    python tests/goldens.py compare                # exit status 1 if anything differs
    python tests/goldens.py record --to FILE       # for two commits on one machine: record one …
    python tests/goldens.py compare --with FILE    # … and compare the other

The commands are in `goldens.txt`, calls and inputs in `helpers/golden_cases.py`. Each case runs in its own
folder and processes, forked from this one, which has imported g2ard but called nothing. The record has hashes
of every file and of the printed text, with durations, dates, paths and sizes of memory masked.

Bits depend on the processor and on libraries. On another machine than that of the record, only exit statuses,
names of files and keys of JSON are compared. `--isa portable` or a variable in `CHOOSING` makes this machine
another.
"""

import argparse
import contextlib
import dataclasses
import hashlib
import importlib
import json
import os
import platform
import re
import shlex
import shutil
import signal
import sys
import tempfile
import time
import traceback
import zlib
from collections.abc import Callable, Iterator
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does
    os.environ.setdefault("RAYON_NUM_THREADS", "2")
    sys.path[:0] = [str(Path(__file__).resolve().parents[up]) for up in (0, 1)]

import numpy as np
import pytest

from helpers import golden_cases as cases
from helpers.killed import command, forked, killed
from helpers.plans import FOLDER, share_plans

RECORD, TABLE = (Path(__file__).with_suffix(suffix) for suffix in (".json", ".txt"))
MOMENTS = (0.2, 0.7)
"""Shares of a command's renamed files, or of a call's progress, after which it is interrupted."""

CHOOSING = ("OPENBLAS_CORETYPE", "NPY_DISABLE_CPU_FEATURES", "GLIBC_TUNABLES")
"""Variables by which OpenBLAS, numpy and the C library choose other code, as they do on other processors."""

SAME = "same"
"""Expected outcome of an interrupted run."""

ELSEWHERE = "recorded on another machine"
COMPARED = "only exit statuses, names of files and keys of JSON are compared"

Found = dict[str, Any]

# ── what is masked ────────────────────────────────────────────────────────────────────────────────────

_TIME = r"\d[\d.,]* ?(?:ms|s|min|h)\b(?: \d+ (?:s|min)\b)?"
_MASKS = (
    # progress of a long stage
    (re.compile(rf"(?m)^[^:\n]+:(?: [\d,/]+)?  {_TIME}(?:  .*)?\n"), ""),
    (re.compile(r"\b\d{4}-\d\d-\d\d([T ]\d\d:\d\d(:\d\d)?)?|\b\d\d?:\d\d(:\d\d)?\b"), "<date>"),
    (re.compile(rf"\b{_TIME}"), "<time>"),
    (re.compile(r"\b\d[\d.,]* (?:k|M|G)B\b"), "<size>"),
    (re.compile(r"\.[0-9a-f]{12}\b"), ".<unique>"),
)
_MASKED_KEYS = re.compile(
    r"seconds|(^|_)(eta|peak|rss|time|date|version|resumed?|host|memory)(_|$)|^adapter$"
)
"""Keys of JSON whose values vary from run to run."""
_TEXTS = (".html", ".txt", ".toml", ".csv", ".md")


def masked(text: str, root: Path) -> str:
    for path in {str(root), str(root.resolve())}:
        text = text.replace(path, "<root>")
    for pattern, word in _MASKS:
        text = pattern.sub(word, text)
    return text


def keys(text: bytes | str, before: str = "") -> Iterator[str]:
    """Yield the keys of JSON objects, except in lists, whose rows may depend on numbers."""
    with contextlib.suppress(ValueError):
        yield from _keys(json.loads(text), before)


def _keys(value: Any, before: str) -> Iterator[str]:
    for name in sorted(value) if isinstance(value, dict) else ():
        if "/" in name:  # a path
            continue
        yield f"{before}.{name}"
        yield from _keys(value[name], f"{before}.{name}")


def canonical(value: Any, root: Path) -> Any:
    """Return parsed JSON with its varying values masked."""
    if isinstance(value, dict):
        masks = {key: "<masked>" for key in value if _MASKED_KEYS.search(key)}
        kept = {key: item for key, item in value.items() if key not in masks}
        return {masked(key, root): canonical(item, root) for key, item in kept.items()} | masks
    if isinstance(value, list):
        return [canonical(item, root) for item in value]
    return masked(value, root) if isinstance(value, str) else value


def printed_text(data: bytes, root: Path) -> str:
    """Return what a command printed, masked; JSON in a canonical form."""
    text = data.decode("utf-8", "replace")
    try:
        return json.dumps(canonical(json.loads(text), root), sort_keys=True)
    except ValueError:
        return masked(text, root)


def content(path: Path, root: Path) -> bytes:
    """Return what is hashed of a file."""
    data = path.read_bytes()
    if path.suffix == ".json":
        return printed_text(data, root).encode()
    return masked(data.decode("utf-8", "replace"), root).encode() if path.suffix in _TEXTS else data


def digest(data: bytes | str) -> str:
    return hashlib.sha256(data.encode() if isinstance(data, str) else data).hexdigest()[:16]


# ── cases ─────────────────────────────────────────────────────────────────────────────────────────────


@dataclasses.dataclass(frozen=True)
class Case:
    """One line of the record."""

    name: str
    run: Callable[["Place"], Found]
    sliced: bool


class Place:
    """The folder of a case, beside which the inputs are."""

    def __init__(self, root: Path, name: str) -> None:
        self.root = root
        self.folder = root / name.replace("/", "-")
        self.texts = root / "texts" / self.folder.name
        self.texts.mkdir(parents=True)
        self.clear()

    def clear(self) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir()
        (self.folder / "in").symlink_to(self.root / "inputs")

    def does(self, name: str, work: Callable[[], object]) -> tuple[int, str, str]:
        """Run a function; return its status and masked texts."""
        out, err = self.texts / f"{name}.out", self.texts / f"{name}.err"
        status = forked(work, out, err, self.folder)
        texts = [printed_text(path.read_bytes(), self.root) for path in (out, err)]
        return status, texts[0], texts[1]

    def files(self) -> dict[str, bytes]:
        """Return the contents of files that are no inputs, by path."""
        found = (Path(place) / name for place, _, names in os.walk(self.folder) for name in names)
        kept = sorted(path for path in found if path.is_file())
        return {path.relative_to(self.folder).as_posix(): content(path, self.root) for path in kept}


def found(place: Place, done: list[tuple[int, str, str]]) -> Found:
    """Return the line of the record: what commands printed and which files they left."""
    files = place.files()
    errors = [error.strip()[:200] for status, _, error in done if status]
    json_keys = [key for i, row in enumerate(done) for key in keys(row[1], str(i))]
    json_keys += [
        key for name, data in files.items() if name.endswith(".json") for key in keys(data, name)
    ]
    return {
        "status": [row[0] for row in done],
        **({"errors": errors} if errors else {}),
        "out": digest("\0".join(row[1] for row in done)),
        "err": digest("\0".join(row[2] for row in done)),
        "keys": digest("\0".join(json_keys)),
        "files": {name: digest(data) for name, data in files.items()},
    }


def resumed(words: list[str]) -> list[str]:
    """Return the words of a command with its option to continue an interrupted run."""
    return [*words, "--resume"] if words[0] in cases.RESUMED else words


def run_commands(place: Place, commands: list[list[str]], interrupted: bool) -> Found:
    count = place.texts / "count"
    first, *others = commands
    done = [place.does("0", killed(command(first), 0, count))]
    done += [place.does(str(i), command(words)) for i, words in enumerate(others, 1)]
    result = found(place, done)
    if not interrupted:
        return result
    renamed, result["again"] = int(count.read_text()), []
    for after in (max(1, round(share * renamed)) for share in MOMENTS if renamed > 1):
        place.clear()
        place.does(f"killed{after}", killed(command(first), after))
        again = [place.does(f"again{after}", command(resumed(first)))]
        again += [
            place.does(f"again{after}.{i}", command(words)) for i, words in enumerate(others, 1)
        ]
        ended = found(place, again)
        lost = differing(result["files"], ended["files"])
        right = ended["status"] == result["status"] and not lost
        what = f"killed after {after} of {renamed} files: {ended['status']} {ended.get('errors', '')} {lost}"
        result["again"].append(SAME if right else what[:300])
    return result


def differing(a: dict[str, str], b: dict[str, str]) -> list[str]:
    return sorted(name for name in a.keys() | b.keys() if a.get(name) != b.get(name))


def fields(value: Any, name: str = "result") -> Iterator[tuple[str, str]]:
    """Yield the parts of a result of g2ard and what identifies each."""
    if isinstance(value, np.ndarray):
        yield name, f"{value.dtype} {value.shape} {digest(np.ascontiguousarray(value).tobytes())}"
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            if not field.name.startswith("_") and not _MASKED_KEYS.search(field.name):
                yield from fields(getattr(value, field.name), f"{name}.{field.name}")
    elif isinstance(value, list | tuple):
        for i, item in enumerate(value):
            yield from fields(item, f"{name}[{i}]")
    elif isinstance(value, dict):
        yield name, json.dumps(canonical(value, Path("/nowhere")), sort_keys=True, default=str)
    elif isinstance(value, str | int | float | Path | None):
        yield name, repr(value)


def printing(call: Callable[[Any], Any]) -> Callable[[], object]:
    """Return a function that makes a call and prints the parts of its result, or the error of g2ard."""

    def run() -> None:
        import g2ard

        try:
            for name, what in fields(call(g2ard)):
                print(name, what)
        except g2ard.G2ardError as error:
            print(type(error).__name__, error)

    return run


def run_call(place: Place, call: Callable[[Any], Any]) -> Found:
    return found(place, [place.does("0", printing(call))])


def run_stopped(place: Place, call: Callable[[Any, Path, Any], Any]) -> Found:
    """Make a call, then again after Ctrl-C at some reports of progress; the result must be the same."""
    work, count = place.folder / "work", place.texts / "count"

    def attempt(stop: int) -> Callable[[], object]:
        told = 0

        def progress(*_: Any) -> None:
            nonlocal told
            told += 1
            if told == stop:
                signal.raise_signal(signal.SIGINT)

        def run() -> None:
            work.mkdir(exist_ok=True)
            printing(lambda g: call(g, work, progress))()
            count.write_text(str(told))
            shutil.rmtree(work)  # checkpoints hold durations

        return run

    result = found(place, [place.does("0", attempt(0))])
    steps, whole, result["again"] = int(count.read_text()), result["out"], []
    for stop in sorted({max(1, round(share * steps)) for share in (*MOMENTS, 0.45, 0.9)}):
        place.clear()
        place.does(f"stopped{stop}", attempt(stop))
        again = found(place, [place.does(f"again{stop}", attempt(0))])
        right = (again["status"], again["out"]) == ([0], whole)
        result["again"].append(
            SAME if right else f"stopped at report {stop} of {steps}: another result"
        )
    return result


def all_cases() -> Iterator[Case]:
    for name, marks, commands in table():
        again = "r" in marks
        yield Case(name, partial(run_commands, commands=commands, interrupted=again), "s" in marks)
        if "t" in marks:
            tiled = [[*commands[0], *cases.TILES], *commands[1:]]
            yield Case(
                f"{name}@tiles", partial(run_commands, commands=tiled, interrupted=again), False
            )
    for name, call in cases.CALLS.items():
        yield Case(f"python/{name}", partial(run_call, call=call), False)
    for name, stopped in cases.STOPPED.items():
        yield Case(f"stopped/{name}", partial(run_stopped, call=stopped), name == "adapt")


def table() -> Iterator[tuple[str, str, list[list[str]]]]:
    """Yield the name, the marks and the commands of each case of goldens.txt."""
    lines = TABLE.read_text(encoding="utf-8").replace("\\\n", "").splitlines()
    rows = [
        (line[:20].strip(), line[20:25].strip(), line[25:])
        for line in lines
        if line and line[0] != "#"
    ]
    starts = [i for i, (name, *_) in enumerate(rows) if name]
    for start, end in zip(starts, [*starts[1:], len(rows)], strict=True):
        name, marks, _ = rows[start]
        yield name, marks, [shlex.split(words) for *_, words in rows[start:end]]


# ── the record ────────────────────────────────────────────────────────────────────────────────────────


def machine(isa: str | None) -> dict[str, str]:
    """Return what bits depend on; `isa` is the kernels' instruction set unless it is the fastest."""
    info = Path("/proc/cpuinfo")
    rows = dict(re.findall(r"(?m)^([\w ]+?)\s*: (.*)$", info.read_text() if info.exists() else ""))
    flags = [
        flag
        for flag in ("fma", "avx2", "avx512f", "avx512bw")
        if flag in rows.get("flags", "").split()
    ]
    model = [rows.get(key, "") for key in ("vendor_id", "cpu family", "model")]
    chosen = [f"{name}={os.environ[name]}" for name in CHOOSING if os.environ.get(name)]
    versions = [f"{name} {version(name)}" for name in ("numpy", "pillow", "plyfile", "torch")]
    return {
        "processor": " ".join([platform.machine(), *model, *flags, *chosen, *filter(None, [isa])]),
        "versions": ", ".join(
            [*versions, f"zlib {zlib.ZLIB_RUNTIME_VERSION}", f"Python {sys.version.split()[0]}"]
        ),
    }


def run_all(chosen: list[Case], root: Path, jobs: int, isa: str | None) -> dict[str, Found]:
    """Run cases, `jobs` at a time, and return their lines of the record."""
    importlib.import_module("g2ard.__main__")
    import g2ard
    import g2ard._core as _core

    if isa:
        for name in ("Rasterizer", "Trainer"):
            setattr(_core, name, partial(getattr(_core, name), isa=isa))

    for name in g2ard.__all__:
        if name != "rasterize":  # needs torch
            getattr(g2ard, name)
    if FOLDER in os.environ:  # among other tests
        share_plans(pytest.MonkeyPatch())
    inputs = root / "inputs"
    inputs.mkdir()
    if forked(lambda: cases.make_inputs(inputs), root / "inputs.log", root / "inputs.log", root):
        sys.exit((root / "inputs.log").read_text())
    for path in inputs.rglob("*"):
        os.utime(path, (1e9, 1e9))  # reports tell it
    before = tree(inputs)
    running: dict[int, tuple[Case, float]] = {}
    waiting, results = list(chosen), {}
    while waiting or running:
        while waiting and len(running) < jobs:
            case = waiting.pop(0)
            child = os.fork()
            if not child:
                run_case(case, root)
            running[child] = case, time.monotonic()
        child, status, used = os.wait4(-1, 0)
        case, began = running.pop(child)
        line = root / f"{case.name.replace('/', '-')}.line"
        results[case.name] = (
            json.loads(line.read_text()) if not status else {"failed": ["the runner failed"]}
        )
        seconds = (
            f"{time.monotonic() - began:.1f} s, {used.ru_utime + used.ru_stime:.1f} s of CPU time"
        )
        print(f"{case.name}: {seconds}", flush=True)
    if tree(inputs) != before:
        results["inputs"] = {"failed": ["a command has changed an input"]}
    return {name: results[name] for name in sorted(results)}


def run_case(case: Case, root: Path) -> None:
    status = 1
    try:
        result = case.run(Place(root, case.name))
        (root / f"{case.name.replace('/', '-')}.line").write_text(json.dumps(result))
        status = 0
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(status)


def tree(folder: Path) -> dict[str, str]:
    return {
        str(path): digest(path.read_bytes()) for path in sorted(folder.rglob("*")) if path.is_file()
    }


_HASH = re.compile(r"-[0-9a-f]{16}(?=\.)")
"""Part of a step's name that depends on what the processor has computed before."""


def differences(was: Found, now: Found, elsewhere: bool) -> list[str]:
    """Return what differs between two lines of the record; that an interrupted run ends better does not."""
    pairs = zip(was.get("again", []), now.get("again", []), strict=False)
    again = [end for before, end in pairs if before == SAME != end]
    if elsewhere:
        lines = [key for key in ("status", "keys") if was[key] != now[key]]
        before, after = ({_HASH.sub("", name) for name in line["files"]} for line in (was, now))
        return [*lines, *sorted(before ^ after), *again]
    lines = [*again, *(key for key in ("status", "keys", "out", "err") if was[key] != now[key])]
    old, new = was.get("errors", []), now.get("errors", [])
    lines += [f"- {error}" for error in old if error not in new]
    lines += [f"+ {error}" for error in new if error not in old]
    return [*lines, *differing(was["files"], now["files"])]


def refusals(results: dict[str, Found]) -> list[str]:
    """Return the cases that must not be recorded: failures outside errors/, and misspelt options anywhere."""
    found = []
    for name, line in results.items():
        errors = line.get("errors", [])
        if any(line.get("status", [])) and not name.startswith("errors/"):
            found.append(f"{name}: exit statuses {line['status']}: {' '.join(errors)}")
        found += [f"{name}: {error}" for error in errors if "No such option" in error]
    return found


def written(record: Found) -> str:
    """Format a record, one line per case."""
    rows = sorted(record["cases"].items())
    lines = ",\n".join(f"{json.dumps(name)}: {json.dumps(line)}" for name, line in rows)
    return f'{{"machine": {json.dumps(record["machine"])},\n"cases": {{\n{lines}\n}}}}\n'


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    add = parser.add_argument
    add("action", choices=["record", "compare"])
    add(
        "--only",
        metavar="PATTERN",
        default="",
        help="cases whose name matches this regular expression",
    )
    add("--slice", action="store_true", help="the cases of `make test`")
    add("--to", "--with", dest="record", type=Path, default=RECORD, help="file of the record")
    add("--keep", type=Path, metavar="DIR", help="keep everything that was written in a new folder")
    add("--jobs", type=int, default=os.cpu_count() or 1, help="cases at a time")
    add("--isa", help="instruction set of the rasteriser and the trainer: avx2, portable")
    asked = parser.parse_args()
    chosen = [
        c for c in all_cases() if re.search(asked.only, c.name) and (c.sliced or not asked.slice)
    ]
    with tempfile.TemporaryDirectory(prefix="goldens") as temporary:
        root = asked.keep or Path(temporary)
        root.mkdir(parents=True, exist_ok=asked.keep is None)
        results = run_all(chosen, root.resolve(), asked.jobs, asked.isa)
    failed = [
        f"{name}: {text}" for name, line in results.items() for text in line.pop("failed", [])
    ]
    here = {"machine": machine(asked.isa), "cases": results}
    known = json.loads(asked.record.read_text()) if asked.record.exists() else None
    if asked.action == "record":
        failed += refusals(results)
        if failed:
            sys.exit("nothing is recorded:\n" + "\n".join(failed))
        if len(chosen) < len(list(all_cases())) and known:
            if known["machine"] != here["machine"]:
                sys.exit(f"{asked.record} is of another machine: record all cases")
            here["cases"] = known["cases"] | results
        for name, line in results.items():
            for end in set(line.get("again", [])) - {SAME}:
                print(f"recorded as it is: {name}: {end}")
        asked.record.write_text(written(here))
    elif known is None:
        sys.exit(f"{asked.record} is missing: record it first")
    else:
        elsewhere = known["machine"] != here["machine"]
        if elsewhere:
            print(f"{ELSEWHERE} ({known['machine']}): {COMPARED}")
        for name, line in results.items():
            was = known["cases"].get(name)
            if "files" in line:
                lines = (
                    ["is not in the record"] if was is None else differences(was, line, elsewhere)
                )
                failed += [f"{name}: {text}" for text in lines]
        if len(chosen) == len(list(all_cases())):
            failed += [f"{name}: has no case" for name in known["cases"].keys() - results.keys()]
    print("\n".join(failed) or f"{len(results)} cases: all as expected")
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
