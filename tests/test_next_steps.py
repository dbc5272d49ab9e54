"""What is refused says what would do, and is refused before any work; options are what their names say."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT
from PIL import Image
from scenes import around, checkered_ball

import g2ard
from g2ard.cli.budget_options import Count, Counts
from g2ard.cli.frame import Run
from g2ard.cli.resume import rows_kept
from g2ard.errors import InputError
from g2ard.io import Points, write_points
from g2ard.report.window import Crop
from g2ard.stages.recover.anchors import PAPER_PRESETS, PRESETS
from g2ard.system import devices

CommandLine = Callable[..., tuple[int, str, str]]
BALL = checkered_ball(400)


def refused(command_line: CommandLine, folder: Path, *arguments: object, status: int = 2) -> str:
    """The one line that answers a call."""
    found, _, error = command_line(*arguments, cwd=folder)
    assert (found, error.count("\n")) == (status, 1), error
    return error


def test_the_time_of_recovery_is_called_so(command_line: CommandLine, folder: Path) -> None:
    shown = command_line("distill", "--help", cwd=folder)[1]
    assert "--recovery-time" in shown
    assert "--time-limit" not in shown
    ask = ("distill", "ball.ply", "-r", 10, "-o", "run")
    for name in ("--recovery-time", "--time-limit"):
        status, out, error = command_line(*ask, name, "90s", "--print-config", cwd=folder)
        assert status == 0, error
        assert "recovery-time = 90\n" in out
    for name in ("recovery-time", "time-limit", "time_limit"):
        (folder / "c.toml").write_text(f"[distill]\n{name} = '2m'\n")
        status, out, error = command_line(*ask, "--config", "c.toml", "--print-config", cwd=folder)
        assert (status, "recovery-time = 120\n" in out) == (0, True), error


def test_budgets_that_come_to_one_place_are_refused_before_any_work(
    command_line: CommandLine, folder: Path
) -> None:
    ask = ("distill", "ball.ply", "--json", "-")
    for budgets, name in (("20,20", "{ratio}"), ("20,20", "{count}"), ("20,20.01", "{count}")):
        error = refused(command_line, folder, *ask, "-r", budgets, "-o", name)
        assert "written to the same place" in error
    assert "poses" not in error


@pytest.mark.parametrize("command", ["simplify", "distill"])
def test_a_name_has_no_unknown_words(command: str, command_line: CommandLine, folder: Path) -> None:
    error = refused(command_line, folder, command, "ball.ply", "-r", 4, "-o", "{foo}_{ratio}.ply")
    assert "{foo} stands for nothing; {ratio} and {count}" in error
    assert sorted(path.name for path in folder.iterdir()) == ["ball.ply", "views.json"]


@pytest.mark.parametrize("option", ["render --sheet", "clean --dry-run --preview"])
def test_a_picture_is_what_its_name_says(option: str, command_line: CommandLine, folder: Path) -> None:
    command, *options = option.split()
    error = refused(command_line, folder, command, "ball.ply", *options, "a.jpg")
    assert "written as .png, not 'a.jpg'" in error
    if command == "render":
        ask = ("render", "ball.ply", "-n", 1, "--size", 32, "--sheet", "a.PNG")
        assert command_line(*ask, cwd=folder)[0] == 0
        with Image.open(folder / "a.PNG") as picture:
            assert picture.format == "PNG"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("9.000", "write 9000 or 9_000"),
        ("1.234.567", "write 1234567 or 1_234_567"),
        ("9.0", "without a dot"),
        ("0.500", "without a dot"),
        ("5,000,4,000", "5_000,4_000 or 5k,4k"),
        ("5,000,10k", "5_000,4_000 or 5k,4k"),
    ],
)
def test_counts_that_could_be_others_are_refused(text: str, words: str) -> None:
    with pytest.raises(Exception, match="not '") as refusal:
        Counts.parse(text)
    assert words in str(refusal.value)
    assert Count.parse("1.500M").of(2_000_000) == 1_500_000


@pytest.mark.parametrize(
    ("text", "near"),
    [
        ("[simplify]\nrato = 10", "rato (did you mean ratio?)"),
        ("rato = 10", "rato (did you mean ratio?)"),
        ("[simplfy]\nratio = 10", "simplfy (did you mean simplify?)"),
        ("[simplify]\nratio = 4\n[distill]\nview_count = 3", "views-count"),
        ("stepz = 7\n[recover]\nsteps = 9\n[simplify]\nratio = 4", "stepz (did you mean steps?)"),
    ],
)
def test_unknown_keys_are_told_with_those_near(
    text: str, near: str, command_line: CommandLine, folder: Path
) -> None:
    (folder / "c.toml").write_text(text)
    assert near in refused(command_line, folder, "simplify", "ball.ply", "-o", "s.ply", "--config", "c.toml")


@pytest.mark.parametrize(
    ("arguments", "written"),
    [
        ("simplify ball.ply -o s{ratio}.ply -r 20,40.5", {"ratio": [20, 40.5]}),
        ("simplify ball.ply -o s.ply -r 20", {"ratio": 20}),
        ("simplify ball.ply -o s{count}.ply -n 50 -n 2k,10%", {"count": [50, "2k", "10%"]}),
        ("lod ball.ply -o lod", {"ratios": [1, 2, 4, 8, 16]}),
        ("poses ball.ply -o p.json --size 320x240 --up 0,0,1", {"size": "320x240", "up": [0, 0, 1]}),
        ("distill ball.ply -o run -n 50 --crop a:0,0,.5,1", {"count": 50, "crop": ["a:0.0,0.0,0.5,1.0"]}),
    ],
)
def test_a_printed_config_is_plain_and_reads_back(
    arguments: str, written: dict[str, object], command_line: CommandLine, folder: Path
) -> None:
    command, scene, *options = arguments.split()
    status, out, error = command_line(command, scene, *options, "--print-config", cwd=folder)
    assert status == 0, error
    found = tomllib.loads(out)[command]
    assert {name: found[name] for name in written} == written
    (folder / "c.toml").write_text(out)
    ask = (command, scene, "--config", "c.toml", "--print-config")
    assert command_line(*ask, cwd=folder) == (0, out, "")
    assert Crop.parse(str(Crop.parse("a:b:0,0,.5,1"))) == Crop.parse("a:b:0,0,.5,1")


def test_convert_takes_its_output_as_the_others_do(command_line: CommandLine, folder: Path) -> None:
    written = [("ball.ply", "-o", "a.splat"), ("-o", "b.splat", "ball.ply"), ("ball.ply", "c.splat")]
    for arguments in written:
        status, out, error = command_line("convert", *arguments, "--json", "-", cwd=folder)
        assert status == 0, error
        config = json.loads(out)["config"]
        assert config["scenes"] == ["ball.ply"]
        assert config["output"].endswith(".splat")
    one = {(folder / f"{name}.splat").read_bytes() for name in "abc"}
    assert len(one) == 1
    assert command_line("convert", "ball.ply", "ball.ply", "-o", "two.ply", cwd=folder)[0] == 0
    assert len(g2ard.load(folder / "two.ply")) == 800
    assert "SCENE… OUT, or SCENE… -o OUT" in refused(command_line, folder, "convert", "ball.ply")
    for arguments in (("ball.ply", "./ball.ply"), ("ball.ply", "-o", "ball.ply")):
        assert "is an input" in refused(command_line, folder, "convert", *arguments, "-w")


def test_a_dry_run_is_in_nobodys_way(command_line: CommandLine, folder: Path) -> None:
    (folder / "run").mkdir()
    (folder / "run" / "kept.txt").write_text("")
    ask = ("distill", "ball.ply", "-r", 10, "-o", "run", "--steps", 3, "--size", 32)
    assert "-w (--overwrite)" in refused(command_line, folder, *ask, status=1)
    status, _, error = command_line(*ask, "--dry-run", cwd=folder)
    assert (status, "nothing is written" in error) == (0, True), error
    status, _, error = command_line("clean", "ball.ply", "-o", "views.json", "--dry-run", cwd=folder)
    assert status == 0, error
    assert [path.name for path in (folder / "run").iterdir()] == ["kept.txt"]


def test_no_cuda_says_what_would_do(command_line: CommandLine, folder: Path) -> None:
    import torch

    if torch.cuda.is_available():
        pytest.skip("there is one")
    ask = ("recover", "ball.ply", "--teacher", "ball.ply", "-o", "o.ply", "--device", "cuda")
    error = refused(command_line, folder, *ask, status=1)
    assert "g2ard[cuda]; --device cpu needs none" in error


def test_a_gpu_in_software_is_told(command_line: CommandLine, folder: Path) -> None:
    found = devices.adapters()
    if not found or found[0].kind != "cpu":
        pytest.skip("no adapter in software comes first")
    ask = ("simplify", "ball.ply", "-r", 2, "--method", "paper", "-o", "s.ply", "--device", "gpu")
    status, _, error = command_line(*ask, cwd=folder)
    assert status == 0, error
    assert error.count(f"--device gpu: {found[0].name} is software on this CPU") == 1


def test_render_tells_what_its_count_is(command_line: CommandLine, folder: Path) -> None:
    shown = " ".join(command_line("render", "--help", cwd=folder)[1].replace("│", " ").split())
    assert "How many views to make of the scene; with --color flags, cells or parents the budget" in shown
    ask = ("render", "ball.ply", "-n", 2, "--views", "views.json", "-o", "out")
    assert "leave -n out" in refused(command_line, folder, *ask)


def test_a_folder_that_is_nothing_says_what_in_it_would_do(command_line: CommandLine, folder: Path) -> None:
    for name in ("bare/photo.jpg", "project/images/photo.PNG", "empty"):
        place = folder / name
        (place.parent if place.suffix else place).mkdir(parents=True, exist_ok=True)
        if place.suffix:
            Image.new("RGB", (16, 16)).save(place)
    for name, photos in (("bare", "bare"), ("project", "project/images")):
        error = refused(command_line, folder, "distill", "--views", name, "-n", 9, "-o", "x", status=1)
        assert "photos, without their poses; COLMAP finds them: colmap automatic_recon" in error
        assert f"--image_path {photos}, then give project" in error
    assert "looked for SOG's meta.json" in refused(command_line, folder, "info", "empty", status=1)
    ask = ("distill", "ball.ply", "-r", 10, "-o", "run", "--steps", 3, "--size", 32, "--no-view")
    assert command_line(*ask, cwd=folder)[0] == 0
    (folder / "run" / "report.json").unlink()  # a folder as `distill` leaves none
    held = "run: nothing known in this folder; name what is meant of its files: scene.ply (a scene), views"
    for ask in (
        ("simplify", "run", "-r", 2, "-o", "x.ply"),
        ("evaluate", "ball.ply", "--teacher", "ball.ply", "--views", "run"),
    ):
        assert f"{held}.json (views)\n" in refused(command_line, folder, *ask, status=1)


def test_views_without_photos_say_what_stands_in(command_line: CommandLine, folder: Path) -> None:
    colors = np.full((400, 3), 0.5, np.float32)
    write_points(folder / "cloud.ply", Points(BALL.means.astype(np.float64), colors))
    to = ("-r", 4, "-o", "x", "--views", "views.json")
    for ask, words in (
        (("distill", "ball.ply", *to, "--photos"), "without --photos the scene's render stands in for it"),
        (("distill", "cloud.ply", *to), "give views with photos, or a trained scene"),
        (("distill", *to[2:], "-n", 50), "give views with photos, or a scene beside them"),
        (("recover", "ball.ply", "-o", "x.ply", *to[4:]), "--teacher SCENE stands in"),
    ):
        status, _, error = command_line(*ask, cwd=folder)
        last = error.splitlines()[-1]
        assert (status, "has no" in last or "has none" in last, words in last) == (1, True, True), error


def test_what_is_of_the_wrong_kind_says_what_it_is(folder: Path) -> None:
    with pytest.raises(InputError, match="g2ard's views, no scene; name the scene's own file"):
        g2ard.load(folder / "views.json")
    with pytest.raises(InputError, match=r"views are needed .*, this is a Gaussian scene"):
        g2ard.load_views(folder / "ball.ply")


def test_sizes_say_of_what_they_are(command_line: CommandLine, folder: Path) -> None:
    assert command_line("convert", "ball.ply", "ball.sog", cwd=folder)[0] == 0
    assert command_line("convert", "ball.ply", "folder/meta.json", cwd=folder)[0] == 0
    ask = ("evaluate", "ball.ply", "ball.sog", "folder", "--teacher", "ball.ply", "--views", "views.json")
    status, out, error = command_line(*ask, "--json", "-", cwd=folder)
    assert status == 0, error
    assert "file MB" in error
    whole, packed, chunks = (row["file_bytes"] for row in json.loads(out)["scenes"])
    assert (whole, packed) == tuple((folder / name).stat().st_size for name in ("ball.ply", "ball.sog"))
    assert chunks == sum(file.stat().st_size for file in (folder / "folder").iterdir())
    assert f"{whole / 1e6:.2f}" != f"{packed / 1e6:.2f}"
    assert f"{packed / 1e6:.2f}" in error


def test_one_is_one(command_line: CommandLine, folder: Path) -> None:
    ask = ("distill", "ball.ply", "-n", 1, "-o", "run", "--steps", 2, "--size", 32, "--format", "splat")
    status, _, error = command_line(*ask, cwd=folder)
    assert status == 0, error
    assert "400 → 1 Gaussian;" in error
    assert "MB as .ply" in error
    for ask in (("simplify", "ball.ply", "-n", 1, "-o", "s.ply"), ("convert", "s.ply", "t.splat")):
        error += command_line(*ask, cwd=folder)[2]
    error += "".join(command_line("info", "run", cwd=folder)[1:])
    ask = ("evaluate", "s.ply", "--teacher", "s.ply", "--views", "views.json", "--size", 16)
    error += command_line(*ask, cwd=folder)[2]
    assert re.findall(r"(?<![\d.,])1 [A-Za-z]*(?:Gaussian|view|step|point|photo|disc)s\b", error) == []


def test_an_interrupt_says_which_rows_stay(folder: Path) -> None:
    common = dict.fromkeys(("overwrite", "verbose", "quiet", "json", "config")) | {"seed": 0, "threads": 0}
    for table, told in ((folder / "ball.ply", ["goes on"]), (folder / "none.csv", [])):
        run = Run("simplify", {**common, "device": "cpu"}, {})
        with pytest.raises(KeyboardInterrupt), rows_kept(run, table, goes_on=True):
            raise KeyboardInterrupt
        assert [line.split("the same command ")[-1] for line in run.kept] == told


def test_scripts_need_no_deep_imports() -> None:
    """Examples and pages import `g2ard` and what stands right under it."""
    pages = [*ROOT.glob("examples/*.py"), *ROOT.glob("docs/methods/*.md"), ROOT / "README.md"]
    pages += [page for page in ROOT.glob("docs/*.md") if page.name != "benchmarks.md"]
    deep = [
        f"{page.name}: {line}"
        for page in pages
        for line in page.read_text(encoding="utf-8").splitlines()
        if re.match(r"\s*(from g2ard\.(?!synth import)|import g2ard\.)", line)
    ]
    assert deep == []
    assert g2ard.Regularizers.of("lift") == PRESETS["lift"]
    assert g2ard.Regularizers.of("noisy", paper=True) == PAPER_PRESETS["noisy"]
    with pytest.raises(InputError, match="one of trained, lift, noisy, got 'lifted'"):
        g2ard.Regularizers.of("lifted")
    targets = g2ard.TeacherRenders(BALL, around(4, (32, 24)))
    found = g2ard.distill_against(BALL, 50, targets, g2ard.DistillConfig(steps=2))
    assert len(found.splats) == 50


def test_a_scanned_cloud_and_photos_are_distilled(command_line: CommandLine, tmp_path: Path) -> None:
    """As of a city on a map: positions of a million metres, one offset, photos in the same coordinates."""
    laspy = pytest.importorskip("laspy")
    city = ("synth", "city", "-o", "city", "--points", "2k", "--views", 16, "--size", "32x24")
    assert command_line(*city, "--offset", "443000,4428000,1600", cwd=tmp_path)[0] == 0
    error = refused(command_line, tmp_path, "info", "city", status=1)
    assert "cloud.ply (a cloud), adapt.json, ood.json, train.json, val.json (views)\n" in error
    cloud = g2ard.load_points(tmp_path / "city" / "cloud.ply")
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.offsets, header.scales = cloud.positions.mean(0).round(), [1e-3] * 3
    scan = laspy.LasData(header)
    scan.x, scan.y, scan.z = cloud.positions.T
    scan.red, scan.green, scan.blue = (cloud.colors * 65535).astype(np.uint16).T
    for name in ("a.las", "b.LAZ"):
        scan.write(tmp_path / name)
        np.testing.assert_allclose(g2ard.load_points(tmp_path / name).positions, cloud.positions, atol=6e-4)
    ask = ("distill", name, "--views", "city/train.json", "-n", 400, "-o", "run", "--steps", 3, "--no-view")
    status, _, error = command_line(*ask, "--held-out", "city/val.json", cwd=tmp_path)
    assert (status, "2,000 → 400 Gaussians" in error) == (0, True), error
    np.testing.assert_allclose(g2ard.load(tmp_path / "run" / "scene.ply").offset[1], 4428000, rtol=1e-4)
    away = g2ard.Cameras.of([g2ard.Camera.facing([0, 0, 0], [0, -9, 0], width=48, height=36)])
    g2ard.save_views(tmp_path / "away.json", away)
    assert command_line("lift", name, "-o", "lifted.ply", cwd=tmp_path)[0] == 0
    ask = ("recover", "lifted.ply", "--teacher", "lifted.ply", "--views", "away.json", "-o", "r.ply")
    status, _, error = command_line(*ask, "--split", "all", cwd=tmp_path)
    moved = "of one world (`g2ard info` shows both, `g2ard convert --transform` moves a scene)"
    assert (status, moved in error) == (1, True), error
    plain = laspy.LasData(laspy.LasHeader(point_format=6, version="1.4"))
    plain.x, plain.y, plain.z = cloud.positions.T
    plain.write(tmp_path / "plain.las")
    error = refused(command_line, tmp_path, "lift", "plain.las", "-o", "p.ply", status=1)
    assert "points must be coloured (as by PDAL's filters.colorization)" in error


def test_a_name_mistyped_is_told_with_one_alike(command_line: CommandLine, folder: Path) -> None:
    ask = ("simplify", "bal.ply", "-r", 2, "-o", "o.ply")
    assert "bal.ply: no such file or folder; did you mean ball.ply?\n" in refused(
        command_line, folder, *ask, status=1
    )
    (folder / "sub").mkdir()
    with pytest.raises(InputError, match=r"folder$"):
        g2ard.load(folder / "sub" / "zzz.ply")
    with pytest.raises(InputError, match=r"folder, nor a folder .*gone$"):
        g2ard.load(folder / "gone" / "ball.ply")


@pytest.mark.parametrize("suffix", [".ply", ".sog", ".spz", ".glb"])
def test_a_damaged_file_is_told_what_to_do_about(
    suffix: str, command_line: CommandLine, folder: Path
) -> None:
    g2ard.save(folder / f"a{suffix}", BALL)
    (folder / f"b{suffix}").write_bytes((folder / f"a{suffix}").read_bytes()[:-700])
    error = refused(command_line, folder, "info", f"b{suffix}", status=1)
    assert error.endswith("; the file is damaged: copy or export it again\n")


def test_what_is_missing_or_too_much_is_named(command_line: CommandLine, folder: Path) -> None:
    """Refusals of common mistakes end with what would do."""
    for name in ("bare", "d.ply"):
        (folder / name).mkdir()
    Image.new("RGB", (16, 16)).save(folder / "bare" / "a.png")
    for ask, status, step in (
        (("recover", "ball.ply", "-o", "o.ply", "--steps", 3, "--recovery-time", 9), 2, "; give one"),
        (("simplify", "ball.ply", "-r", 2, "-o", "o.ply", "--views", "v", "--no-views"), 2, "; give one"),
        (("simplify", "ball.ply", "-r", 2, "-o", "d.ply"), 1, "name one in it"),
        (("render", "ball.ply", "-n", 1, "-o", "ball.ply"), 2, "name another output"),
        (("render", "ball.ply", "-n", 1, "-o", "views.json"), 1, "name another"),
        (("simplify", "ball.ply", "-r", 2, "-o", "o.ply", "--json", "o.ply"), 2, "name another file for one"),
        (("convert", "ball.ply", "o.ply", "--box", "1,1,1,0,0,0"), 1, "the lower corner comes first"),
        (("lift", "ball.ply", "-o", "o.ply"), 1, "ready for `simplify` and `distill`"),
        (("register", "ball.ply", "--photos", "bare", "-o", "o.json", "--pool", 8), 1, "--focal PIXELS"),
        (("evaluate", "ball.ply", "--views", "views.json", "--split", "val"), 1, "there are test, train"),
    ):
        assert step in refused(command_line, folder, *ask, status=status)
