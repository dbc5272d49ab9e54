"""`g2ard evaluate`."""

from __future__ import annotations

from collections import Counter
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from g2ard.cli import options as opt
from g2ard.cli.command import command
from g2ard.cli.run import Run
from g2ard.config.choices import BLACK, LpipsInput, Named
from g2ard.errors import InputError
from g2ard.io import Source
from g2ard.report.labels import name_scenes

if TYPE_CHECKING:
    from g2ard.jobs.inputs import Views
    from g2ard.jobs.teaching import Teaching
    from g2ard.rendering.renderer import RasterSettings
    from g2ard.rendering.targets import Targets
    from g2ard.scene.splats import Splats
    from g2ard.stages.evaluate import Evaluation


@command(
    "evaluate",
    example="g2ard evaluate small.ply --views poses.json --teacher scene.ply --json -",
    scenes=True,
)
def evaluate(
    run: Run,
    scenes: Annotated[
        list[Path],
        typer.Argument(
            metavar="SCENE|RUN...",
            help="Scenes to score. A `distill` run brings its held-out views, targets and background.",
        ),
    ],
    views: opt.ViewsOrMadeOption = None,
    images: opt.ImagesOption = None,
    alpha: opt.AlphaOption = "composite",
    teacher: opt.TeacherOption = None,
    photos: opt.PhotosOption = False,
    anchors: Annotated[
        Path | None,
        typer.Option(metavar="SCENE", help="The same Gaussians before recovery; adds Drift95."),
    ] = None,
    lpips: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder with LPIPS weights; adds LPIPS.")
    ] = None,
    lpips_input: Annotated[
        LpipsInput,
        typer.Option(
            help="Scale images to [-1, 1], as LPIPS expects, or feed [0, 1] as 3DGS does."
        ),
    ] = "scaled",
    convention: opt.ConventionOption = "gsplat",
    eight_bit: Annotated[
        bool, typer.Option("--8bit", help="Round renders and targets to 8 bits, as in saved PNGs.")
    ] = False,
    split: opt.SplitOption = "test",
    size: opt.SizeOption = None,
    background: opt.BackgroundOption = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            metavar="FILE.html",
            help="Write a page on results of several sizes: quality against size, pictures, and which "
            "size suffices.",
        ),
    ] = None,
) -> None:
    """Score scenes against photos or a teacher's renders: PSNR, SSIM, edges, needles, overdraw.

    Several runs are scored in one set of views at one size: those that one held out and none trained on.

    Edges is the PSNR of the images' gradients: how well wires, text and outlines are kept.

    For the evaluation of the original 3DGS, use --convention inria --8bit --lpips-input unscaled.
    """
    from g2ard.io.describe import bytes_of
    from g2ard.jobs.comparison import describe_better, find_common
    from g2ard.jobs.inputs import GivenViews, drop_unscorable, load_scene, load_views
    from g2ard.jobs.run_views import find_or_plan_views, keep_larger
    from g2ard.jobs.teaching import Teaching, check_teacher
    from g2ard.jobs.view_checks import check_sight
    from g2ard.rendering.metrics import load_lpips
    from g2ard.rendering.renderer import RasterSettings
    from g2ard.rendering.targets import scored_in
    from g2ard.rendering.visibility import overdraw
    from g2ard.scene.shape import needle_share
    from g2ard.stages.evaluate import evaluate as score

    if lpips_input != "scaled" and lpips is None:
        raise typer.BadParameter("--lpips-input goes with --lpips; give --lpips DIR")
    if output is not None and len(scenes) < 2:
        raise typer.BadParameter("--output compares sizes; give several scenes")
    run.claim_file("--output", output, page=True)
    own = None
    if views is None and teacher is None:
        own = find_common(scenes, background=background is not None)
    if own is not None:
        teacher = own.teacher
        photos = own.photos
        size = size or own.size
    else:
        with run.usage():
            check_teacher(views, teacher)
    given = opt.with_images(views, images, alpha) if own is None else own.views
    sources = [Source(path, run.render_model) for path in scenes]
    for source in sources:
        source.check_scene()
    chosen = opt.background_of(run, background, *scenes)
    settings = RasterSettings(convention=convention)
    colour = chosen or BLACK
    frozen = run.load(anchors) if anchors else None
    dense = None if teacher is None else load_scene(teacher, run.say, run.render_model)
    teaching = Teaching.by(
        dense, colour, chosen=chosen is not None, insisted=photos, settings=settings, say=run.say
    )
    if dense is not None:
        given = find_or_plan_views(
            dense, GivenViews(given, teacher, seed=run.seed, **run.callbacks)
        )
    assert given is not None  # `check_teacher`
    full = load_views(given, split, None, run.say, unpictured=dense is not None)
    fitted = full.fitted(size)
    teaching.propose_background(fitted)
    targets = drop_unscorable(teaching.targets(fitted, run.say), run.say)
    unshrunk = teaching.full_size(keep_larger(full, size))
    cameras = targets.cameras
    networks = load_lpips(lpips, scaled=lpips_input == "scaled") if lpips else None
    rows: list[Named] = []
    found = []
    judged = []
    loaded: list[Splats] = []
    for path, source in zip(scenes, sources, strict=True):
        splats = run.load(source)
        check_sight(splats, cameras, run.say)
        if own is None and not rows:  # photos of a run, or of another scene here, are meant
            teaching.check_photos(splats, cameras)
        alike = partial(
            score,
            splats,
            background=colour,
            lpips=networks,
            settings=settings,
            eight_bit=eight_bit,
            progress=run.progress,
        )
        scored = alike(targets, stage=path.name)
        at_own_size = unshrunk and alike(unshrunk, stage=f"{path.name} unshrunk")
        found.append(scored)
        judged.append(at_own_size or scored)
        if output is not None:
            loaded.append(splats)
        drift = None if frozen is None else _measure_drift(frozen, splats, path)
        rows.append(
            {
                "scene": str(path),
                **scored.as_dict(),
                "own_size": at_own_size and at_own_size.as_dict(),
                "drift95": drift,
                "needle": needle_share(splats.scales),
                "file_bytes": bytes_of(path),
                "overdraw": overdraw(splats, cameras, run.progress),
            }
        )
    protocol = f"{convention}'s conventions, {'8-bit' if eight_bit else 'float'} renders"
    name = "" if split == "all" else split
    _print_table(run, f"{scored_in(targets, name)}; {protocol}", rows)
    names = name_scenes(scenes)
    if unshrunk is not None:
        run.say(_describe_own_size(names, rows))
    better = describe_better(names, found, targets, name)
    if better:
        run.say(better)
    advice = None
    if output is not None:
        results = zip(scenes, loaded, judged, strict=True)
        with run.showing("--output"):
            advice = _write_ladder(
                run,
                output,
                list(results),
                unshrunk or targets,
                dense,
                teacher,
                teaching,
                given,
                settings,
            )
    counts = Counter(view["against"] for view in rows[0]["views"])
    single = {"photo": "photos", "teacher": "teacher"}
    against = counts if len(counts) > 1 else single[next(iter(counts))]
    followed = {
        "convention": convention,
        "8bit": eight_bit,
        "lpips_input": lpips_input if lpips else None,
    }
    told = {
        "against": against,
        "scored_in": scored_in(targets, name),
        "better": better,
        "advice": advice,
    }
    run.result({**told, "protocol": followed, "scenes": rows})


def _write_ladder(
    run: Run,
    output: Path,
    results: list[tuple[Path, Splats, Evaluation]],
    targets: Targets,
    dense: Splats | None,
    teacher: Path | None,
    teaching: Teaching,
    views: Views,
    settings: RasterSettings,
) -> str:
    """Write the page on results of several sizes; print and return which one suffices."""
    from g2ard.io.describe import bytes_of
    from g2ard.jobs.run_views import is_planned
    from g2ard.jobs.viewer_frame import choose_level_views
    from g2ard.poses import best_views
    from g2ard.rendering.targets import Subset, TeacherRenders
    from g2ard.report.ladder import Dense, Rung, label_sizes, recommend_size, write_ladder

    run.begin("page")
    cameras = targets.cameras
    top = None
    if dense is not None and teacher is not None:
        top = Dense(teacher.name, len(dense), bytes_of(teacher))
    names = name_scenes([path for path, _, _ in results])
    words = label_sizes(
        names, [len(splats) for _, splats, _ in results], None if top is None else top.count
    )
    rungs = sorted(
        (
            Rung(name, word, bytes_of(path), splats, scores)
            for (path, splats, scores), name, word in zip(results, names, words, strict=True)
        ),
        key=lambda rung: (rung.bytes, rung.name),
    )
    if dense is not None and not teaching.photos and is_planned(views):
        best = choose_level_views(dense, 1, cameras).resized(
            max(cameras[0].width, cameras[0].height)
        )
        shown: Targets = TeacherRenders(dense, best, background=teaching.background)
    else:
        name = best_views(rungs[-1].splats if dense is None else dense, 1, cameras).names[0]
        shown = Subset(targets, [cameras.names.index(name)])
    title = f"{'photos' if top is None else top.name}: {len(rungs)} sizes"
    write_ladder(
        output,
        title,
        rungs,
        targets,
        shown,
        dense=top,
        background=teaching.background,
        settings=settings,
        overwrite=run.overwrite,
    )
    run.note_written(output)
    advice = recommend_size(rungs)
    run.say(f"{output}: {advice}")
    return advice


def _measure_drift(frozen: Splats, splats: Splats, path: Path) -> float:
    """Return the Drift95 of a scene from the same Gaussians before recovery."""
    from g2ard.stages.recover.anchors import Anchors, drift95

    if len(frozen) != len(splats):
        raise InputError(
            f"expected the {len(splats):,} Gaussians of {path}, got {len(frozen):,}",
            parameter="anchors",
        )
    splats = splats.narrowed()
    return drift95(Anchors.of(frozen.narrowed(splats.offset)), splats.means)


def _describe_own_size(names: list[str], rows: list[Named]) -> str:
    """Describe the scores at the views' own size.

    >>> score = {"psnr": 25.5, "ssim": 0.8, "scored_in": "7 photos, 960×540 px"}
    >>> _describe_own_size(["a"], [{"own_size": score}])
    "at the views' own size (7 photos, 960×540 px): 25.50 dB, SSIM 0.8000"
    """
    scores = [row["own_size"] for row in rows]
    told = [f"{score['psnr']:.2f} dB, SSIM {score['ssim']:.4f}" for score in scores]
    if len(rows) > 1:
        told = [f"{name} {text}" for name, text in zip(names, told, strict=True)]
    return f"at the views' own size ({scores[0]['scored_in']}): {'; '.join(told)}"


def _format_lpips(scores: dict[str, float]) -> str:
    return " ".join(f"{net} {value:.4f}" for net, value in scores.items())


def _print_table(run: Run, title: str, rows: list[Named]) -> None:
    from g2ard.rendering.metrics import METRICS

    columns = {
        "scene": name_scenes([Path(r["scene"]) for r in rows]),
        "Gaussians": [f"{r['count']:,}" for r in rows],
        "MB": [f"{r['file_bytes'] / 1e6:.2f}" for r in rows],
        **{m.heading: [f"{r[name]:.{m.digits}f}" for r in rows] for name, m in METRICS.items()},
        "needles": [f"{r['needle']:.1%}" for r in rows],
        "overdraw": [f"{r['overdraw']:.1f}" for r in rows],
    }
    if all(r["lpips"] for r in rows):
        columns["LPIPS"] = [_format_lpips(row["lpips"]) for row in rows]
    if all(r["drift95"] is not None for r in rows):
        columns["Drift95"] = [f"{r['drift95']:.3g}" for r in rows]
    cells = [list(row) for row in zip(*columns.values(), strict=True)]
    run.console.table(title, list(columns), cells, stdout=run.json != "-")
    further = ["needles: share of long, thin Gaussians", "overdraw: Gaussians blended per pixel"]
    run.say("; ".join([*(m.legend for m in METRICS.values() if m.legend), *further]))
