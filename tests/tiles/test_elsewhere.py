"""Workers of a cluster that were started in another folder, and relative paths."""

from collections.abc import Iterator
from inspect import signature
from pathlib import Path

import numpy as np
import pytest

from g2ard.cli.app import app, register_commands
from g2ard.cli.budget_options import TILES
from g2ard.io import write_points
from g2ard.io.types import Points
from helpers.commands import CommandLine, succeeds
from helpers.level_files import files_of
from helpers.tiled_scenes import town, town_in

CALLS = {
    "simplify": "simplify town.ply -r 10 -o OUT/small.ply",
    "distill": "distill town.ply -r 10 -o OUT/run --focus far --steps 4 --size 48 --no-page",
    "lod": "lod cloud.ply -r 2,8 -o OUT/levels --merge-only",
}
"""A call of each command with the options of tiles, of a scene or of a cloud, which workers lift."""

NAMED = ("report.json", "report.html", "index.html")
"""Files that hold times, options or the output's name."""


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A cluster whose processes work in a folder of their own."""
    distributed = pytest.importorskip("distributed")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("elsewhere"))
        cluster = distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=None
        )
    yield cluster.scheduler_address
    cluster.close()


WORK = ("--work", "OUT/work")


@pytest.mark.parametrize(("name", "work"), [("simplify", ()), *((name, WORK) for name in CALLS)])
def test_relative_paths_are_the_clients(
    name: str, work: tuple[str, ...], scheduler: str, command_line: CommandLine, tmp_path: Path
) -> None:
    town_in(tmp_path, 1600)
    points = town(1600).means.astype(float)
    write_points(tmp_path / "cloud.ply", Points(points, np.full((1600, 3), 0.5, np.float32)))
    files = []
    for out, where in (("here", ("--workers", "1")), ("there", ("--scheduler", scheduler))):
        call = (*CALLS[name].split(), *work, "--views", "views.json", "--tile-rows", "700")
        succeeds(command_line, tmp_path, *(word.replace("OUT", out) for word in call), *where)
        made = files_of(tmp_path / out)
        files.append(
            {path: digest for path, digest in made.items() if Path(path).name not in NAMED}
        )
    scenes, others = (
        {path: digest for path, digest in made.items() if "work" not in path} for made in files
    )
    assert scenes == others


def test_every_command_with_tiles_is_called() -> None:
    register_commands()
    found = set()
    for command in app.registered_commands:
        options = signature(command.callback).parameters
        if set(TILES) <= set(options):
            found.add(command.name)
    assert found == set(CALLS)
