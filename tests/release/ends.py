"""Run every command in a pseudo-terminal, from a wheel with the oldest or the newest dependencies it allows.

    python tests/release/ends.py oldest dist/g2ard-….whl

Inputs are those of `helpers.stand_ins`, with packages of the tests. `oldest` takes the lowest versions
in pyproject.toml and the Python that runs this, `newest` the newest versions and the newest Python on PATH.
Nothing but the wheel's own requirements is installed.
"""

import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT))
sys.path.append(str(ROOT / "tests"))

from helpers.stand_ins import provide  # noqa: E402

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]

COMMANDS = """
simplify scene.ply -r 4 -o tiny.ply
distill scene.ply -r 4 --steps 3 --size 48 -o run
recover tiny.ply --teacher scene.ply --views photos --steps 2 -o recovered.ply
adapt tiny.ply --views photos --steps 2 -o adapted.ply
register small.ply --images new --focal 1200 --poses rough.json --keep uncertain -o poses.json
lift cloud.laz -o lifted.ply
ingest scene.ply -o tiles
convert scene.ply scene.sog
clean scene.ply -o clean.ply
poses scene.ply -k 4 -o pool.json
select scene.ply --views pool.json -k 2 -o chosen.json
render scene.ply -k 2 --size 48 --sheet sheet.png
view scene.ply -o view.html
info scene.ply
evaluate tiny.ply --teacher scene.ply --views photos
compare scene.ply tiny.ply -k 2 --size 48 -o compare.html
lod scene.ply -r 1,4 --merge-only -o levels
"""

TO_COME = tuple(f"python3.{minor}" for minor in range(20, 10, -1))


def lowest() -> list[str]:
    """Return the package's requirements at their lower bounds."""
    return [
        re.sub(r">=([\w.]+).*", r"==\1", requirement) for requirement in PROJECT["dependencies"]
    ]


def newest_python() -> str:
    """Return the newest Python on PATH that runs."""
    for name in TO_COME:
        path = shutil.which(name)
        if (
            path
            and subprocess.run([path, "-c", "import venv"], capture_output=True).returncode == 0
        ):
            return path
    return sys.executable


def in_terminal(words: list[str], folder: Path, variables: dict[str, str]) -> tuple[int, str]:
    """Run a program with its output on a terminal: exit status, and what the terminal receives."""
    if os.name == "nt":
        done = subprocess.run(words, cwd=folder, env=variables, capture_output=True, text=True)
        return done.returncode, done.stdout + done.stderr
    import pty

    ours, theirs = pty.openpty()
    running = subprocess.Popen(words, cwd=folder, env=variables, stdout=theirs, stderr=theirs)
    os.close(theirs)
    received = b""
    while True:
        try:
            piece = os.read(ours, 1 << 16)
        except OSError:  # Linux reports the closed side as an error
            break
        if not piece:
            break
        received += piece
    os.close(ours)
    return running.wait(), received.decode(errors="replace")


def main(end: str, wheel: Path) -> None:
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as temporary:
        venv, work = Path(temporary, "venv"), Path(temporary, "work")
        python = newest_python() if end == "newest" else sys.executable
        subprocess.run([python, "-m", "venv", str(venv)], check=True)
        programs = venv / ("Scripts" if os.name == "nt" else "bin")
        pip = [str(programs / "python"), "-m", "pip", "--disable-pip-version-check"]
        pins = lowest() if end == "oldest" else ["--upgrade"]
        subprocess.run([*pip, "install", "--quiet", str(wheel.resolve()), *pins], check=True)
        listed = subprocess.run([*pip, "list"], check=True, capture_output=True, text=True).stdout
        version = subprocess.run(
            [programs / "python", "-V"], capture_output=True, text=True
        ).stdout.strip()
        print(
            f"{end}: {version}",
            *(" ".join(line.split()) for line in listed.splitlines()[2:]),
            sep=", ",
        )
        variables = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
        variables |= {"TERM": "xterm-256color", "COLUMNS": "80", "LINES": "24"}
        work.mkdir()
        for name in ("scene.ply", "small.ply", "cloud.laz", "photos", "new", "rough.json"):
            provide(name, work, "", Path(temporary, "store"))
        calls = [shlex.split(line) for line in COMMANDS.strip().splitlines()]
        for words in calls:
            status, said = in_terminal([str(programs / "g2ard"), *words], work, variables)
            print("$ g2ard", shlex.join(words), flush=True)
            if status:
                raise SystemExit(f"{end}: status {status}\n{said}")
        ask = "from g2ard.cli.commands import COMMANDS; print(*COMMANDS)"
        known = subprocess.run(
            [str(programs / "python"), "-c", ask], capture_output=True, text=True, env=variables
        )
        if missing := set(known.stdout.split()) - {words[0] for words in calls}:
            raise SystemExit(f"COMMANDS lacks {', '.join(sorted(missing))}")


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
