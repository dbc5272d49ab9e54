"""`g2ard bench`: run time against the machine's limits, and against error."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from g2ard.cli.frame import Run, command, group
from g2ard.cli.options import (
    BackgroundOption,
    SceneArgument,
    SizeOption,
    TimeLimitOption,
    ViewsOption,
    parse_ratio,
)

if TYPE_CHECKING:
    from g2ard.bench.definition import Definition, MethodSpec
    from g2ard.bench.recover import Look
    from g2ard.bench.run_rows import Row
    from g2ard.bench.simplify import Cell

    Gains = dict[str, float | str]

bench = group("bench", "Measure on this machine.\n\nExample: g2ard bench raster scene.ply --json -")


@command("raster", parent=bench, example="g2ard bench raster scene.ply --json -")
def raster(
    run: Run,
    scene: SceneArgument,
    views: ViewsOption = None,
    counts: Annotated[str, typer.Option(help="Gaussians drawn from the scene, comma-separated.")] = (
        "20k,100k,300k"
    ),
    every_isa: Annotated[
        bool, typer.Option("--every-isa", help="All instruction sets, not the best.")
    ] = False,
    repeats: Annotated[int, typer.Option(min=1, help="Steps timed; the fastest counts.")] = 15,
    size: SizeOption = None,
) -> None:
    """Milliseconds of a recovery step, pass by pass, and the share of the machine's measured limit."""
    from g2ard import _core
    from g2ard.bench.raster import bench_raster
    from g2ard.cli.options import Count
    from g2ard.cli.scenes import load_scene, load_views

    wanted = [Count.parse(part) for part in counts.split(",")]
    splats = load_scene(run, scene)
    found = bench_raster(
        splats,
        load_views(run, views, "all", size) if views else None,
        counts=[count.of(len(splats)) for count in wanted],
        isas=_core.instruction_sets() if every_isa else None,
        repeats=repeats,
        seed=run.seed,
        progress=run.progress,
    )
    passes = ("forward", "backward", "loss", "adam", "total")
    run.console.table(
        f"{found.machine['cpu']}: {found.machine['fma_gflops']:.0f} GFLOP/s, "
        f"{found.machine['read_gb_s']:.1f} GB/s measured; milliseconds",
        ["Gaussians", "size", "isa", "threads", *passes, "share of limit"],
        [
            [
                f"{row.count:,}",
                f"{row.width}×{row.height}",
                row.isa,
                str(row.threads),
                *(f"{row.ms[name]:.1f}" for name in passes),
                f"{row.limit_share:.2f}",
            ]
            for row in found.scenes
        ],
    )
    run.result(found.as_dict())


@command("simplify", parent=bench, example="g2ard bench simplify scene.ply --ratios 10 --csv figures.csv")
def simplify(
    run: Run,
    scenes: Annotated[list[Path], typer.Argument(metavar="SCENE...", help="Scenes to reduce.")],
    ratios: Annotated[str, typer.Option(help="Comma-separated.")] = "5,10,20,30",
    methods: Annotated[
        str | None,
        typer.Option(
            help="Some of default, no-views, fast, paper, splat-transform, splat-transform-adaptive, "
            "random, opacity-area, lightgaussian, pup, mini-splatting, nanogs."
        ),
    ] = None,
    views: ViewsOption = None,
    csv: Annotated[
        Path, typer.Option("-o", "--csv", metavar="FILE", help="Rows go here; those there are not redone.")
    ] = Path("bench_simplify.csv"),
    splat_transform: Annotated[
        Path | None, typer.Option(metavar="PROGRAM", help="Where splat-transform is, if not on PATH.")
    ] = None,
) -> None:
    """Error on unseen views, CPU seconds and memory of every simplifier, each as a whole command.

    Scored are every 8th of 128 poses made for the scene, or the test split of --views; nothing a method used.
    """
    from g2ard.bench.simplify import METHODS, bench_simplify, find_splat_transform, machine

    program = find_splat_transform(splat_transform)
    chosen = [m.strip() for m in methods.split(",")] if methods else list(METHODS)
    if program is None and any(m.startswith("splat-transform") for m in chosen):
        run.say("splat-transform is not on PATH (--splat-transform PROGRAM): left out")
        chosen = [m for m in chosen if not m.startswith("splat-transform")]
    cells = bench_simplify(
        scenes,
        csv,
        ratios=[parse_ratio(part) for part in ratios.split(",")],
        methods=chosen,
        views=views,
        splat_transform=program,
        seed=run.seed,
        progress=run.progress,
    )
    run.console.table(
        f"{machine()}; PSNR and SSIM on unseen views, CPU seconds and peak MB of the whole command",
        ["scene", "ratio", "method", "Gaussians", "PSNR", "SSIM", "CPU s", "wall s", "MB"],
        [_row(cell) for cell in cells],
    )
    run.result({"machine": machine(), "rows": [asdict(cell) for cell in cells]})


@command("run", parent=bench, example="g2ard bench run benches/definitions/compression.toml -o figures/")
def run_(
    run: Run,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder of the run.")],
    definitions: Annotated[
        list[Path] | None, typer.Argument(metavar="[DEFINITION.toml...]", help="Studies.")
    ] = None,
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
    keep: Annotated[bool, typer.Option("--keep", help="Keep intermediate scenes.")] = False,
) -> None:
    """Compare methods under matched compute: CSV, and an HTML report of error against time and count.

    A stopped run goes on where it was; a cell that failed is a row with its error, and is tried again.
    """
    from g2ard.bench.report import write_report
    from g2ard.bench.run import bench_run

    if bool(definitions) == bool(scene):
        raise typer.BadParameter("give either DEFINITION.toml files or --scene SCENE")
    options: dict[str, Any] = {
        "ratios": _numbers(ratios, parse_ratio),
        "steps": _numbers(steps, _whole),
        "seconds": _numbers(seconds, float),
        "seeds": _numbers(seeds, int),
        "released": released,
        "size": size,
        "lpips": None if lpips is None else str(lpips.absolute()),
        "adapt_steps": adapt_steps,
    }
    names = [name.strip() for name in methods.split(",")] if methods else []
    if scene:
        studies = [_ad_hoc(scene, views, photos, names, options)]
    else:
        studies = [_narrowed(path, only, names, options) for path in definitions or []]
    rows = bench_run(studies, output, keep=keep, progress=run.progress)
    write_report(output, studies, rows)
    run.console.table(
        "PSNR and SSIM on unseen views; CPU seconds of reduction and recovery",
        ["study", "scene", "ratio", "method", "matched", "split", "Gaussians", "PSNR", "SSIM", "CPU s"],
        [_bench_row(row) for row in rows],
    )
    run.say(f"rows: {output / 'rows.csv'}\nreport: {output / 'report.html'}")
    run.result({"rows": [asdict(row) for row in rows]})
    failed = sum(bool(row.error) for row in rows)
    if failed:
        run.unmet(f"{failed} cells failed; the same command tries them again")


def _ad_hoc(
    scenes: list[Path], views: Path | None, photos: bool, names: list[str], options: dict[str, Any]
) -> Definition:
    """A study of the scenes given; either kind of budget alone means only that."""
    from g2ard.bench.definition import Definition, SceneSpec
    from g2ard.bench.simplify import scene_label

    train = None if views is None else str(views.absolute())
    targets = "photos" if photos else "teacher"
    specs = tuple(SceneSpec(scene_label(p), str(p.absolute()), train, targets=targets) for p in scenes)
    if options["steps"] or options["seconds"]:
        options |= {key: options[key] or () for key in ("steps", "seconds")}
    made = Definition("scenes", "", specs, (), steps=(500,))
    return made.narrowed(**{**options, "adapt_steps": None}, methods=_chosen(made, names or list(_PRUNERS)))


def _narrowed(path: Path, only: str | None, names: list[str], options: dict[str, Any]) -> Definition:
    """A definition with the options that apply to it: it keeps to the kinds of budget it has."""
    from g2ard.bench.definition import read_definition
    from g2ard.errors import InputError

    study = read_definition(path)
    wanted = None if only is None else {name.strip() for name in only.split(",")}
    scenes = tuple(s for s in study.scenes if wanted is None or s.name in wanted)
    if not scenes:
        raise InputError(f"{path}: no scene {only!r} (it has {', '.join(s.name for s in study.scenes)})")
    own = {key: options[key] for key in ("steps", "seconds", "adapt_steps") if getattr(study, key)}
    shared = {key: options[key] for key in ("ratios", "seeds", "released", "size", "lpips")}
    methods = _chosen(study, names) if names else None
    return study.narrowed(**own, **shared, scenes=scenes, methods=methods)


def _chosen(study: Definition, names: list[str]) -> tuple[MethodSpec, ...]:
    from g2ard.bench.definition import METHODS
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
    matched = row.matched if row.matched == "released" else f"{row.amount:g} {row.matched}"
    head = [row.study, row.scene, f"{row.ratio:g}", row.method, matched, row.split]
    if row.error:
        return [*head, row.error, "", "", ""]
    return [*head, f"{row.count:,}", f"{row.psnr:.2f}", f"{row.ssim:.4f}", f"{row.cpu_s:.1f}"]


def _row(cell: Cell) -> list[str]:
    head = [cell.scene, f"{cell.ratio:g}", cell.method]
    if cell.error:
        return [*head, cell.error, *[""] * 5]
    return [
        *head,
        f"{cell.count:,}",
        f"{cell.psnr:.2f}",
        f"{cell.ssim:.4f}",
        f"{cell.cpu_s:.1f}",
        f"{cell.wall_s:.1f}",
        f"{cell.peak_mb:.0f}",
    ]


@command("select", parent=bench, example="g2ard bench select scene.ply city --csv figures.csv")
def select(
    run: Run,
    scenes: Annotated[
        list[Path],
        typer.Argument(
            metavar="SCENE...", help="Trained scenes, COLMAP folders with photos, or the word city."
        ),
    ],
    pools: Annotated[str, typer.Option(help="Some of biased, even.")] = "biased,even",
    arms: Annotated[
        str | None,
        typer.Option(help="Policies to compare; +weights draws by weight, pool is all candidates."),
    ] = None,
    percents: Annotated[str, typer.Option(help="K as shares of the pool, comma-separated.")] = "10,25,50",
    seeds: Annotated[int, typer.Option(min=1, help="Pools of each kind.")] = 3,
    draws: Annotated[int, typer.Option(min=1, help="Random subsets of each pool.")] = 3,
    steps: Annotated[int, typer.Option(min=1, help="Of each recovery.")] = 250,
    count: Annotated[int, typer.Option("-n", "--count", min=1, help="Gaussians of the student.")] = 10_000,
    candidates: Annotated[int, typer.Option(min=8, help="Views of a pool; 420 in the city.")] = 160,
    size: SizeOption = 256,
    csv: Annotated[
        Path, typer.Option("-o", "--csv", metavar="FILE", help="Rows go here; those there are not redone.")
    ] = Path("bench_select.csv"),
    cache: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Keep rendered targets, for going on later.")
    ] = None,
) -> None:
    """What views chosen by each policy are worth: equal recovery, unseen views in and out of distribution."""
    from g2ard.bench.select import ARMS, bench_select, summary
    from g2ard.bench.select_stands import Size
    from g2ard.bench.simplify import machine

    trials = bench_select(
        scenes,
        csv,
        pools=[p.strip() for p in pools.split(",")],
        arms=[a.strip() for a in arms.split(",")] if arms else ARMS,
        percents=[_percent(p) for p in percents.split(",")],
        seeds=seeds,
        draws=draws,
        steps=steps,
        size=Size(count, size or 256, candidates),
        cache=cache,
        progress=run.progress,
    )
    gains = summary(trials)
    run.console.table(
        f"{machine()}; dB over mean random (random: PSNR), ± over pools; in and out of distribution",
        ["scene", "pool", "K %", "arm", "in", "±", "out", "±"],
        [_gain(row) for row in gains],
    )
    run.result({"machine": machine(), "gains": gains, "rows": [asdict(trial) for trial in trials]})


def _percent(text: str) -> float:
    try:
        value = float(text.strip().rstrip("%"))
    except ValueError:
        value = 0.0
    if not 0 < value <= 100:
        raise typer.BadParameter(f"shares between 0 and 100, not {text!r}")
    return value


def _gain(row: Gains) -> list[str]:
    figures = [f"{row[key]:.2f}" for key in ("in", "noise_in", "out", "noise_out")]
    return [str(row["scene"]), str(row["pool"]), f"{row['percent']:g}", str(row["arm"]), *figures]


@command("recover", parent=bench, example="g2ard bench recover scene.ply --study curves --csv figures.csv")
def recover(
    run: Run,
    scene: Annotated[
        Path, typer.Argument(metavar="SCENE|CLOUD", help="A trained scene, or a coloured cloud.")
    ],
    study: Annotated[
        str,
        typer.Option(help="curves, regularizers, rounds, multiplier, endurance or paper."),
    ] = "curves",
    ratios: Annotated[str, typer.Option(help="Comma-separated.")] = "10",
    views: ViewsOption = None,
    held_out: Annotated[
        Path | None,
        typer.Option(metavar="VIEWS", help="Score on these; --views is then all for recovery."),
    ] = None,
    photos: Annotated[
        bool | None,
        typer.Option("--photos/--renders", help="Targets; photos for a cloud, else the scene's renders."),
    ] = None,
    steps: Annotated[str, typer.Option(help="Horizons of the default schedule.")] = "100,300,1000",
    time_limit: TimeLimitOption = None,
    seeds: Annotated[str, typer.Option(help="Comma-separated.")] = "0",
    variants: Annotated[str | None, typer.Option(help="Some of the study's; all if not given.")] = None,
    csv: Annotated[
        Path, typer.Option("-o", "--csv", metavar="FILE", help="Rows go here; whole runs are not redone.")
    ] = Path("bench_recover.csv"),
    size: SizeOption = None,
    background: BackgroundOption = None,
) -> None:
    """Recovery on unseen views against seconds.

    curves: the default's horizons beside the paper's schedule at a tenth, with and without a decay.
    paper: beside all of it. regularizers: with and without each. rounds: against one shot in equal time
    (--time-limit). multiplier: of the rates. endurance: 5,000 steps.
    """
    from g2ard.bench.recover import RecoverBench, bench_recover
    from g2ard.bench.simplify import machine
    from g2ard.bench.speedup import speedups
    from g2ard.cli.options import parse_ratio

    colour = background or (0.0, 0.0, 0.0)
    looks = bench_recover(
        RecoverBench(scene, views, held_out, photos, size, colour),
        study,
        csv,
        ratios=[parse_ratio(part) for part in ratios.split(",")],
        seeds=_whole_numbers("seeds", seeds),
        steps=_whole_numbers("steps", steps),
        seconds=time_limit or 30.0,
        variants=[part.strip() for part in variants.split(",")] if variants else None,
        progress=run.progress,
    )
    columns = ["scene", "ratio", "variant", "seed", "steps", "seconds", "CPU s", "PSNR", "SSIM"]
    run.console.table(
        f"{machine()}; unseen views at the end of each run",
        [*columns, "Drift95", "needles", "rank p1", "regularisers"],
        [_result(look) for look in looks if look.final],
    )
    faster = speedups(looks)
    if faster:
        run.console.table(
            "The default's seconds to the other's PSNR",
            ["scene", "ratio", "against", "PSNR", "seconds", "default's", "share"],
            [
                [
                    s.scene,
                    f"{s.ratio:g}",
                    s.against,
                    f"{s.psnr:.2f}",
                    f"{s.seconds:.1f}",
                    "never" if s.reached_s is None else f"{s.reached_s:.1f}",
                    "–" if s.share is None else f"{s.share:.3f}",
                ]
                for s in faster
            ],
        )
    run.result(
        {
            "machine": machine(),
            "rows": [asdict(look) for look in looks],
            "speedups": [{**asdict(s), "share": s.share} for s in faster],
        }
    )


def _whole_numbers(name: str, text: str) -> list[int]:
    try:
        values = [int(part) for part in text.split(",")]
    except ValueError:
        values = []
    if not values or min(values) < 0:
        raise typer.BadParameter(f"--{name}: whole numbers such as 1,2,3, not {text!r}")
    return values


def _result(look: Look) -> list[str]:
    assert look.drift95 is not None
    assert look.reg_share is not None
    return [
        look.scene,
        f"{look.ratio:g}",
        look.variant,
        str(look.seed),
        str(look.step),
        f"{look.seconds:.1f}",
        f"{look.cpu_s:.1f}",
        f"{look.psnr:.2f}",
        f"{look.ssim:.4f}",
        f"{look.drift95:.2f}",
        f"{look.needle:.3%}",
        f"{look.rank_p1:.3f}",
        f"{look.reg_share:.2%}",
    ]
