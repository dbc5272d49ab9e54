"""Documentation against the code: links, commands, options, names, records, plots."""

import ast
import importlib.util
import json
import re
import shlex
from functools import cache, partial
from pathlib import Path
from typing import Any

import pytest

import g2ard
from g2ard.errors import InputError
from g2ard.stages.recover.anchors import PAPER_REGULARIZERS, REGULARIZERS
from helpers.project import ROOT
from helpers.scenes import around, checkered_ball

PAGES = sorted(
    page for pattern in ("*.md", "docs/**/*.md", "benchmarks/record/*.md") for page in ROOT.glob(pattern)
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


@cache
def command_options() -> dict[str, set[str]]:
    """Return the options of each command."""
    from typer.main import get_command

    from g2ard.cli.app import register_commands
    from g2ard.cli.frame import app

    register_commands()
    found: dict[str, set[str]] = {}

    def walk(command: Any, path: str) -> None:
        options = {o for p in command.params for o in (*p.opts, *p.secondary_opts) if o.startswith("-")}
        found[path] = options | {"-h", "--help", "--help-all"}
        for name, inner in getattr(command, "commands", {}).items():
            walk(inner, f"{path} {name}".strip())

    walk(get_command(app), "")
    return found


def shell_lines(text: str) -> list[str]:
    """Return the lines of a page's shell blocks, and calls quoted in its text."""
    blocks = re.findall(r"(?ms)^```sh\n(.*?)^```", text)
    quoted = re.findall(r"`(g2ard [^`\n]+)`", re.sub(r"(?ms)^```.*?^```", "", text))
    return [line for block in blocks for line in block.splitlines()] + quoted


def calls_in(text: str) -> list[list[str]]:
    """Return the arguments of every `g2ard …` in a page."""
    parts = [part for line in shell_lines(text) for part in re.split(r"&&|\|", line)]
    calls = [part.replace("…", "") for part in parts if re.match(r"\s*g2ard\s", part)]
    return [shlex.split(call, comments=True)[1:] for call in calls]


def unknown_in(arguments: list[str]) -> str:
    """Return the first unknown command or option; "" if all are known."""
    commands = command_options()
    path = ""
    while arguments and f"{path} {arguments[0]}".strip() in commands:
        path = f"{path} {arguments[0]}".strip()
        arguments = arguments[1:]
    if not path and arguments and not arguments[0].startswith("-") and arguments[0] != "COMMAND":
        return arguments[0]
    known = commands[path] if path else set().union(*commands.values())
    for argument in arguments:
        option = argument.split("=")[0]
        if re.match(r"--?[a-zA-Z]", option) and option not in known:
            return f"{path} {option}"
    return ""


CURRENT = [n for n in NAMES if not n.startswith(("benchmarks/record", "docs/decisions/", "CHANGELOG"))]


@pytest.mark.parametrize("name", CURRENT)
def test_commands_and_options_named_exist(name: str) -> None:
    for arguments in calls_in((ROOT / name).read_text(encoding="utf-8")):
        assert not unknown_in(list(arguments)), f"{name}: g2ard {shlex.join(arguments)}"


def test_a_wrong_option_would_be_found() -> None:
    (good,) = calls_in("```sh\ng2ard simplify a.ply -r 10 -o b.ply   # --nothing\n```")
    (bad,) = calls_in("```sh\ng2ard simplify a.ply --ratioo 10\n```")
    assert unknown_in(good) == ""
    assert unknown_in(bad) == "simplify --ratioo"
    assert unknown_in(["simplfy", "a.ply"]) == "simplfy"
    assert len(calls_in((ROOT / "README.md").read_text(encoding="utf-8"))) > 5


def test_make_targets_named_exist() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"(?m)^([a-z-]+):", makefile))
    for name in CURRENT:
        for target in re.findall(r"(?m)(?:`|^)make ([a-z-]+)", (ROOT / name).read_text(encoding="utf-8")):
            assert target in targets, f"{name}: make {target}"


@pytest.mark.parametrize("name", CURRENT)
def test_python_examples_parse_and_their_names_exist(name: str) -> None:
    for block in re.findall(r"(?ms)^```python\n(.*?)^```", (ROOT / name).read_text(encoding="utf-8")):
        for node in ast.walk(ast.parse(block)):
            if (
                isinstance(node, ast.Attribute)
                and isinstance(node.value, ast.Name)
                and node.value.id == "g2ard"
            ):
                assert node.attr in g2ard.__all__, f"{name}: g2ard.{node.attr}"


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


def test_the_readmes_python_runs_block_by_block(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(g2ard, "distill", partial(g2ard.distill, steps=20, size=48))
    names = run_guide("README.md", alone=True)
    assert names["scene"][0].grad.abs().max() > 0
    assert len(names["better"].splats) == len(BALL) // 10


def test_the_python_guide_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names = run_guide("docs/how-to/from-python.md")
    assert len(names["better"].splats) == len(names["small"].splats) == len(BALL) // 10
    assert g2ard.load("better.sog").means.shape == (len(BALL) // 10, 3)


def test_the_guide_to_own_views_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names = run_guide("docs/how-to/own-views.md")
    assert (names["image"] > 0.05).any(axis=2).mean() > 0.1  # it shows the scene
    assert abs(names["view"].viewmat[1, :3] @ names["up"]) > 0.99  # upright
    assert len(names["result"].splats) == len(BALL) // 10


def test_the_rasteriser_guide_trains_a_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names = run_guide("docs/how-to/rasteriser.md")
    before, after = (g2ard.evaluate(names[scene], names["targets"]).psnr for scene in ("small", "trained"))
    assert after > before


def test_the_notebook_runs_and_holds_its_output(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cells = json.loads((ROOT / "examples/quickstart.ipynb").read_text(encoding="utf-8"))["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == [*range(1, len(code) + 1)]
    assert not [cell for cell in code if any(out["output_type"] == "error" for out in cell["outputs"])]
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("G2ARD_SCENE", raising=False)
    monkeypatch.delenv("G2ARD_DATA", raising=False)
    names: dict[str, Any] = {}
    first, *rest = ("".join(cell["source"]) for cell in code)
    exec(compile(first, "quickstart.ipynb", "exec"), names)
    assert len(names["scene"]) == 20_000
    names["scene"] = BALL  # as small as a test should be
    for source in rest:
        exec(compile(source, "quickstart.ipynb", "exec"), names)
    assert len(names["result"].splats) == len(BALL) // 10
    assert g2ard.load("small.sog").means.shape == (len(BALL) // 10, 3)


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
        assert svg == (folder / name).read_text(encoding="utf-8"), f"{name}: run python -m benchmarks.plots"


def test_the_readme_names_every_command_and_scene_format() -> None:
    from g2ard.cli.app import COMMANDS
    from g2ard.io.detect import KINDS

    text = (ROOT / "README.md").read_text(encoding="utf-8")
    table = "\n".join(line for line in text.splitlines() if line.startswith("| `"))
    assert [name for name in COMMANDS if f"`{name}`" not in table] == []
    scenes = text.split("\n## Formats\n")[1].split("\n## ")[0]
    names = {"sog": "SOG", "compressed_ply": ".compressed.ply", "usd": "OpenUSD", "tiles": "folders of tiles"}
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
    assert g2ard.Regularizers.of("lift") == REGULARIZERS["lift"]
    assert g2ard.Regularizers.of("noisy", paper=True) == PAPER_REGULARIZERS["noisy"]
    with pytest.raises(InputError, match="one of trained, lift, noisy, got 'lifted'"):
        g2ard.Regularizers.of("lifted")
    targets = g2ard.TeacherRenders(BALL, around(4, (32, 24)))
    found = g2ard.distill_against(
        BALL, 50, targets, g2ard.DistillConfig(recover=g2ard.RecoverConfig(steps=2))
    )
    assert len(found.splats) == 50
