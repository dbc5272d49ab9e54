"""Studies of any kind: reading, measuring once, and the command's and report's output."""

import json
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import pytest

from benchmarks.kinds.methods import METHODS
from benchmarks.report import write_report
from benchmarks.rows import read_rows, rounded, shown
from benchmarks.runner import run
from benchmarks.study import DEFINITIONS, Cell, SceneSpec, Study, read_study
from g2ard import io
from g2ard.errors import InputError
from helpers.commands import CommandLine, refused, succeeds
from helpers.project import ROOT
from helpers.scenes import checkered_ball
from helpers.studies import STUDY, check_page, study
from helpers.systems import needs_processes


@dataclass(frozen=True)
class Toy(Study):
    """Cells that count how often they are measured; the method "broken" fails."""

    def cells(self, scene: SceneSpec, work: Path) -> Iterator[Cell]:
        for ratio in self.ratios:
            for method in self.methods:
                yield Cell({"ratio": ratio, "method": method}, lambda m=method: self.measured(m))

    def measured(self, method: str) -> list[dict]:
        CALLS.append(method)
        if method == "broken":
            raise InputError("it broke")
        if method == "interrupted":
            raise KeyboardInterrupt
        return [{"psnr": 30.1234567, "ssim": 0.9, "count": 5, "cpu_s": 1.0, "views": 3}]


CALLS: list[str] = []


def toy(folder: Path, *methods: str, **options: object) -> Toy:
    CALLS.clear()
    if not (folder / "a.ply").exists():
        (folder / "a.ply").write_text("something")
    return Toy("toys", "Toys", (SceneSpec("a", "a.ply"),), methods, folder=folder, **options)


def test_cells_are_measured_once_and_failures_again(tmp_path: Path) -> None:
    rows = run([toy(tmp_path, "good", "broken")], tmp_path / "out")
    assert [row.get("error") for row in rows] == [None, "it broke"]
    assert rows == read_rows(tmp_path / "out" / "rows.csv")
    assert rows[0]["psnr"] == 30.1235
    assert run([toy(tmp_path, "good", "broken")], tmp_path / "out") == rows
    assert CALLS == ["broken"]
    run([toy(tmp_path, "good")], tmp_path / "out", again=True)
    assert CALLS == ["good"]
    run([toy(tmp_path, "good", ratios=(2.0,))], tmp_path / "out")
    assert {row["ratio"] for row in read_rows(tmp_path / "out" / "rows.csv")} == {2.0, 10.0}


def test_a_run_ends_with_the_reason_of_a_failure(tmp_path: Path, command_line: CommandLine) -> None:
    path = study(tmp_path)
    (tmp_path / "ball.ply").unlink()
    status, _, said = command_line("benchmarks", "run", path, "-o", "out", cwd=tmp_path)
    assert status == 3
    assert re.search(r"rows failed.* The first: .*ball\.ply: no such file", said.splitlines()[-1])


def test_changed_files_and_settings_replace_rows(tmp_path: Path) -> None:
    (first,) = run([toy(tmp_path, "good")], tmp_path / "out")
    changed = toy(tmp_path, "good", size=64)
    assert run([changed], tmp_path / "out")[0]["cell"] != first["cell"]
    (tmp_path / "a.ply").write_text("something else")
    run([replace(changed)], tmp_path / "out")
    assert CALLS == ["good"] * 2
    assert len(read_rows(tmp_path / "out" / "rows.csv")) == 1
    other = replace(toy(tmp_path, "good"), name="others")
    run([other], tmp_path / "out")
    assert [row["study"] for row in read_rows(tmp_path / "out" / "rows.csv")] == ["toys", "others"]


def test_an_interrupted_run_keeps_its_rows_and_others_files(tmp_path: Path) -> None:
    thesis = tmp_path / "out" / "work" / "thesis.txt"
    thesis.parent.mkdir(parents=True)
    thesis.write_text("precious")
    with pytest.raises(KeyboardInterrupt):
        run([toy(tmp_path, "good", "interrupted")], tmp_path / "out")
    assert [row["method"] for row in read_rows(tmp_path / "out" / "rows.csv")] == ["good"]
    run([toy(tmp_path, "good")], tmp_path / "out")
    assert CALLS == []
    assert [path.name for path in thesis.parent.iterdir()] == ["thesis.txt"]


def test_the_report_shows_rows_seeds_and_failures(tmp_path: Path) -> None:
    one = toy(tmp_path, "good", "broken", differs=("small <balls>",))
    rows = run([one], tmp_path / "out")
    rows.append(rows[0] | {"seed": 1, "psnr": rows[0]["psnr"] + 2, "black": 11, "views": 484})
    write_report(tmp_path / "out", [one], rows)
    html = (tmp_path / "out" / "report.html").read_text()
    check_page(html)
    assert "Failed: a 10× broken: it broke" in html
    assert "<li>small &lt;balls&gt;</li>" in html
    assert f"a 10× good, 2 seeds: {rows[0]['psnr'] + 1:.2f} ± {2**0.5:.2f} dB" in html
    assert "11 of 495  renders are all black" in html
    columns, cells = shown(rows, 120)
    assert columns[0] == "scene"
    assert "ratio" not in columns  # the same in all
    assert cells[1][-1] == "it broke"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("ratios", "rations"), "no key 'rations'"),
        (('"pup"', '"pop"'), "no 'pop'"),
        (('base = "g2ard-paper"', 'base = "x"'), "method rounds: base"),
        (
            ("protection = 0.0", "regularizers.period = 0"),
            "method rounds: period: expected a whole number of at least 1",
        ),
        (("protection = 0.0", 'rounds = "many"'), "rounds: expected one of one, paper, pup"),
        (
            ("protection = 0.0", "shared_start = 3"),
            "method rounds: shared_start: expected true or false",
        ),
        (('name = "ball"', 'nam = "ball"'), "lacks 'name'"),
        (
            ('name = "ball"', 'name = "ball"\nadapt_last = -1'),
            "scene ball: adapt_last: expected a whole",
        ),
        (('name = "ball"', 'name = "b"\nadapt_last = 2\nadapt = "a"'), "without `adapt`"),
        (("ratios = [4]", "ratios = [4"), "balls.toml"),
        (("ratios = [4]", "ratios = []"), "no ratios"),
        (("ratios = [4]", "ratios = [0]"), "ratios: expected a number, at least 1, got 0"),
        (("ratios = [4]", "ratios = 10"), "ratios: expected a list"),
        (("ratios = [4]", "ratios = [4]\nkeep = [0.1]"), "keep and ratios exclude each other"),
        (("ratios = [4]", "keep = [1.5]"), "keep: expected a list of shares"),
        (("steps = [9]\nseconds = [1]\n", ""), "nothing to measure"),
        (("steps = [9]", "steps = [2.5]"), "steps: expected a whole number"),
        (("seconds = [1]", "seconds = [nan]"), "seconds"),
        (("steps = [9]", "size = 0"), "size"),
        (("steps = [9]", 'schedule = "nope"'), "schedule"),
        (("[[scene]]", '[[scene]]\nname = "ball"\n[[scene]]'), "the name is used twice"),
        (('title = "Balls"', "title = 3"), "title: expected text"),
        (('title = "Balls"', 'kind = "cake"'), "kind: expected one of matched"),
    ],
)
def test_invalid_studies_name_the_cause(
    tmp_path: Path, change: tuple[str, str], message: str
) -> None:
    with pytest.raises(InputError, match=re.escape(message)) as caught:
        read_study(study(tmp_path, STUDY.replace(*change)))
    assert "balls.toml" in str(caught.value)


def test_all_studies_can_be_read_and_name_their_differences(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    paths = sorted(DEFINITIONS.rglob("*.toml"))
    for path in paths:
        for name in re.findall(r"\$(\w+)", path.read_text()):
            monkeypatch.setenv(name, "/data")
    found = {path.stem: read_study(path) for path in paths}
    assert "$" not in repr([asdict(scene) for made in found.values() for scene in made.scenes])
    assert [m.name for m in found["ablations"].methods][:3] == ["full", "one-shot", "-shape"]
    for name in (
        "ablations",
        "k_sweep",
        "policies",
        "protection",
        "compression",
        "geobase",
        "source",
    ):
        assert found[name].differs
        assert any(method.lambdas == "paper" for method in found[name].methods), name
    assert all(method.shared_start for method in found["policies"].methods)
    erank = found["kings_college"].methods[:2]
    assert [method.regularizers for method in erank] == [{}, {"effective_rank": False}]
    assert erank[1].preset == "noisy"  # from its base
    mip = found["mip_nerf_360"]
    assert (mip.convention, mip.eight_bit, mip.lpips_input) == ("inria", True, "unscaled")
    assert [budget.kind for budget in mip.budgets(METHODS["teacher"])] == ["none"]
    geobase = found["matrixcity_geobase"]
    assert (geobase.adapt_schedule, geobase.adapt_on, geobase.adapt_steps) == ("paper", "all", 7000)
    assert round(3_001_333 / found["matrixcity_ablations"].ratios[0]) == 99_044


def test_options_narrow_a_study(tmp_path: Path) -> None:
    made = read_study(study(tmp_path, STUDY.replace("ratios", 'differs = ["small"]\nratios')))
    small = made.narrowed(
        {"ratios": "5,10", "methods": "rounds,random", "scene.background": "0,1,0.5"}
    )
    assert small.ratios == (5.0, 10.0)
    assert [method.name for method in small.methods] == ["rounds", "random"]
    assert small.methods[0] == made.methods[2]  # the study's own
    assert small.scenes[0].background == (0.0, 1.0, 0.5)
    assert small.differs[0].startswith("run with ratios 5,10, methods rounds,random")
    for name, message in (
        ("rations", "no key"),
        ("x.y", "no key"),
        ("ratios", "expected a number"),
    ):
        with pytest.raises(InputError, match=message):
            made.narrowed({name: "x"})


def test_recorded_rows_are_read(tmp_path: Path) -> None:
    names = (
        "run-*.csv",
        "simplify-*.csv",
        "recover-*.csv",
        "select-2*.csv",
        "ship-*.csv",
        "register-*.csv",
    )
    for name in names:
        paths = sorted((ROOT / "benchmarks" / "record").rglob(name))
        assert paths
        for path in paths:
            rows = read_rows(path)
            assert rows == [rounded(row) for row in rows] or name != "run-*.csv"
            assert all("scene" in row and isinstance(row.get("psnr", 1.0), float) for row in rows)
    (tmp_path / "rows.csv").write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match="other columns"):
        read_rows(tmp_path / "rows.csv")
    (tmp_path / "rows.csv").write_text("scene,psnr\nball,loud\n")
    with pytest.raises(InputError, match="line 2"):
        read_rows(tmp_path / "rows.csv")


@needs_processes
def test_command(command_line: CommandLine, tmp_path: Path, programs: None) -> None:
    study(tmp_path)
    few = ["--methods", "g2ard,random", "--ratios", "5", "--steps", "3"]
    ask = ("benchmarks", "run", "matched", "ball.ply", "--views", "views.json", *few, "-o", "out")
    out, err = succeeds(command_line, tmp_path, *ask, "--json", "-")
    assert [row["method"] for row in json.loads(out)["rows"]] == ["g2ard", "random"]
    assert "rows.csv" in err
    check_page((tmp_path / "out" / "report.html").read_text())
    for wrong, words in (
        (("balls.toml", "--only", "moon"), "no scene 'moon'"),
        (("matched",), "no scenes: give some"),
        (("nothing",), "no study 'nothing'"),
        (("balls.toml", "--views", "views.json"), "go with scenes"),
        (("balls.toml", "--set", "ratios"), "expected KEY=VALUE"),
        (
            ("simplify", "ball.ply", "--set", "protocol=sitting"),
            "protocol: expected one of all, pool",
        ),
    ):
        status, _, err = command_line("benchmarks", "run", *wrong, "-o", "x", cwd=tmp_path)
        assert status in (1, 2)
        assert words in err
    assert not (tmp_path / "x").exists()


def test_an_unset_variable_is_named_before_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("G2ARD_NOWHERE", raising=False)
    text = STUDY.replace("ball.ply", "${G2ARD_NOWHERE}/ball.ply")
    with pytest.raises(InputError, match=r"scene ball: \$G2ARD_NOWHERE is not set"):
        run([read_study(study(tmp_path, text))], tmp_path / "out")
    assert not (tmp_path / "out").exists()


@needs_processes
def test_nothing_is_left_running(tmp_path: Path) -> None:
    mark = tmp_path / "alive"
    late = f"import time; time.sleep(1.5); open({str(mark)!r}, 'w')"
    code = (
        "from pathlib import Path; import sys; from benchmarks.process import measured;"
        f"measured([sys.executable, '-c', {late!r}], Path({str(tmp_path / 'log')!r}))"
    )
    with subprocess.Popen([sys.executable, "-c", code]) as parent:
        time.sleep(0.8)
        parent.kill() if sys.platform == "linux" else parent.send_signal(signal.SIGINT)
    time.sleep(1.5)
    assert not mark.exists()


def test_systems_that_cannot_measure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command_line: CommandLine
) -> None:
    """Windows lacks the call."""
    import os

    io.write_splats(tmp_path / "ball.ply", checkered_ball(100))
    monkeypatch.delattr(os, "posix_spawnp", raising=False)
    for kind in ("simplify", "matched"):
        assert "needs POSIX; it does not run on Windows" in refused(
            command_line, tmp_path, "benchmarks", "run", kind, "ball.ply", "-o", "out", status=1
        )
    assert [path.name for path in tmp_path.iterdir()] == ["ball.ply"]
