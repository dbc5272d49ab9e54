"""`python -m benchmarks run`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from benchmarks.commands.group import bench
from g2ard.cli.budget_options import parse_ratio
from g2ard.cli.frame import Run, command
from g2ard.cli.options import PaperOption, SizeOption, ViewsOption
from g2ard.cli.resume import rows_kept
from g2ard.progress import plural

if TYPE_CHECKING:
    from benchmarks.definition import Definition, MethodSpec
    from benchmarks.run_rows import Row


@command("run", parent=bench, example="python -m benchmarks run benchmarks/definitions/compression.toml")
def run_(
    run: Run,
    definitions: Annotated[
        list[Path] | None, typer.Argument(metavar="[DEFINITION.toml...]", help="Studies.")
    ] = None,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder of the run.")] = Path(
        "figures"
    ),
    scene: Annotated[
        list[Path] | None,
        typer.Option("--scene", metavar="SCENE", help="Instead of a study: scenes to measure on."),
    ] = None,
    views: ViewsOption = None,
    photos: Annotated[bool, typer.Option("--photos", help="With --scene: targets are the photos.")] = False,
    only: Annotated[
        str | None, typer.Option(metavar="NAMES", help="Of the studies' scenes, comma-separated.")
    ] = None,
    methods: Annotated[str | None, typer.Option(metavar="NAMES", help="Comma-separated.")] = None,
    ratios: Annotated[str | None, typer.Option(help="Comma-separated.")] = None,
    steps: Annotated[str | None, typer.Option(help="Step-matched at these, comma-separated.")] = None,
    seconds: Annotated[
        str | None, typer.Option("--seconds", "--time", help="Time-matched at these, comma-separated.")
    ] = None,
    seeds: Annotated[str | None, typer.Option(help="Comma-separated.")] = None,
    adapt_steps: Annotated[
        int | None, typer.Option(min=1, help="At most, in studies that adapt on frozen geometry.")
    ] = None,
    released: Annotated[
        bool | None, typer.Option("--released/--matched", help="Also each method's own schedule.")
    ] = None,
    lpips: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Weights of LPIPS; without them it is absent.")
    ] = None,
    size: SizeOption = None,
    preset: PaperOption = None,
    keep: Annotated[bool, typer.Option("--keep", help="Keep intermediate scenes.")] = False,
) -> None:
    """Compare methods under matched compute: CSV, and an HTML report of error against time and count.

    A stopped run goes on where it was, -w measures anew; a cell that failed is a row with its error, and is
    tried again. DIR/report.html is of the studies named last, DIR/rows.csv of all that DIR holds.
    """
    from benchmarks.paper import as_in_the_paper
    from benchmarks.report import write_report
    from benchmarks.run import bench_run

    if bool(definitions) == bool(scene):
        raise typer.BadParameter("give either DEFINITION.toml files or --scene SCENE")
    if scene and (only or adapt_steps):
        raise typer.BadParameter("--only and --adapt-steps are for studies, not for --scene")
    if definitions and (views or photos):
        raise typer.BadParameter("--views and --photos go with --scene: a study names its own")
    options: dict[str, Any] = {
        "ratios": _numbers(ratios, parse_ratio),
        "steps": _numbers(steps, _whole),
        "seconds": _numbers(seconds, float),
        "seeds": _numbers(seeds, int) or ((run.seed,) if run.seed else None),
        "released": released,
        "size": size,
        "lpips": None if lpips is None else str(lpips.absolute()),
        "adapt_steps": adapt_steps,
    }
    names = [name.strip() for name in methods.split(",")] if methods else []
    if scene:
        studies = [_ad_hoc(scene, views, photos, names, options)]
    else:
        studies = [_narrowed(run, path, only, names, options) for path in definitions or []]
    if preset:
        studies = [
            as_in_the_paper(study, released, preset.removeprefix("paper-").removeprefix("paper") or None)
            for study in studies
        ]
    with rows_kept(run, output / "rows.csv", goes_on=True):
        rows = bench_run(studies, output, keep=keep, again=run.overwrite, progress=run.progress)
    write_report(output, studies, rows)
    run.console.table(
        "PSNR and SSIM on unseen views; CPU seconds of reduction and recovery",
        [
            "study",
            "scene",
            "ratio",
            "method",
            "matched",
            "split",
            "against",
            "Gaussians",
            "PSNR",
            "SSIM",
            "CPU s",
        ],
        [_bench_row(row) for row in rows],
    )
    run.say(f"rows: {output / 'rows.csv'}\nreport: {output / 'report.html'}")
    run.result({"rows": [asdict(row) for row in rows]})
    failed = sum(bool(row.error) for row in rows)
    if failed:
        run.unmet(f"{plural(failed, 'cell')} failed; the same command tries them again")


def _ad_hoc(
    scenes: list[Path], views: Path | None, photos: bool, names: list[str], options: dict[str, Any]
) -> Definition:
    """A study of the scenes given; either kind of budget alone means only that."""
    from benchmarks.definition import Definition, SceneSpec
    from benchmarks.simplify import scene_label

    train = None if views is None else str(views.absolute())
    targets = "photos" if photos else "teacher"
    specs = tuple(SceneSpec(scene_label(p), str(p.absolute()), train, targets=targets) for p in scenes)
    if options["steps"] or options["seconds"]:
        options |= {key: options[key] or () for key in ("steps", "seconds")}
    made = Definition("scenes", "", specs, (), steps=(500,))
    return made.narrowed(**{**options, "adapt_steps": None}, methods=_chosen(made, names or list(_PRUNERS)))


def _narrowed(
    run: Run, path: Path, only: str | None, names: list[str], options: dict[str, Any]
) -> Definition:
    """A definition with the options that apply to it: it keeps to the kinds of budget it has."""
    from benchmarks.definition import read_definition
    from benchmarks.paper import with_released
    from g2ard.errors import InputError

    study = read_definition(path)
    wanted = None if only is None else {name.strip() for name in only.split(",")}
    scenes = tuple(s for s in study.scenes if wanted is None or s.name in wanted)
    if not scenes:
        raise InputError(f"{path}: no scene {only!r} (it has {', '.join(s.name for s in study.scenes)})")
    own = {key: options[key] for key in ("steps", "seconds", "adapt_steps") if getattr(study, key)}
    for key in ("steps", "seconds", "adapt_steps"):
        if options[key] and key not in own:
            run.say(f"{path}: has no {key}, and --{key.replace('_', '-')} is left out there")
    shared = {key: options[key] for key in ("ratios", "seeds", "released", "size", "lpips")}
    methods = _chosen(study, names) if names else None
    given = ", ".join(f"{key} {_told(value)}" for key, value in (own | shared).items() if value is not None)
    line = (f"run with {given} instead of what the study and the lines below say",) if given else ()
    narrow = study.narrowed(**own, **shared, scenes=scenes, methods=methods, differs=(*line, *study.differs))
    released = options["released"]
    return narrow if released is None else with_released(narrow, released)


def _told(value: object) -> str:
    return " and ".join(f"{part:g}" for part in value) if isinstance(value, tuple) else str(value)


def _chosen(study: Definition, names: list[str]) -> tuple[MethodSpec, ...]:
    from benchmarks.definition import METHODS
    from g2ard.errors import InputError

    known = {**METHODS, **{method.name: method for method in study.methods}}
    unknown = next((name for name in names if name not in known), None)
    if unknown is not None:
        raise InputError(f"{study.name}: no method {unknown!r} (there are {', '.join(known)})")
    return tuple(known[name] for name in names)


_PRUNERS = ("g2ard", "lightgaussian", "pup", "mini-splatting", "nanogs", "opacity-area", "random")


def _numbers(text: str | None, parse: Callable[[str], Any]) -> tuple[Any, ...] | None:
    if text is None:
        return None
    try:
        return tuple(parse(part) for part in text.split(","))
    except ValueError:
        raise typer.BadParameter(f"numbers separated by commas, not {text!r}") from None


def _whole(text: str) -> int:
    value = int(text)
    if value < 1:
        raise ValueError(text)
    return value


def _bench_row(row: Row) -> list[str]:
    from benchmarks.methods import Matched

    matched = Matched(row.matched, row.amount).label
    head = [row.study, row.scene, f"{row.ratio:g}", row.method, matched, row.split, row.against]
    if row.error:
        return [*head, row.error, "", "", ""]
    return [*head, f"{row.count:,}", f"{row.psnr:.2f}", f"{row.ssim:.4f}", f"{row.cpu_s:.1f}"]
