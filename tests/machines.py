"""Traits of machines, and the tests that depend on them: each test passes with and without.

    python tests/machines.py list             # each trait, and whether this machine has it
    python tests/machines.py without [NAME…]  # the tests that depend on these, without any of them
    python tests/machines.py each [NAME…]     # the tests that depend on each, on another machine in turn

`make test` runs everything on the machine as it is; `.ci/run` also runs `without` and `each`. A trait that
hides nothing here, such as another user's if this one is not root, is skipped with a line.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib.util import find_spec
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
EXTRAS = ("backports.zstd", "distributed", "pxr", "pycolmap", "pye57", "pyproj")
"""Modules of the optional dependencies, except torch, which the tests import."""

_PROCESSES = 2
"""Processes that run tests, as in `make test`."""

NOWHERE = "/nonexistent"
_NOT_ROOT = ("unshare", "--user", "--map-user=1000", "--map-group=1000")
"""A command without root's rights, that still reads root's files."""

_HIDING = """
import importlib.machinery

_find = importlib.machinery.PathFinder.find_spec

def _hidden(finder, name, path=None, target=None):
    return None if name in {names!r} else _find(name, path, target)

importlib.machinery.PathFinder.find_spec = classmethod(_hidden)
"""


@dataclass(frozen=True)
class Trait:
    """Something that a machine has or has not, or of which each has its own kind.

    Args:
        there: whether this machine has it, so that its tests can run without it.
        files: what a file of tests contains if it depends on the trait, a regular expression.
        tests: further files, or commands that begin with `tests/goldens.py`.
        hide: names of programs that PATH then lacks.
        modules: modules that cannot be imported then.
        variables: of the environment of the other machine; None unsets one.
        umask: that of the other machine.
        prefix: words before a command.
    """

    there: Callable[[], bool]
    files: str = ""
    tests: Sequence[str] = ()
    hide: Sequence[str] = ()
    modules: Sequence[str] = ()
    variables: dict[str, str] = field(default_factory=dict)
    umask: int = -1
    prefix: Sequence[str] = ()


def _has(*programs: str) -> bool:
    return any(map(shutil.which, programs))


def _always() -> bool:
    return True


def _is_root() -> bool:
    if not _has("unshare") or os.geteuid() != 0:
        return False
    return subprocess.run([*_NOT_ROOT, "true"], stderr=subprocess.DEVNULL).returncode == 0


_WITHOUT_DRIVERS = {"VK_DRIVER_FILES": NOWHERE, "VK_ICD_FILENAMES": NOWHERE}
_WITHOUT_BROWSER = {"G2ARD_CHROMIUM": NOWHERE, "PLAYWRIGHT_BROWSERS_PATH": NOWHERE}
_OLD_PROCESSOR = {
    "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL",
    "OPENBLAS_CORETYPE": "Haswell",
    "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA",
    "RAYON_NUM_THREADS": "1",
}
"""Older code of numpy, OpenBLAS and the C library, and one thread; kernels without vector instructions are
chosen by `--isa`."""

_FILES = ("tests/io/test_atomic.py", "tests/io/test_paths.py")

TRAITS: dict[str, Trait] = {
    "ffmpeg": Trait(
        partial(_has, "ffmpeg"),
        tests=(
            "tests/cli/test_pictures.py",
            "tests/test_documented_commands.py::test_the_commands_of_a_page_run[docs/how-to/web-delivery.md]",
        ),
        hide=("ffmpeg",),
    ),
    "adapter": Trait(_always, files=r"adapters\(\)", variables=_WITHOUT_DRIVERS),
    "browser": Trait(
        _always, files="from helpers.browser import", hide=BROWSERS, variables=_WITHOUT_BROWSER
    ),
    "node": Trait(
        partial(_has, "node"),
        files="from helpers.peers import",
        hide=("node", "npm", "splat-transform"),
        variables={"G2ARD_NODE_MODULES": NOWHERE},
    ),
    "docker": Trait(partial(_has, "docker"), tests=("tests/test_packaging.py",), hide=("docker",)),
    "data": Trait(_always, tests=("tests/test_printed.py",), variables={"G2ARD_DATA": NOWHERE}),
    "extras": Trait(
        lambda: any(find_spec(name.partition(".")[0]) for name in EXTRAS),
        tests=(
            "tests/system/test_extras.py",
            "tests/io/test_usd.py",
            "tests/io/test_colmap.py",
            "tests/io/test_lenses.py",
            "tests/io/test_stream.py",
            "tests/levels/test_tileset.py",
            "tests/stages/test_register_features.py",
        ),
        modules=EXTRAS,
    ),
    "fonts": Trait(
        _always,
        tests=("tests/cli/test_pictures.py",),
        variables={
            "FONTCONFIG_FILE": NOWHERE,
            "FONTCONFIG_PATH": NOWHERE,
            "XDG_DATA_DIRS": NOWHERE,
        },
    ),
    "processor": Trait(
        _always,
        tests=("tests/goldens.py compare --slice --isa portable",),
        variables=_OLD_PROCESSOR,
    ),
    "locale": Trait(
        _always,
        tests=(
            "tests/cli/test_character_sets.py",
            "tests/io/test_tables.py",
            "tests/io/test_clouds.py",
        ),
        variables={"LC_ALL": "C", "LANG": "C"},
    ),
    "time zone": Trait(
        _always, tests=("tests/cli/test_info.py",), variables={"TZ": "Pacific/Kiritimati"}
    ),
    "umask": Trait(partial(hasattr, os, "fork"), tests=_FILES, umask=0o077),
    "root": Trait(_is_root, tests=(*_FILES, "tests/cli/test_outputs.py"), prefix=_NOT_ROOT),
}
"""Name → trait. `tests/test_machines.py` looks for others in the sources."""

FRESH = ("ffmpeg", "adapter", "browser", "node", "docker", "data")
"""Traits that no fresh machine has."""


def slice_of(trait: Trait) -> list[str]:
    """Return the tests that depend on a trait: files and commands."""
    files = sorted((ROOT / "tests").rglob("test_*.py")) if trait.files else []
    found = [
        str(path.relative_to(ROOT))
        for path in files
        if re.search(trait.files, path.read_text(encoding="utf-8"))
    ]
    return list(dict.fromkeys([*trait.tests, *found]))


def other_machine(traits: Sequence[Trait], folder: Path) -> dict[str, str]:
    """Return the environment of a machine without some traits; `folder` holds its PATH and hidden modules."""
    found = dict(os.environ)
    for trait in traits:
        found |= trait.variables
    if hidden := {name for trait in traits for name in trait.hide}:
        (folder / "bin").mkdir()
        for place in reversed(os.get_exec_path()):
            for program in Path(place).glob("*"):
                if program.name not in hidden:
                    link = folder / "bin" / program.name
                    link.unlink(missing_ok=True)
                    link.symlink_to(program)
        found["PATH"] = str(folder / "bin")
    if modules := {name for trait in traits for name in trait.modules}:
        (folder / "site").mkdir()
        (folder / "site" / "sitecustomize.py").write_text(
            _HIDING.format(names=modules), encoding="utf-8"
        )
        found["PYTHONPATH"] = os.pathsep.join(
            filter(None, [str(folder / "site"), found.get("PYTHONPATH")])
        )
    return found


def run(traits: Sequence[Trait]) -> int:
    """Run the tests that depend on some traits on a machine without any of them; return the exit status."""
    prefix = [word for trait in traits for word in trait.prefix]
    umask = max(trait.umask for trait in traits)
    wanted = list(dict.fromkeys(test for trait in traits for test in slice_of(trait)))
    commands = [
        [*word.split(), "--jobs", "1"] for word in wanted if word.startswith("tests/goldens.py")
    ]
    tests = [word for word in wanted if not word.startswith("tests/goldens.py")]
    if tests:
        files = {test.partition("::")[0] for test in tests}
        # a file stays in one, with its fixtures
        processes = str(_PROCESSES if len(files) > 1 else 0)
        options = [
            "-p",
            "no:cacheprovider",
            "--no-header",
            "--numprocesses",
            processes,
            "--dist",
            "loadfile",
        ]
        commands.append(["-m", "pytest", *options, *tests])
    with tempfile.TemporaryDirectory(prefix="machine") as folder:
        environment = other_machine(traits, Path(folder))
        return max(
            subprocess.run(
                [*prefix, sys.executable, *words], cwd=ROOT, env=environment, umask=umask
            ).returncode
            for words in commands
        )


def main(words: Sequence[str]) -> int:
    action, *names = words or ["list"]
    if action == "list":
        for name, trait in TRAITS.items():
            print(
                f"{name:10} {'here' if trait.there() else 'not here':9} {' '.join(slice_of(trait))}"
            )
        return 0
    if action == "without":
        return run([TRAITS[name] for name in names or FRESH])
    failed = 0
    for name in names or [name for name in TRAITS if name not in FRESH]:
        if not TRAITS[name].there():
            print(f"skipped: the tests that depend on {name} run once, this machine is without")
            continue
        print(f"tests that depend on {name}, on another machine:", flush=True)
        failed = max(failed, run([TRAITS[name]]))
    return failed


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
