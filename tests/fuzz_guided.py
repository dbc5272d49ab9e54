"""Coverage-guided fuzzing of every reader: libFuzzer, by atheris, looks for files that reach new lines.

    pip install atheris
    python tests/fuzz_guided.py --seconds 60                # of each case
    python tests/fuzz_guided.py --seconds 600 --only laz

Readers are held to the word that `fuzz_readers` holds them to. A file that breaks it is kept, and ends its
case. Of packed files what lies within is mutated: the stream of a gzip, the meta.json of a zip.
"""

import argparse
import gzip
import importlib
import io
import pkgutil
import re
import subprocess
import sys
import tempfile
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path

OUT = Path(tempfile.gettempdir()) / "g2ard-guided"
_DONE = re.compile(r"stat::number_of_executed_units: (\d+)")


def packing(content: bytes) -> tuple[bytes, Callable[[bytes], bytes]]:
    """Return the part of a file that is mutated, and a function that packs it again."""
    if content[:2] == b"\x1f\x8b":
        return gzip.decompress(content), lambda data: gzip.compress(data, 1)
    if content[:4] != b"PK\x03\x04":
        return content, bytes
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}

    def zipped(data: bytes) -> bytes:
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w") as out:
            for name, part in (files | {"meta.json": data}).items():
                out.writestr(name, part)
        return buffer.getvalue()

    return files["meta.json"], zipped


def run_case(what: str, seconds: int, seed: int) -> None:
    """Fuzz one case for `seconds`; libFuzzer then ends the process, with status 0 if nothing is found."""
    import atheris

    with atheris.instrument_imports(include=["g2ard.io", "laspy", "plyfile"]):
        package = importlib.import_module("g2ard.io")
        for module in pkgutil.iter_modules(package.__path__, "g2ard.io."):
            importlib.import_module(module.name)
    from fuzz_readers import answer
    from helpers.reader_cases import MAKERS, READ

    warnings.simplefilter("ignore")
    memory = Path("/dev/shm")
    base = Path(tempfile.mkdtemp(prefix="g2ard-guided-", dir=memory if memory.is_dir() else None))
    folder, corpus = base / "files", base / "corpus"
    folder.mkdir()
    corpus.mkdir()
    path = MAKERS[what](folder)
    asked = folder / READ[what] if what in READ else path
    content, packed = packing(path.read_bytes())
    (corpus / "valid").write_bytes(content)

    def one(data: bytes) -> None:
        path.write_bytes(packed(data))
        found, _ = answer(asked, folder)
        if found not in ("read", "refused"):
            raise RuntimeError(found)

    OUT.mkdir(exist_ok=True)
    flags = [f"-max_total_time={seconds}", f"-seed={seed}", "-max_len=8192", "-timeout=20"]
    limits = [
        "-rss_limit_mb=3000",
        "-print_final_stats=1",
        f"-artifact_prefix={OUT}/{what.replace(' ', '_')}-",
    ]
    atheris.Setup([sys.argv[0], str(corpus), *flags, *limits], one)
    atheris.Fuzz()


def main() -> None:
    """Fuzz each case in its own process; exit with 1 if a reader broke."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=int, default=60, help="of each case")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="cases whose name holds this")
    parser.add_argument("--case", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.case:
        run_case(options.case, options.seconds, options.seed)
        return
    from helpers.reader_cases import MAKERS

    total, broken = 0, 0
    for what in MAKERS:
        if options.only not in what:
            continue
        words = ["--case", what, "--seconds", str(options.seconds), "--seed", str(options.seed)]
        run = subprocess.run(
            [sys.executable, __file__, *words], capture_output=True, text=True, check=False
        )
        count = int(found[1]) if (found := _DONE.search(run.stderr)) else 0
        print(f"{what:28} {count:12,}  {'found something' if run.returncode else ''}", flush=True)
        if run.returncode:
            print(run.stderr[-3000:], f"kept in {OUT}", flush=True)
        total, broken = total + count, broken + (run.returncode != 0)
    print(f"{total:,} files; {broken} cases broken")
    raise SystemExit(broken > 0)


if __name__ == "__main__":
    main()
