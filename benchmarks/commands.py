"""The command `python -m benchmarks run`."""

from __future__ import annotations

import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.synth.command import synth
from g2ard.cli.command import command
from g2ard.cli.run import Run
from g2ard.errors import InputError
from g2ard.progress import plural

__all__ = ["app"]

app = typer.Typer(
    help="Measure speed against the machine's limit, and quality against other methods.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.add_typer(synth, name="synth")
_BUDGETS = ("steps", "seconds", "adapt_steps")
_List = Annotated[str | None, typer.Option(help="Comma-separated, instead of the study's.")]


@app.callback()
def _root() -> None:
    pass


@command(
    "run",
    parent=app,
    settings="",
    example="python -m benchmarks run simplify scene.ply --ratios 10",
)
def run_(
    run: Run,
    study: Annotated[
        list[str],
        typer.Argument(
            metavar="STUDY... [SCENE...]",
            help="Studies: .toml files, or names in benchmarks/definitions. Scenes replace theirs.",
        ),
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Folder of the run.")
    ] = Path("figures"),
    views: Annotated[
        Path | None, typer.Option(metavar="VIEWS", help="Of the scenes given.")
    ] = None,
    held_out: Annotated[
        Path | None, typer.Option(metavar="VIEWS", help="Score on these; --views is to train on.")
    ] = None,
    photos: Annotated[
        bool, typer.Option("--photos", help="Targets are the photos, not the scenes' renders.")
    ] = False,
    only: Annotated[
        str | None, typer.Option(metavar="NAMES", help="Of the studies' scenes.")
    ] = None,
    methods: _List = None,
    ratios: _List = None,
    seeds: _List = None,
    steps: _List = None,
    seconds: _List = None,
    adapt_steps: _List = None,
    size: Annotated[str | None, typer.Option(help="Longer side of the views, pixels.")] = None,
    lpips: Annotated[Path | None, typer.Option(metavar="DIR", help="Weights of LPIPS.")] = None,
    keep: Annotated[bool, typer.Option("--keep", help="Keep intermediate scenes.")] = False,
) -> None:
    """Run studies: DIR/rows.csv holds a row per measurement, DIR/report.html shows them.

    --set KEY=VALUE sets any other key of the studies, --set scene.KEY=VALUE of their scenes. A stopped
    run continues where it was, -w measures anew. A cell that fails is a row with its error, and is tried
    again.
    """
    from benchmarks.report import write_report
    from benchmarks.rows import shown
    from benchmarks.runner import run as run_studies
    from benchmarks.study import DEFINITIONS, SceneSpec, read_study, scene_label
    from g2ard.io import kind

    named = [
        Path(word) if word.endswith(".toml") else DEFINITIONS / f"{word}.toml" for word in study
    ]
    files = [
        path
        for word, path in zip(study, named, strict=True)
        if word.endswith(".toml") or path.exists()
    ]
    scenes = [Path(word) for word, path in zip(study, named, strict=True) if path not in files]
    if not files:
        there = ", ".join(sorted(path.stem for path in DEFINITIONS.glob("*.toml")))
        raise typer.BadParameter(f"no study {study[0]!r} (there are {there})")
    if not scenes and (views or held_out or photos):
        raise typer.BadParameter(
            "--views, --held-out and --photos go with scenes: a study names its own"
        )
    specs = tuple(
        SceneSpec(
            scene_label(scene),
            str(scene.absolute()),
            None if views is None else str(views.absolute()),
            {"test": str(held_out.absolute())} if held_out else {},
            targets="photos" if photos or kind(scene) != "splats" else "teacher",
        )
        for scene in scenes
    )
    flags = {"methods": methods, "ratios": ratios, "steps": steps, "seconds": seconds, "size": size}
    flags |= {"adapt_steps": adapt_steps, "lpips": None if lpips is None else str(lpips.absolute())}
    flags["seeds"] = str(run.seed) if run.seed and seeds is None else seeds
    given = {name: value for name, value in flags.items() if value is not None}
    forced = dict(_setting(text) for text in run.config.get("set") or [])
    studies = []
    for path in files:
        one = read_study(path)
        one = replace(one, scenes=specs) if scenes else one
        unfit = {name for name in _BUDGETS if not getattr(one, name, None)}
        for name in sorted(unfit & given.keys()):
            run.say(f"{path}: has no {name}, and --{name.replace('_', '-')} is ignored there")
        unfit |= set() if hasattr(one, "lpips") else {"lpips"}
        one = one.narrowed({name: given[name] for name in given if name not in unfit} | forced)
        wanted = (
            one.scenes
            if only is None
            else tuple(s for s in one.scenes if s.name in only.split(","))
        )
        if not wanted:
            there = f"no scene {only!r} (it has {', '.join(s.name for s in one.scenes)})"
            raise InputError(f"{path}: {there if one.scenes else 'no scenes: give some'}")
        studies.append(replace(one, scenes=wanted))
    table = output / "rows.csv"
    try:
        rows = run_studies(
            studies, output, keep=keep, again=run.overwrite, progress=run.progress, say=run.say
        )
    except KeyboardInterrupt:
        if table.exists():
            run.kept.append(f"finished rows are in {table}; run the same command to continue")
        raise
    write_report(output, studies, rows)
    width = shutil.get_terminal_size().columns if sys.stderr.isatty() else 120
    for one in studies:
        own = [row for row in rows if row["study"] == one.name]
        final = (row for row in own if row.get("final", 1))
        run.console.table(one.title, *shown(final, width))
        summary = one.summary(own)
        if summary is not None:
            run.console.table(*summary)
    run.say(f"rows: {table}\nreport: {output / 'report.html'}")
    run.result({"rows": rows})
    failed = [row["error"] for row in rows if "error" in row]
    if failed:
        run.exit_unmet(
            f"{plural(len(failed), 'row')} failed; the same command tries again. The first: {failed[0]}"
        )


@command(
    "cambridge",
    parent=app,
    example="python -m benchmarks cambridge KingsCollege -o KingsCollege.json",
)
def cambridge(
    run: Run,
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Scene of Cambridge Landmarks.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="OUT.json", help="Views.")],
) -> None:
    """Write the views of a scene of Cambridge Landmarks for g2ard."""
    from benchmarks.cambridge import read
    from g2ard.io import write_views

    found = read(folder)
    for note in found.notes:
        run.say(f"{folder}: {note}")
    write_views(output, found.cameras, splits=found.splits, overwrite=run.overwrite)
    run.say(f"{output}: {plural(len(found.cameras), 'view')}")
    run.result({"views": len(found.cameras), "output": str(output)})


def _setting(text: str) -> tuple[str, str]:
    name, found, value = text.partition("=")
    if not found:
        raise typer.BadParameter(f"--set: expected KEY=VALUE, not {text!r}")
    return name.strip(), value.strip()
