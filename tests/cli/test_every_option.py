"""No option is silently ignored: it changes what a command writes, or is refused with a reason."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import g2ard
from helpers.commands import CommandLine
from helpers.photos import cloud_of, photographed
from helpers.scenes import around, checkered_ball, under_a_sky

NO_RESULT = {
    **dict.fromkeys(("quiet", "verbose", "json"), "say more or less"),
    **dict.fromkeys(("overwrite", "resume", "work", "dry_run", "print_config"), "say whether to compute"),
    **dict.fromkeys(("threads", "device", "workers", "scheduler", "memory"), "say where to compute"),
    **dict.fromkeys(("config", "set"), "hold other options, see test_used_settings.py"),
    "seed": "common to all commands, and some draw nothing",
    "engine": "other engines give equal results up to rounding",
    "recovery_time": "depends on the machine",
    "time": "depends on the machine",
    "lpips": "needs weights",
    "lpips_input": "needs weights",
}
"""Options that are not for the result."""

OWN = {
    "poses": ("render_model",),
    "select": ("render_model",),
    "register": ("pool", "matcher"),
    "evaluate": ("photos",),
}
"""Options that need not change a result: poses depend on geometry alone; a pool is for photos without a pose,
and a matcher that finds no features gives way to direct alignment; evaluate uses the photos in any case.
"""

TRAIN = "--views photos.json --size 24 --steps 3"
BASES = {
    "distill": f"distill ball.ply -r 8 {TRAIN} --renders --no-page -o out",
    "simplify": "simplify ball.ply -r 8 --views photos.json -o out.ply",
    "recover": f"recover small.ply {TRAIN} --teacher ball.ply -o out.ply",
    "adapt": f"adapt small.ply {TRAIN} --teacher ball.ply -o out.ply",
    "lift": "lift cloud.ply -o out.ply",
    "convert": "convert ball.ply out.ply",
    "clean": "clean stray.ply -o out.ply",
    "poses": "poses ball.ply -k 8 -o out.json",
    "select": "select ball.ply --views photos.json -k 4 -o out.json",
    "render": "render ball.ply --views photos.json --size 24 -o out",
    "view": "view ball.ply -o out.html",
    "lod": "lod sky.ply -r 2,4 --views photos.json --size 24 --merge-only -o out",
    "evaluate": "evaluate small.ply --views photos.json --size 24 --json out.json",
    "compare": "compare ball.ply small.ply --views photos.json --size 24 --json out.json",
    "ingest": "ingest ball.ply -o out",
    "register": (
        "register ball.ply --images two.json --poses moved.json --matcher direct --keep all -o out.json"
    ),
    "info": "info ball.ply --json -",
}
COMMON = {
    "views": "--views few.json",
    "images": "--images nowhere",
    "size": "--size 20",
    "background": "--background 1,1,1",
    "up": "--up 1,0,0",
    "render_model": "--render-model antialiased",
    "count": "-n 40",
    "ratio": "-r 9",
    "fit": "--fit 9kB",
    "min_psnr": "--min-psnr 20",
    "min_ssim": "--min-ssim 0.6",
    "method": "--method fast",
    "keep_region": "--keep-region 0,0,1,0.5",
    "schedule": "--schedule paper",
    "steps": "--steps 4",
    "tile_rows": "--tile-rows 100",
    "sh_degree": "--sh-degree 0",
    "split": "--split test",
    "preset": "--preset paper",
    "looks": "-k 9",
    "format": "--format inria",
    "teacher": "--teacher sky.ply",
    "alpha": "--alpha mask",
    "photos": "--photos",
    "convention": "--convention inria",
}
"""Words that are tried of options that several commands have."""


def _common(names: str) -> dict[str, str]:
    return {name: COMMON[name] for name in names.split()}


OPTIONS: dict[str, dict[str, str]] = {
    "distill": {
        **_common("count ratio fit min_psnr min_ssim views alpha photos method keep_region schedule"),
        **_common("steps sh_degree size background up tile_rows render_model"),
        "images": "--images other --photos",
        "held_out": "--held-out few.json",
        "preset": "--preset lift",
        "keep": "--keep",
        "format": "--format splat",
        "views_format": "--views-format inria",
        "clean": "--clean",
        "page": "--page",
        "focus": "--focus far",
    },
    "simplify": {
        **_common("count ratio fit min_psnr min_ssim views images preset method keep_region up"),
        **_common("tile_rows render_model"),
        "no_views": "--no-views",
        "parents": "--parents rows.npy",
    },
    "recover": {
        **_common("views teacher photos schedule steps sh_degree split size background render_model"),
        "images": "--images other --photos",
        "alpha": "--alpha mask --photos",
        "anchors": "--anchors fewer.ply --set period=1",
        "preset": "--preset lift --steps 200",
        "weighted": "--no-weights",
    },
    "adapt": {
        **_common("views photos alpha teacher steps schedule sh_degree split size background preset"),
        **_common("render_model"),
        "images": "--images other",
        "tolerance": "--tolerance 0 --steps 600",
        "prior_views": "--prior-views 9",
    },
    "lift": {
        "neighbors": "--neighbors 5",
        "spread": "--spread 2",
        "normal_ratio": "--normal-ratio 0.3",
        "max_anisotropy": "--max-anisotropy 1.1",
        "opacity": "--opacity 0.9",
    },
    "convert": {
        **_common("sh_degree render_model"),
        "box": "--box -1,-1,0,1,1,1",
        "sphere": "--sphere 0,0,1,0.5",
        "where": "--where z<0",
        "invert": "--where z<0 --invert",
        "layout": "--layout inria",
        "from_axes": "--from-axes RUB",
        "transform": "--transform move.txt",
        "scale": "--scale 2",
        "rotate": "--rotate 0,0,90",
        "translate": "--translate 1,0,0",
        "recentre": "--recentre --translate 5,0,0",
        "to_axes": "--to-axes RUB",
        "spz_version": "--spz-version 3",
        "compress": "--compress",
    },
    "clean": {
        **_common("render_model"),
        "only": "--only none",
        "split_sky": "--split-sky sky_alone.ply",
        "strength": "--strength 0.9",
        "preview": "--preview found.png",
    },
    "poses": {
        **_common("format looks up"),
        "kind": "--kind aerial",
        "size": "--size 64x48",
        "fov": "--fov 30",
    },
    "select": {
        **_common("format views images preset"),
        "k": "-k 5",
        "policy": "--policy coverage",
        "split": "--split all",
    },
    "render": {
        **_common("views images looks convention split size background up render_model"),
        "turn": "--orbit 8 -o out.webp",
        "fps": "--fps 9",
        "sheet": "--sheet look.png",
        "depth": "--depth",
        "around": "--panorama",
    },
    "view": {
        **_common("views images background up render_model"),
        "start": "--start 3,0,0",
    },
    "lod": {
        **_common("views images steps size background up tile_rows render_model"),
        "ratios": "-r 2,5",
        "recover": "--recover --steps 30",
        "environment": "--environment --ratios 2,4",
        "most": "--chunk-count 1",
        "extent": "--chunk-extent 0.5 --chunk-min 1",
        "least": "--chunk-min 1 --chunk-extent 0.5",
        "kind": "--format 3dtiles",
        "place": "--georeference 25,59,30",
    },
    "evaluate": {
        **_common("views alpha convention size background render_model"),
        "images": "--images other",
        "teacher": "--teacher ball.ply",
        "anchors": "--anchors fewer.ply",
        "output": "-o page.html ball.ply --teacher ball.ply",
        "eight_bit": "--8bit",
        "split": "--split all",
    },
    "compare": {
        **_common("views images size background render_model"),
        "output": "-o page.html",
        "looks": "-k 5",
    },
    "ingest": {
        **_common("tile_rows render_model"),
    },
    "register": {
        **_common("format split alpha background render_model"),
        "photos": "--photos photos.json",
        "poses": "--poses photos.json",
        "intrinsics": "--intrinsics few.json",
        "focal": "--focal 50",
        "size": "--size 40",
        "refine": "--refine none",
        "passes": "--passes 1",
        "accept": "--accept 0.99 --keep registered",
        "keep": "--keep registered --accept 0.99",
        "protocol": "--protocol gs-cpr",
        "truth": "--truth few.json --json told.json",
        "metres_per_unit": "--metres-per-unit 2",
        "report": "--report page.html",
    },
    "info": {
        "images": "--images other",
        "devices": "--devices",
    },
}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photos are half transparent, and those in `other` are of another scene."""
    folder = tmp_path_factory.mktemp("inputs")
    ball, views = checkered_ball(300), around(16, (48, 36))
    small = g2ard.simplify(ball, count=40, blind=True).splats
    g2ard.save(folder / "ball.ply", ball)
    g2ard.save(folder / "small.ply", small)
    g2ard.save(folder / "fewer.ply", replace(small, means=small.means * np.float32(1.02)))
    g2ard.save(folder / "sky.ply", under_a_sky(ball))
    faint = replace(ball, logit_opacities=np.where(np.arange(300) < 20, -9, 3).astype(np.float32))
    g2ard.save(folder / "stray.ply", under_a_sky(faint))
    cloud_of(folder / "cloud.ply", ball)
    for name, scene in (("photos", ball), ("other", checkered_ball(300, seed=1))):
        (folder / name).mkdir()
        pictured = photographed(folder / name, scene, views)
        for path in (folder / name).glob("*.png"):
            with Image.open(path) as photo:
                photo.putalpha(Image.linear_gradient("L").resize(photo.size))
                photo.save(path)
        if name == "photos":
            g2ard.save_views(folder / "photos.json", pictured, weights=np.arange(1.0, 17.0))
            g2ard.save_views(folder / "two.json", pictured.take([0, 1]), splits=["train", "test"])
            moved = pictured.viewmats.copy()
            moved[:, :3, 3] += 0.1
            g2ard.save_views(folder / "moved.json", replace(pictured, viewmats=moved))
    g2ard.save_views(folder / "few.json", around(10, (48, 36), 2.5))
    np.savetxt(folder / "move.txt", np.diag([2.0, 2.0, 2.0, 1.0]))
    return folder


def _written(folder: Path, before: set[Path], told: str) -> dict[str, Any]:
    """Return what a command wrote, without times, and what it says on stdout."""
    files: dict[str, Any] = {"stdout": told}
    for path in sorted({path for path in folder.rglob("*") if path.is_file()} - before):
        name = str(path.relative_to(folder))
        if path.name == "report.html":
            files[name] = "written"
        elif path.suffix == ".json":
            files[name] = _timeless(json.loads(path.read_text()))
        else:
            files[name] = path.read_bytes()
    return files


def _timeless(content: Any) -> Any:
    """Return a report without its times and options."""
    if isinstance(content, dict):
        gone = ("seconds", "config", "peak_rss_bytes", "steps_per_second", "output")
        return {key: _timeless(value) for key, value in content.items() if key not in gone}
    return [_timeless(value) for value in content] if isinstance(content, list) else content


def _base(command: str, preset: str) -> str:
    words = BASES[command] + preset
    blind = command == "simplify" and preset  # the paper's method has no views
    return words.replace(" --views photos.json", "") if blind else words


class Runner:
    """Runs commands on the inputs, each in a folder of its own."""

    def __init__(self, inputs: Path, store: Path, command_line: CommandLine) -> None:
        self.inputs, self.store, self.command_line = inputs, store, command_line
        self.usual: dict[str, dict[str, Any]] = {}
        self.count = 0

    def run(self, words: str) -> tuple[str, dict[str, Any]]:
        self.count += 1
        folder = self.store / str(self.count)
        shutil.copytree(self.inputs, folder)
        before = {path for path in folder.rglob("*") if path.is_file()}
        status, out, error = self.command_line(*words.split(), cwd=folder)
        written = _written(folder, before, re.sub(r"\d+\.\d+ s", "", out))
        shutil.rmtree(folder)
        return error if status else "", written

    def base(self, command: str, preset: str) -> dict[str, Any]:
        words = _base(command, preset)
        if words not in self.usual:
            error, self.usual[words] = self.run(words)
            assert not error
        return self.usual[words]


@pytest.fixture(scope="module")
def runner(inputs: Path, tmp_path_factory: pytest.TempPathFactory, command_line: CommandLine) -> Runner:
    return Runner(inputs, tmp_path_factory.mktemp("runs"), command_line)


OF_THE_PAPER = ("preset", "schedule", "weighted", "no_views")
"""Options that `--preset paper` sets itself."""
CASES = [(command, name, "") for command, table in OPTIONS.items() for name in table] + [
    (command, name, " --preset paper")
    for command in ("distill", "simplify", "recover", "adapt", "select")
    for name in OPTIONS[command]
    if name not in OF_THE_PAPER
]


@pytest.mark.parametrize(("command", "option", "preset"), CASES)
def test_an_option_changes_the_result_or_is_refused(
    command: str, option: str, preset: str, runner: Runner
) -> None:
    words, budgets = _base(command, preset), ("count", "ratio", "fit", "min_psnr", "min_ssim")
    if option in budgets and command in ("distill", "simplify"):
        words = words.replace(" -r 8", "")
    usual = runner.base(command, preset)
    error, result = runner.run(f"{words} {OPTIONS[command][option]}")
    if error:
        assert error.count("\n") == 1 or error.splitlines()[-1].startswith("g2ard"), error
        assert "internal error" not in error
    else:
        assert result != usual


def test_the_tables_hold_every_option() -> None:
    from typer.main import get_command

    from g2ard.cli.app import register_commands
    from g2ard.cli.command import app

    register_commands()
    commands = get_command(app).commands  # type: ignore[attr-defined]
    for command, table in OPTIONS.items():
        named = {p.name for p in commands[command].params if p.param_type_name == "option"}
        apart = set(NO_RESULT) | set(OWN.get(command, ())) | {"output", "help"}
        assert named - apart == set(table) - {"output"}, command
    assert set(commands) == set(OPTIONS)
