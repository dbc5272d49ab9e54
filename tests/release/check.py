"""Install built packages as a user would, run README's *Use* section from each, and compare what they write.

    python tests/release/check.py dist/g2ard-….whl dist/g2ard-….tar.gz

Every package gets a clean environment with its plain dependencies. The check fails if a command fails, if the
Python example writes other bytes than the command it stands for, if two packages write different bytes, or if
an installation takes over 150 MB. pip's own variables (PIP_NO_INDEX, PIP_FIND_LINKS) choose its sources.
"""

import hashlib
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

HERE = Path(__file__).resolve().parent
README = HERE.parents[1] / "README.md"
LARGEST = 150e6
"""Bytes that an installation may take, dependencies included."""


def use_section() -> tuple[list[list[str]], str]:
    """Return the commands and the Python example of README's *Use* section."""
    section = README.read_text(encoding="utf-8").split("\n## Use\n")[1].split("\n## ")[0]
    shell, python = (
        re.findall(rf"(?ms)^```{kind}\n(.*?)^```", section)[0] for kind in ("sh", "python")
    )
    commands = [shlex.split(line, comments=True) for line in shell.splitlines()]
    return [words for words in commands if words], python


def environment(folder: Path, package: Path) -> dict[str, str]:
    """Install a package into a new environment; return the variables under which its programs are found."""
    venv.create(folder, with_pip=True)
    own = bytes_in(folder)
    programs = folder / ("Scripts" if os.name == "nt" else "bin")
    python = str(programs / "python")
    subprocess.run([python, "-m", "pip", "install", "--quiet", str(package)], check=True)
    added = bytes_in(folder) - own
    print(f"{package.name}: {added / 1e6:.0f} MB with its dependencies")
    if added > LARGEST:
        raise SystemExit(f"{package.name}: more than {LARGEST / 1e6:.0f} MB")
    if (
        subprocess.run([python, "-c", "import torch"], capture_output=True, check=False).returncode
        == 0
    ):
        raise SystemExit(f"{package.name}: brings torch along")
    variables = {
        name: value
        for name, value in os.environ.items()
        if name not in {"PYTHONPATH", "PYTHONHOME"}
    }
    return {**variables, "PATH": os.pathsep.join([str(programs), os.environ["PATH"]])}


def bytes_in(folder: Path) -> int:
    """Return the size of all files of a folder."""
    return sum(file.lstat().st_size for file in folder.rglob("*") if file.is_file())


def outputs(package: Path, folder: Path) -> dict[str, str]:
    """Run the *Use* section with a package; return the SHA-256 of every scene and file of poses it writes."""
    found = {}
    variables = environment(folder / "venv", package)
    work = folder / "work"
    commands, python = use_section()

    def run(*words: str) -> None:
        print("$", shlex.join(words) if words[0] == "g2ard" else " ".join(words[:2]), flush=True)
        program = shutil.which(words[0], path=variables["PATH"])
        done = subprocess.run(
            [program or words[0], *words[1:]],
            cwd=work,
            env=variables,
            text=True,
            capture_output=True,
            check=False,
        )
        if done.returncode:
            raise SystemExit(
                f"{package.name}: {shlex.join(words)}: status {done.returncode}\n{done.stderr}"
            )

    def hashed(path: Path) -> str:
        return hashlib.sha256(path.read_bytes()).hexdigest()

    work.mkdir()
    run("python", str(HERE / "inputs.py"), str(work))
    for number, words in enumerate(commands):
        shutil.rmtree(work / "run", ignore_errors=True)  # the examples are alternatives
        run(*words)
        written = words[words.index("-o") + 1] if "-o" in words else words[-1]
        files = sorted((work / "run").glob("scene.*")) if written == "run/" else [work / written]
        found |= {f"{number} {file.name}": hashed(file) for file in files}
    (work / "small.ply").unlink()
    run("python", "-c", python)
    found["python"] = hashed(work / "small.ply")
    if found["python"] != found["0 scene.ply"]:
        raise SystemExit(
            f"{package.name}: the Python example's scene is not that of `{shlex.join(commands[0])}`"
        )
    return found


def main(packages: list[Path]) -> None:
    """Check every package, then that all of them write the same bytes."""
    found = {}
    for package in packages:
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
            found[package.name] = outputs(package.resolve(), Path(folder))
    first, *others = found
    for other in others:
        differing = [name for name in found[first] if found[first][name] != found[other][name]]
        if differing:
            raise SystemExit(f"{first} and {other} write different bytes: {', '.join(differing)}")
    for name, digest in found[first].items():
        print(f"{digest[:16]}  {name}")


if __name__ == "__main__":
    main([Path(name) for name in sys.argv[1:]])
