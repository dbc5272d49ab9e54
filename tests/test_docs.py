"""Documentation against the code: links, commands, options, names, records, plots."""

import ast
import importlib.util
import re
import runpy
from functools import cache
from pathlib import Path
from typing import Any

import pytest

import g2ard
from benchmarks import synth
from benchmarks.synth import city
from helpers.commands import CommandLine, succeeds
from helpers.project import ROOT
from helpers.scenes import checkered_ball

PAGES = sorted(
    page
    for pattern in ("*.md", "docs/**/*.md", "benchmarks/record/*.md")
    for page in ROOT.glob(pattern)
)
NAMES = [str(page.relative_to(ROOT)) for page in PAGES]
BALL = checkered_ball(400)


def without_code(text: str) -> str:
    text = re.sub(r"(?ms)^ *```.*?^ *```", "", text)
    return re.sub(r"`[^`\n]*`", "code", text)


def anchors(page: Path) -> set[str]:
    """Return the fragments of a page's headings, as GitHub makes them."""
    titles = re.findall(
        r"(?m)^#{1,6} (.+)$", re.sub(r"(?ms)^```.*?^```", "", page.read_text(encoding="utf-8"))
    )
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("name", NAMES)
def test_relative_links_lead_somewhere(name: str) -> None:
    page = ROOT / name
    for target in re.findall(r"\]\(([^)\s]+)\)", without_code(page.read_text(encoding="utf-8"))):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, fragment = target.partition("#")
        there = (page.parent / path) if path else page
        assert there.is_file(), f"{name}: {target}"
        if fragment:
            assert fragment in anchors(there), f"{name}: {target}"


def test_the_documentation_stays_short() -> None:
    pages = [
        ROOT / name
        for name in NAMES
        if not name.startswith(("benchmarks/", "CHANGELOG", "SECURITY"))
    ]
    assert sum(len(page.read_text(encoding="utf-8").split()) for page in pages) <= 36_000


CURRENT = [
    n for n in NAMES if not n.startswith(("benchmarks/record", "docs/decisions/", "CHANGELOG"))
]


@cache
def all_help(command: str, command_line: CommandLine) -> str:
    return succeeds(command_line, ROOT, *command.split(), "--help-all").out


def unknown_in(text: str, command_line: CommandLine) -> list[str]:
    """Return the options in calls quoted in a page's text that their command does not have."""
    quoted = re.findall(r"`g2ard ([a-z]+ )([^`\n]*)`", re.sub(r"(?ms)^```.*?^```", "", text))
    return [
        f"{command}{option}"
        for command, rest in quoted
        for option in re.findall(r"(?:^| )(--?[a-zA-Z][\w-]*)", rest)
        if not re.search(rf"(?m)(^|[ ,/]){option}\b", all_help(command, command_line))
    ]


@pytest.mark.parametrize("name", CURRENT)
def test_options_of_commands_in_sentences_exist(name: str, command_line: CommandLine) -> None:
    """tests/test_documented_commands.py runs the commands that stand alone."""
    assert unknown_in((ROOT / name).read_text(encoding="utf-8"), command_line) == []


def test_a_wrong_option_would_be_found(command_line: CommandLine) -> None:
    assert unknown_in("Type `g2ard simplify a.ply -r 10 --ratioo 9`.", command_line) == [
        "simplify --ratioo"
    ]


def test_make_targets_named_exist() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"(?m)^([a-z-]+):", makefile))
    for name in CURRENT:
        for target in re.findall(
            r"(?m)(?:`|^)make ([a-z-]+)", (ROOT / name).read_text(encoding="utf-8")
        ):
            assert target in targets, f"{name}: make {target}"


@pytest.mark.parametrize("name", CURRENT)
def test_python_examples_parse_and_their_names_exist(name: str) -> None:
    for block in re.findall(
        r"(?ms)^```python\n(.*?)^```", (ROOT / name).read_text(encoding="utf-8")
    ):
        for node in ast.walk(ast.parse(block)):
            if (
                isinstance(node, ast.Attribute)
                and isinstance(node.value, ast.Name)
                and node.value.id == "g2ard"
            ):
                assert node.attr in g2ard.__all__, f"{name}: g2ard.{node.attr}"


@pytest.fixture
def short(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run in a folder of its own, where distillations are small."""
    distill, quick = g2ard.distill, {"steps": 5, "size": 48, "settings": {"focus": "far"}}
    monkeypatch.setattr(
        g2ard, "distill", lambda *given, **named: distill(*given, **{**named, **quick})
    )
    monkeypatch.chdir(tmp_path)


def run_guide(name: str, *, alone: bool = False) -> dict[str, Any]:
    """Run the Python of a page, which finds a scene.ply, and return the names of its last block.

    `alone` runs each block without the names of those before it, as somebody does who copies one.
    """
    g2ard.save("scene.ply", BALL)
    text = (ROOT / name).read_text(encoding="utf-8")
    names: dict[str, Any] = {}
    for block in re.findall(r"(?ms)^```python\n(.*?)^```", text):
        names = {} if alone else names
        exec(compile(block, name, "exec"), names)
    return names


def test_the_readmes_python_runs_block_by_block(short: None) -> None:
    names = run_guide("README.md", alone=True)
    assert names["scene"][0].grad.abs().max() > 0
    assert len(names["better"].splats) == len(BALL) // 10


def test_the_python_guide_runs(short: None) -> None:
    names = run_guide("docs/how-to/from-python.md")
    assert len(names["better"].splats) == len(names["small"].splats) == len(BALL) // 10
    assert g2ard.load("better.sog").means.shape == (len(BALL) // 10, 3)


def test_the_guide_to_own_views_runs(short: None) -> None:
    names = run_guide("docs/how-to/own-views.md")
    assert (names["image"] > 0.05).any(axis=2).mean() > 0.1  # it shows the scene
    assert abs(names["view"].viewmat[1, :3] @ names["up"]) > 0.99  # upright
    assert len(names["result"].splats) == len(BALL) // 10


def test_the_rasteriser_guide_trains_a_scene(short: None) -> None:
    names = run_guide("docs/how-to/rasteriser.md")
    before, after = (
        g2ard.evaluate(names[scene], names["targets"]).psnr for scene in ("small", "trained")
    )
    assert after > before


def test_the_example_runs(short: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(synth, "city", lambda **given: city(**{**given, "points": 10_000}))
    before, after = runpy.run_path(str(ROOT / "examples" / "02_from_python.py"))["main"]()
    assert after > before + 1


def test_the_api_page_has_every_public_name_once() -> None:
    text = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    listed = re.findall(r"^\.\. auto\w+:: (\w+)$", text, re.MULTILINE)
    assert sorted(listed) == sorted(set(g2ard.__all__) - {"__version__"})


@pytest.mark.parametrize(
    ("index", "folder"),
    [
        ("docs/methods/index.md", "docs/methods"),
        ("benchmarks/record/README.md", "benchmarks/record"),
        ("docs/how-to/index.md", "docs/how-to"),
    ],
)
def test_an_index_lists_every_page_of_its_folder(index: str, folder: str) -> None:
    text = (ROOT / index).read_text(encoding="utf-8")
    for page in (ROOT / folder).glob("*.md"):
        if page != ROOT / index:
            assert f"{page.name})" in text, f"{index} does not list {page.name}"


def test_plots_match_the_recorded_rows() -> None:
    path = ROOT / "benchmarks" / "plots.py"
    spec = importlib.util.spec_from_file_location("plots", path)
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    drawn = module.plots()
    folder = ROOT / "docs" / "plots"
    assert sorted(drawn) == sorted(p.name for p in folder.glob("*.svg"))
    for name, svg in drawn.items():
        assert svg == (folder / name).read_text(encoding="utf-8"), (
            f"{name}: run python -m benchmarks.plots"
        )


def test_the_readme_names_every_command_and_scene_format() -> None:
    from g2ard.cli.app import COMMANDS
    from g2ard.io.detect import KINDS

    text = (ROOT / "README.md").read_text(encoding="utf-8")
    table = "\n".join(line for line in text.splitlines() if line.startswith("| `"))
    assert [name for name in COMMANDS if f"`{name}`" not in table] == []
    scenes = text.split("\n## Formats\n")[1].split("\n## ")[0]
    names = {
        "sog": "SOG",
        "compressed_ply": ".compressed.ply",
        "usd": "OpenUSD",
        "tiles": "folders of tiles",
    }
    kinds = [name for name, kind in KINDS.items() if kind == "splats"]
    assert [name for name in kinds if names.get(name, f".{name}") not in scenes] == []


def test_scripts_need_no_deep_imports() -> None:
    """Examples and pages use only names of `g2ard` itself."""
    pages = [*ROOT.glob("examples/*.py"), *ROOT.glob("docs/methods/*.md"), ROOT / "README.md"]
    pages += [page for page in ROOT.glob("docs/*.md") if page.name != "benchmarks.md"]
    deep = [
        f"{page.name}: {line}"
        for page in pages
        for line in page.read_text(encoding="utf-8").splitlines()
        if re.match(r"\s*(from g2ard\.(?!synth import)|import g2ard\.)", line)
    ]
    assert deep == []
