"""Commands killed at any moment: the same command again ends as if nothing had happened."""

import json
import os
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import g2ard
from g2ard.io import write_views
from helpers.cloud_files import columns, ply
from helpers.killed import command, forked, killed
from helpers.scenes import around, checkered_ball

pytestmark = pytest.mark.skipif(
    not hasattr(os, "fork"), reason="needs os.fork, to kill a process at a chosen moment"
)

_TAUGHT = "--views views.json --teacher ball.ply --steps 6"
_COMMANDS = {
    "recover": f"recover small.ply {_TAUGHT} -o out.ply --resume",
    "recover-folder": f"recover small.ply {_TAUGHT} -o out/meta.json --resume",
    "adapt": f"adapt small.ply {_TAUGHT} -o out.ply --resume",
    "distill": "distill ball.ply -n 60 --views views.json --steps 6 --size 32 -o run --resume",
    "distill-tiles": "distill ball.ply -n 60 --views views.json --steps 6 --size 32 --focus far --no-page "
    "--tile-rows 80 --workers 1 -o run --resume",
    "lod": "lod ball.ply -r 1,4 --views views.json --steps 4 --size 32 -o out --resume",
    "lod-merged": "lod ball.ply -r 1,4 --views views.json --merge-only --format 3dtiles -o out --resume",
    "ingest": "ingest ball.ply small.ply -o tiles --tile-rows 80",
    "ingest-cloud": "ingest cloud.ply -o tiles --tile-rows 80",
}
_COUNTED = ("replace", "link", "rename", "unlink", "rmdir")
_MOMENTS = 3
_TIMES = re.compile(r"seconds|time|rss|resumed|peak|^share$|^bytes$")


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    ball = checkered_ball(200)
    g2ard.save(folder / "ball.ply", ball)
    g2ard.save(folder / "small.ply", checkered_ball(60, seed=7))
    ply(folder / "cloud.ply", columns("f4", "u1"), np.hstack([ball.means, np.full((len(ball), 3), 90)]))
    write_views(folder / "views.json", around(8, (32, 24)))
    return folder


def fresh(inputs: Path, folder: Path) -> Path:
    folder.mkdir()
    for path in inputs.iterdir():
        os.link(path, folder / path.name)
    return folder


def untimed(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: untimed(item) for key, item in value.items() if not _TIMES.search(key)}
    return [untimed(item) for item in value] if isinstance(value, list) else value


def left(folder: Path) -> dict[str, Any]:
    """Return the files of a folder: their content without durations; of pages and pictures only the names."""
    found: dict[str, Any] = {}
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        content: Any = path.read_bytes() if path.suffix not in (".html", ".png", ".finished") else None
        if path.suffix == ".json":
            content = untimed(json.loads(content))
        found[path.relative_to(folder).as_posix()] = content
    return found


@pytest.mark.parametrize("name", _COMMANDS)
def test_the_same_command_again_ends_and_cleans_up(name: str, inputs: Path, tmp_path: Path) -> None:
    """The kills come alternately before and after a file is put in place."""
    words, logs = _COMMANDS[name].split(), tmp_path / "logs"
    logs.mkdir()

    def run(label: str, folder: Path, after: int = 0) -> tuple[int, str]:
        work = killed(command(words), after, logs / "count", functions=_COUNTED, before=after % 2 == 0)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # forking with threads
            status = forked(work, logs / f"{label}.out", logs / f"{label}.err", folder)
        return status, (logs / f"{label}.err").read_text()

    status, error = run("whole", fresh(inputs, tmp_path / "whole"))
    assert status == 0, error
    whole, count = left(tmp_path / "whole"), int((logs / "count").read_text())
    hidden = [file for file in whole if re.search(r"(^|/)\.(?!out(\.ply)?\.finished$)", file)]
    assert not hidden
    assert count > 2
    for after in sorted({1 + round(i * (count - 1) / (_MOMENTS - 1)) for i in range(_MOMENTS)} | {count - 1}):
        folder = fresh(inputs, tmp_path / str(after))
        assert run(f"killed{after}", folder, after)[0] == -9
        status, error = run(f"again{after}", folder)
        assert status == 0, f"killed at {after} of {count}: {error}"
        again = left(folder)
        assert again.keys() == whole.keys(), f"killed at {after} of {count}"
        assert [file for file in whole if again[file] != whole[file]] == [], f"killed at {after} of {count}"
