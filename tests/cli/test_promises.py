"""Help texts keep their promises: values, files and placeholders that they name, and defaults."""

import re
import shlex
import shutil
from functools import cache
from inspect import signature
from pathlib import Path

import pytest

import g2ard
from g2ard.cli.app import COMMANDS
from g2ard.cli.commands import render
from g2ard.io import spz
from g2ard.io.detect import file_format
from g2ard.io.scene_formats import FORMATS
from g2ard.jobs import run_views
from g2ard.jobs.budget import DEVICES
from g2ard.pipeline import adapt
from g2ard.poses import pool, within
from g2ard.stages.clean import KINDS
from g2ard.stages.recover.config import SCHEDULES
from g2ard.stages.register import RegisterConfig
from g2ard.tiles.ingest import TILE_ROWS
from helpers.commands import CommandLine, refused, succeeds
from helpers.packed_files import unpacked_ksplat
from helpers.photos import cloud_of
from helpers.scenes import around, checkered_ball, under_a_sky
from helpers.trainer_files import data_of, run_of

REGISTER, ADAPT = RegisterConfig(), g2ard.AdaptConfig()
DEFAULTS: dict[str, str] = {
    "adapt steps": (
        f"by default {adapt._STEPS_PER_IMAGE} per image, at least {adapt._FEWEST_STEPS} and at most "
        f"{adapt._MOST_STEPS:,}"
    ),
    "adapt tolerance": f"{ADAPT.tolerance:g} by default",
    "adapt prior_views": (
        f"{ADAPT.prior_views:g} by default, {g2ard.AdaptConfig(schedule='paper').prior_views:g} in the paper"
    ),
    "register size": f"{REGISTER.size} by default",
    "register matcher": f"{REGISTER.matcher}, the default",
    "register refine": f"{REGISTER.refine} by default",
    "register passes": f"{REGISTER.passes} by default",
    "register accept": f"{REGISTER.accept} by default",
    "convert spz_version": f"{signature(spz.write).parameters['spz_version'].default} by default",
    "poses fov": f"by default {pool._FOV:g}, and {within.WIDE:g} in rooms",
    "render looks": f"by default {run_views._POOL_VIEWS}",
    "render around": f"{render._PANORAMA:,} pixels wide",
    "ingest tile_rows": f"{TILE_ROWS / 1e6:g}M by default",
    **{
        f"{command} tile_rows": f"{TILE_ROWS / 1e6:g}M by default"
        for command in ("distill", "simplify", "lod")
    },
    **{
        f"{command} schedule": (
            "at least {:.0f}, {:.0f} or {:,.0f} steps".format(
                *(
                    SCHEDULES[name].for_renders * SCHEDULES[name].steps
                    for name in ("fast", "default", "best")
                )
            )
        )
        for command in ("distill", "recover")
    },
    **{
        f"{command} engine": f"{g2ard.RecoverConfig().engine} (Rust or --device gpu, the default)"
        for command in ("distill", "recover", "adapt")
    },
    **{
        f"{command} keep_region": f"({g2ard.SimplifyConfig().keep_times:g})"
        for command in ("distill", "simplify")
    },
}
"""Command and option → the defaults that its help names, as the program has them."""

COUNTS, TIMES, LOOK = (
    "250000 250k 1.5M 25%",
    "90s 2m 1h",
    "render ball.ply --views views.json --size 16 -o looks",
)
SOURCES = "COLMAP transforms.json cameras.json run .json"
CALLS: dict[str, tuple[str, str]] = {
    **{
        f"{command} count": (COUNTS, f"{command} ball.ply -n {{}} --dry-run")
        for command in ("distill", "simplify")
    },
    **{
        f"{command} ratio": ("10", f"{command} ball.ply -r {{}} --dry-run")
        for command in ("distill", "simplify")
    },
    **{
        f"{command} fit": (" ".join(["5MB", *DEVICES]), f"{command} ball.ply --fit {{}} --dry-run")
        for command in ("distill", "simplify")
    },
    "distill schedule": (
        "fast default best paper",
        "distill ball.ply -r 8 --schedule {} --dry-run",
    ),
    "distill time": (TIMES, "distill ball.ply -r 8 --time {} --dry-run"),
    "distill recovery_time": (TIMES, "distill ball.ply -r 8 --recovery-time {} --dry-run"),
    "recover recovery_time": (
        TIMES,
        "recover ball.ply --teacher ball.ply --views views.json --recovery-time {} --dry-run",
    ),
    "simplify memory": ("4GB", "simplify ball.ply -r 8 --no-views --memory {} -o out.ply"),
    "simplify keep_region": (
        "X,Y,Z,R X,Y,Z,X,Y,Z",
        "simplify ball.ply -r 8 --views views.json --keep-region {} --set keep_times=9 -o out.ply",
    ),
    "simplify scene": (
        ".ply .compressed.ply .sog .spz .glb .splat .ksplat .usda .usdc",
        "simplify {} -r 2 --no-views -o out.ply",
    ),
    "lift cloud": (".ply .las .laz COLMAP", "lift {} -o out.ply"),
    "render background": ("black white R,G,B", f"{LOOK} --background {{}}"),
    "render split": ("train test all", f"{LOOK} --split {{}}"),
    "render views": (f"{SOURCES} made", "render ball.ply --views {} --size 16 -o looks"),
    "select views": (SOURCES, "select ball.ply --views {} -k 1 -o chosen.json"),
    "render output": (".gif .webp", "render ball.ply --orbit 3 --size 16 -o turn{}"),
    "select k": ("100 25% auto", "select ball.ply --views many.json --split all -k {} -o k.json"),
    "poses format": ("cameras.json transforms.json .json folder", "poses ball.ply -k 2 -o {}"),
    "distill views_format": (
        "inria nerfstudio colmap",
        "distill ball.ply -r 8 --focus far --size 16 --steps 1 --no-page --views-format {} -o run",
    ),
    "convert output": (
        ".ply .compressed.ply .sog .spz .glb .splat .usda .usdc meta.json .csv",
        "convert ball.ply -o {}",
    ),
    "convert where": (
        "'opacity > 0.05 and largest_scale < 2'",
        "convert ball.ply out.ply --where {}",
    ),
    "convert from_axes": ("RDF", "convert ball.ply out.ply --from-axes {}"),
    "convert to_axes": ("y-up z-up RFU", "convert ball.ply out.ply --to-axes {}"),
    "clean only": (" ".join([*KINDS, "none"]), "clean sky.ply --only {} -o out.ply"),
    "clean strength": ("0 1", "clean sky.ply --strength {} -o out.ply"),
    "lod output": (
        "lod-meta.json tileset.json",
        "lod ball.ply -r 2,4 --merge-only --views views.json -o out {}",
    ),
}
"""Command and option → values that its help names, and a call that succeeds with each of them."""

GIVEN = {
    "COLMAP": "given/project",
    "transforms.json": "given/transforms.json",
    "cameras.json": "given/cameras.json",
    "run": "outputs/poster/splatfacto/today",
    ".json": "views.json",
}
WORDS: dict[str, dict[str, str]] = {
    "render background": {"R,G,B": "0.2,0.3,0.4"},
    "simplify keep_region": {"X,Y,Z,R": "0,0,1,0.5", "X,Y,Z,X,Y,Z": "0,0,0,1,1,1"},
    "clean only": {kind: f"{kind} --strength 0.5" for kind in ("haze", "streak")},
    "simplify scene": {
        ".ply": "ball.ply",
        ".ksplat": "level2-sh2.ksplat",
        **{f".{name}": f"a.{name}" for name in FORMATS if name != "ply"},
    },
    "lift cloud": {
        "COLMAP": "given/project",
        **{suffix: f"cloud{suffix}" for suffix in (".ply", ".las", ".laz")},
    },
    **dict.fromkeys(("render views", "select views"), GIVEN),
    "poses format": {".json": "own.json", "folder": "colmap"},
    "convert output": {
        "meta.json": "sog/meta.json",
        **{f".{name}": f"out.{name}" for name in (*FORMATS, "csv")},
    },
    "lod output": {"lod-meta.json": "--format sog", "tileset.json": "--format 3dtiles"},
}
"""Value → its words in a call: files, and options that choose it."""

WRITTEN = {
    "poses format": {
        "cameras.json": "inria",
        "transforms.json": "transforms",
        ".json": "views",
        "folder": "colmap",
    },
    "distill views_format": {
        "inria": "run/cameras.json",
        "nerfstudio": "run/transforms.json",
        "colmap": "run/colmap/sparse/0/cameras.txt",
    },
    "lod output": {"lod-meta.json": "out/lod-meta.json", "tileset.json": "out/tileset.json"},
}
"""Value → the format of the output of its call, or a file."""


@cache
def helps() -> dict[str, str]:
    """Return the help and the metavar of each option and argument by command and name."""
    from typer.main import get_command

    from g2ard.cli.app import register_commands
    from g2ard.cli.command import app

    register_commands()
    commands = get_command(app).commands  # type: ignore[attr-defined]
    return {
        f"{name} {p.name}": f"{getattr(p, 'help', None)} [{p.metavar}]"
        for name in COMMANDS
        for p in commands[name].params
    }


@pytest.mark.parametrize("option", DEFAULTS)
def test_defaults_in_help_are_those_of_the_program(option: str) -> None:
    assert DEFAULTS[option] in helps()[option]


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the files that `CALLS` and `WORDS` name."""
    folder = tmp_path_factory.mktemp("inputs")
    ball, cameras = checkered_ball(300), around(16, (48, 36))
    for name in ("ball.ply", *(f"a.{name}" for name in FORMATS if name != "ply")):
        g2ard.save(folder / name, ball)
    g2ard.save(folder / "sky.ply", under_a_sky(ball))
    for name in ("cloud.ply", "cloud.las", "cloud.laz"):
        cloud_of(folder / name, ball)
    unpacked_ksplat("level2-sh2", folder)
    (folder / "given").mkdir()  # not beside the scene, where commands would find them
    for name in ("views.json", "given/transforms.json", "given/cameras.json", "given/project"):
        g2ard.save_views(folder / name, cameras)
    points = [f"{i} {x} {y} {z} 9 9 9 0.5 1 0 2 0" for i, (x, y, z) in enumerate(ball.means)]
    (folder / "given/project/sparse/0/points3D.txt").write_text("\n".join(points) + "\n")
    g2ard.save_views(folder / "many.json", around(100, (16, 12)))
    data_of(folder)
    run_of(folder)
    return folder


@pytest.mark.parametrize("option", CALLS)
def test_values_that_help_names_are_taken(
    option: str, inputs: Path, tmp_path: Path, command_line: CommandLine
) -> None:
    values, call = CALLS[option]
    for number, value in enumerate(shlex.split(values)):
        assert value in helps()[option]
        folder = shutil.copytree(inputs, tmp_path / str(number))
        word = WORDS.get(option, {}).get(value, shlex.quote(value))
        status, _, error = command_line(*shlex.split(call.format(word)), cwd=folder)
        few = "expected a budget of at most" in error  # a ball of 300 Gaussians has no 250,000
        assert status == 0 or (few and option.endswith(" count")), (value, error)
        made = WRITTEN.get(option, {}).get(value, ".")
        assert (folder / made).exists() or file_format(folder / word) == made, (option, value)


@pytest.mark.parametrize(
    ("command", "option"), [(c, o) for c in ("distill", "simplify") for o in ("count", "ratio")]
)
def test_several_budgets_are_taken_where_help_says_so(
    command: str, option: str, inputs: Path, tmp_path: Path, command_line: CommandLine
) -> None:
    folder = shutil.copytree(inputs, tmp_path / "inputs")
    flag = {"count": "-n", "ratio": "-r"}[option]
    several = re.search(
        r"Several \((.*?)\) need (\{\w+\}) in (--\w+)", helps()[f"{command} {option}"]
    )
    if several is None:
        assert "one budget" in refused(
            command_line, folder, command, "ball.ply", flag, "5,10", "-o", "out"
        )
        return
    values, pattern, output = several.groups()
    small = values.replace("k", "")  # the ball has no 10,000
    call = (command, "ball.ply", "--no-views", flag, small, output)
    succeeds(command_line, folder, *call, f"out_{pattern}.ply")
    for value in small.split(","):
        assert (folder / f"out_{value}.ply").exists()
    assert pattern in refused(command_line, folder, *call, "out.ply")


APART = {
    r"by default (?!\d|128)|default options|estimated by default|all by default": "names no value",
    r"\(default\)": "the background of tests/cli/test_every_option.py",
    r"in \.NAME\.tiles": "tests/cli/test_resume.py",
    r"classification == 2": "tests/jobs/test_chosen_points.py",
    r"\.mp4 \(needs ffmpeg\)": "tests/test_documented_commands.py",
    r"\.(e57|gltf|usdz?|pcd|xyz\w*|pts|asc|neu)\b": "tests/io",
    r"page:10MB|one view as \.png": "tests/cli/test_pages.py and tests/cli/test_pictures.py",
    r"every 8th|fewer than 6|0\.2 and cuts splats at 3σ|4 keeps a quarter": "tests of what it means",
    r"0 uses all cores|0 runs all steps|or -1|1 - STRENGTH|4 is smaller|degree 3, 248 bytes": "the same",
    r"for \.spz of splat-transform|\.spz files|the \.ply in|of a \.glb": "formats that other promises name",
    r"\[0, 1\]|0 to 1|between 0 and 1|\[-1, 1\]|8 bits|4×4|3D(GS)?|1\.1|Drift95|1024": "no value to give",
    r"such as the dense scene|such as( '|(?= RDF| RFU| 4GB))|such as in axes": "no value to give",
    r"\[FILE\.\w+(\|NUMBERS)?\]|5MB\|DEVICE": "a metavar",
}
"""Pattern of what looks like a promise → where it is tested, or why it promises nothing."""

LOOKS_LIKE = re.compile(r"default|such as|\{\w+\}|(?<![\w.])\.[a-z]\w+|\d")


def test_every_promise_is_tried() -> None:
    left, texts = {}, helps()
    for text in dict.fromkeys(texts.values()):
        # commands share them
        options = [option for option, found in texts.items() if found == text]
        rest = re.sub(r"Several \(.*", "", text.replace("g2ard", ""))  # the test above
        for told in filter(None, map(DEFAULTS.get, options)):
            rest = rest.replace(told, "")
        for pattern in APART:
            rest = re.sub(pattern, "", rest, flags=re.IGNORECASE)
        for values, _ in filter(None, map(CALLS.get, options)):
            for value in sorted(shlex.split(values), key=len, reverse=True):
                rest = rest.replace(value, "")
        if LOOKS_LIKE.search(rest):
            left[options[0]] = rest
    assert left == {}


def test_every_reason_is_used() -> None:
    everything = "\n".join(helps().values())
    assert [pattern for pattern in APART if not re.search(pattern, everything, re.IGNORECASE)] == []
