"""Mutates small valid files and holds every reader to its word: data that make sense, or one InputError line.

    python tests/fuzz_readers.py --runs 2000 --seed 1
    python tests/fuzz_readers.py --seconds 60 --seed 2     # as many as come in a minute, of each case

Files lie in memory where the system has a folder for that.

A mutation changes, cuts or doubles stretches of bytes, writes extreme integers and floats over them, or
changes numbers and words in text. Packed files are unpacked, mutated and packed again, so that the decoders
behind zlib and zip see damage too. The first file of each kind that a reader answers otherwise is kept.
Before, each case meets all files that break one rule (`helpers/malformations.py`).
"""

import argparse
import gzip
import io
import re
import shutil
import struct
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))

from g2ard.errors import InputError
from g2ard.io import kind, read_cloud, read_view_set
from g2ard.scene.cameras import LARGEST_IMAGE
from helpers.malformations import malformed
from helpers.opened import read_scene
from helpers.reader_cases import MAKERS, READ

EXTREMES = [
    struct.pack(form, value)
    for form, values in {
        "<B": (0, 127, 128, 255),
        "<H": (0, 0x7FFF, 0xFFFF),
        "<I": (0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF),
        "<Q": (0, 1 << 31, 1 << 40, (1 << 63) - 1, 1 << 63, (1 << 64) - 1),
        "<f": (0.0, -0.0, np.inf, -np.inf, np.nan, 3e38, 1e-45),
        "<d": (np.inf, np.nan, 1e308, -1e308, 5e-324),
    }.items()
    for value in values
]
WORDS = [
    *(
        b"0",
        b"-1",
        b"1e308",
        b"1e999",
        b"NaN",
        b"-Infinity",
        b"4000000000",
        b"99999999999999999999",
    ),
    *(b"null", b"true", b"[]", b"{}", b'""', b'"x"', b"[[]]", b'"\\u0000"', b"1" + b"0" * 400),
]
NUMBER = re.compile(rb"-?\d+(\.\d+)?([eE][-+]?\d+)?|\"[^\"]*\"|\bnull\b")


def mutated(content: bytes, rng: np.random.Generator) -> bytes:
    """One to three changes; the front half, where headers are, more often."""
    data = bytearray(content)
    for _ in range(rng.integers(1, 4)):
        at = int(len(data) * rng.random() ** 2)
        length = int(rng.integers(1, 40))
        match rng.integers(6):
            case 0:
                data[at : at + 1] = bytes([rng.integers(256)])
            case 1:
                del data[at : at + length]
            case 2:
                data[at:at] = data[at : at + length]
            case 3:
                value = EXTREMES[rng.integers(len(EXTREMES))]
                data[at : at + len(value)] = value
            case 4:
                places = list(NUMBER.finditer(data, at, at + 4096))
                if places:
                    place = places[rng.integers(len(places))]
                    data[place.start() : place.end()] = WORDS[rng.integers(len(WORDS))]
            case _:
                if rng.random() < 0.3:
                    del data[at:]
    return bytes(data)


def repacked(content: bytes, rng: np.random.Generator) -> bytes:
    """Mutate a file, usually inside its packing if it has one."""
    if rng.random() < 0.3:
        return mutated(content, rng)
    if content[:2] == b"\x1f\x8b":
        return gzip.compress(mutated(gzip.decompress(content), rng), 1)
    if content[:4] == b"PK\x03\x04":
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            files = {name: archive.read(name) for name in archive.namelist()}
        chosen = "meta.json" if rng.random() < 0.5 else sorted(files)[rng.integers(len(files))]
        files[chosen] = mutated(files[chosen], rng)
        buffer = io.BytesIO()
        with zipfile.ZipFile(
            buffer, "w", (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)[rng.integers(2)]
        ) as out:
            for name, part in files.items():
                out.writestr(name, part)
        return buffer.getvalue()
    return mutated(content, rng)


def read_checked(path: Path) -> str | None:
    """Read a file and check the data; return the error line if it is rejected."""
    try:
        match kind(path):
            case "splats":
                scene = read_scene(path).splats
                assert len(scene)
                assert scene.finite_rows().all()
                assert (scene.scales > 0).all()
                assert scene.quats.any(1).all()
            case "points":
                points = read_cloud(path).points
                assert len(points)
                assert np.isfinite(points.positions).all()
                assert ((points.colors >= 0) & (points.colors <= 1)).all()
            case "views":
                cameras = read_view_set(path).cameras
                assert len(cameras)
                assert np.isfinite(cameras.viewmats).all()
                assert np.isfinite(cameras.Ks).all()
                assert (cameras.widths * cameras.heights <= LARGEST_IMAGE).all()
    except InputError as error:
        return str(error)
    return None


def answer(path: Path, folder: Path) -> tuple[str, str]:
    """Return `read`, `refused` if one line names a file of `folder`, or what a reader did instead; and the
    line."""
    try:
        line = read_checked(path)
    except Exception as error:
        at = traceback.extract_tb(error.__traceback__)[-1]
        return (
            f"{type(error).__name__} in {Path(at.filename).name}:{at.lineno}: {str(error)[:120]}",
            "",
        )
    if line is None:
        return "read", ""
    one_line = "\n" not in line and str(folder) in line
    return "refused" if one_line else f"not one line that names the file: {line!r}", line


NAMED = ["transforms", "cameras.json", "views", "ns-export", "meta.json", "lod-meta.json"]
"""Files of JSON: if a property becomes the word x, the error names the property, its holder or x."""


def break_rules(
    what: str, make: Callable[[Path], Path], folder: Path, every: int = 1
) -> Counter[str]:
    """Read every n-th malformed version of one case: how many were read or refused, and what else came."""
    path = make(folder)
    content = path.read_bytes()
    asked = folder / READ[what] if what in READ else path
    files = {data: how for how, data in malformed(content) if data != content}
    tally: Counter[str] = Counter()
    for data, how in list(files.items())[::every]:
        path.write_bytes(data)
        found, line = answer(asked, folder)
        name, is_word, _ = how.partition(" is 'x'")
        if found == "refused" and is_word and what in NAMED and not _names(line, name, folder):
            found = f"does not name {name}: {line}"
        tally[found if found in ("read", "refused") else f"{how}: {found}"] += 1
    return tally


def _names(line: str, name: str, folder: Path) -> bool:
    """Return whether an error names one of the keys of a property, or its value x."""
    keys = [key.removesuffix("s") for key in name.split(".") if not key.isdigit()]
    told = line.replace(str(folder), "")
    return not keys or any(key in told for key in keys) or re.search(r"\bx\b", told) is not None


def fuzz(
    what: str,
    make: Callable[[Path], Path],
    folder: Path,
    runs: int,
    seed: int,
    seconds: float = float("inf"),
) -> Counter[str]:
    """Mutate one case `runs` times, or for so long: how many files were read or refused, and what else came.

    What was answered otherwise than with data or one line is a key of its own; its first file is kept.
    """
    path = make(folder)
    content = path.read_bytes()
    asked = folder / READ[what] if what in READ else path
    rng = np.random.default_rng([seed, *what.encode()])
    tally: Counter[str] = Counter()
    end = time.monotonic() + seconds
    for _ in range(runs):
        if time.monotonic() > end:
            break
        data = repacked(content, rng)
        path.write_bytes(data)
        found, _ = answer(asked, folder)
        if found not in ("read", "refused", *tally):
            kept = folder / f"broken_{len(tally)}_{path.name}"
            kept.write_bytes(data)
        tally[found] += 1
    return tally


def main() -> None:
    """Fuzz every case of the corpus; exit 1 where a reader broke."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, help="mutations of each case (2000)")
    parser.add_argument("--seconds", type=float, help="stop with each case after so long")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="cases whose name holds this")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    runs = options.runs or (2000 if options.seconds is None else sys.maxsize)
    memory = Path("/dev/shm")
    total, broken = 0, 0
    for what, make in MAKERS.items():
        if options.only not in what:
            continue
        folder = Path(
            tempfile.mkdtemp(prefix="g2ard-fuzz-", dir=memory if memory.is_dir() else None)
        )
        start = time.process_time()
        tally = break_rules(what, make, folder)
        tally += fuzz(what, make, folder, runs, options.seed, options.seconds or float("inf"))
        rate = tally.total() / (time.process_time() - start)
        read, refused = tally.pop("read", 0), tally.pop("refused", 0)
        print(
            f"{what:28} read {read:9,}  refused {refused:9,}  {rate:6,.0f} a CPU second", flush=True
        )
        if not tally:
            shutil.rmtree(folder)
        for found, times in tally.items():
            print(f"    {times} × {found}  (kept in {folder})", flush=True)
        total, broken = total + read + refused + tally.total(), broken + tally.total()
    print(f"{total:,} files; {broken} answered with anything but data or one line")
    raise SystemExit(broken > 0)


if __name__ == "__main__":
    main()
