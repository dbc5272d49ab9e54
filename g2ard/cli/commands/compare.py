"""`g2ard compare`: how far a scene is from another."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from g2ard.cli import options as opt
from g2ard.cli.command import command
from g2ard.cli.run import Run
from g2ard.config.choices import BLACK, Colour, is_given
from g2ard.io import Source
from g2ard.io.paths import real_path
from g2ard.progress import plural
from g2ard.report.labels import label_scenes, name_scenes

if TYPE_CHECKING:
    from g2ard.scene.splats import Splats

_WORST_VIEWS = 3
"""Views that the table names."""


@command("compare", example="g2ard compare dense.ply small.ply -o compare.html", scenes=True)
def compare(
    run: Run,
    first: Annotated[
        Path, typer.Argument(metavar="SCENE|RUN", help="The dense scene, or another one.")
    ],
    second: Annotated[
        Path, typer.Argument(metavar="SCENE|RUN", help="The scene to compare with it.")
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            metavar="FILE.html",
            help="Write a page with a divider: a typical view, then the worst ones.",
        ),
    ] = None,
    views: opt.ViewsOrMadeOption = None,
    images: opt.ImagesOption = None,
    looks: Annotated[int, typer.Option("-k", min=1, metavar="K", help="Views to generate.")] = 24,
    size: opt.ShapeOption = None,
    background: opt.BackgroundOption = None,
) -> None:
    """Compare renders of two scenes: PSNR, SSIM, the worst views, and a page to look at."""
    from g2ard.jobs.comparison import is_made_of_points, put_dense_first
    from g2ard.jobs.inputs import GivenViews, load_views
    from g2ard.jobs.run_views import choose_plan_size, find_or_plan_views, is_planned, resize_views
    from g2ard.jobs.view_checks import check_sight, sample_opaque_points
    from g2ard.jobs.viewer_frame import (
        choose_backdrop,
        choose_level_views,
        find_shared_up,
        place_frame,
    )
    from g2ard.rendering.targets import TeacherRenders
    from g2ard.scene.cameras import Cameras
    from g2ard.stages.evaluate import evaluate

    if is_given(views):
        run.refuse_typed("on given views", "looks")
    (first, second), roles = put_dense_first(first, second)
    sources = [Source(path, run.render_model) for path in (first, second)]
    run.claim_file("--output", output, page=True)
    dense, other = (run.load(source) for source in sources)
    known = opt.background_of(run, background, first, second)
    colour = known or BLACK
    given = opt.with_images(views, images)
    found = find_or_plan_views(
        dense,
        GivenViews(given, sources[0].file, None, run.seed, choose_plan_size(size), **run.callbacks),
        count=looks,
    )
    cameras = resize_views(load_views(found, "all", None, run.say), size, made=is_planned(found))
    check_sight(dense, cameras, run.say)
    targets = TeacherRenders(dense, cameras, background=colour, progress=run.progress)
    scores = evaluate(other, targets, background=colour, progress=run.progress)
    worst = sorted(scores.views, key=lambda view: view.psnr)[:_WORST_VIEWS]
    psnr = {view.name: view.psnr for view in scores.views}
    run.console.table(
        f"{second} against {first}: {plural(len(cameras), 'view')}, {cameras.size_text}",
        ["", "Gaussians", "PSNR, dB", "SSIM"],
        [
            [
                "mean",
                f"{len(other):,} of {len(dense):,}",
                f"{scores.psnr:.2f}",
                f"{scores.ssim:.4f}",
            ],
            *([f"worst: {v.name}", "", f"{v.psnr:.2f}", f"{v.ssim:.4f}"] for v in worst),
        ],
        stdout=run.json != "-",
    )
    if output is not None:
        with run.showing("--output"):
            points = sample_opaque_points(dense)
            if is_planned(found):  # generated views may show only parts
                best = resize_views(
                    choose_level_views(dense, 1, cameras, choose_plan_size(size)), size, made=True
                )
                renders = TeacherRenders(dense, best, background=colour)
                psnr[best.names[0]] = evaluate(other, renders, background=colour).psnr
                axis = find_shared_up(cameras)
                stand = place_frame(dense, best, None if axis is None else axis.tolist())
                cameras = Cameras.of([*cameras, *best])
            else:
                stand = place_frame(dense, cameras)
            shown = {"typical": str(stand.name)}
            for number, view in enumerate(worst, 1):
                shown[f"worst {number}"] = view.name
            stops = []
            for what, name in shown.items():
                camera = cameras[cameras.names.index(name)]
                stops.append(
                    (f"{what}: {name}, {psnr[name]:.1f} dB", stand.start_at(camera, points))
                )
            labels = label_scenes(sources, [len(dense), len(other)], roles)
            scenes = [dense, other]
            stand.write_page(
                output,
                labels,
                scenes,
                stops=stops,
                background=choose_backdrop(
                    known, scenes, of_points=is_made_of_points(first, sources[0])
                ),
                overwrite=run.overwrite,
                progress=run.progress,
            )
            run.note_written(output)
            run.say(f"{output}: opens at {stand.name}; the arrows below lead to the worst views")
    closer = _name_closer(run, first, second, dense, other, colour)
    if closer is not None:
        run.say(closer)
    run.result(
        {**scores.as_dict(), "closer": closer, "output": None if output is None else str(output)}
    )


def _name_closer(
    run: Run, first: Path, second: Path, dense: Splats, other: Splats, colour: Colour
) -> str | None:
    """Say which of two results is closer to the scene that both show; None if one is that scene.

    Only runs know what they were made of.
    """
    from g2ard.errors import InputError
    from g2ard.jobs.comparison import describe_better, find_common, find_source, is_run
    from g2ard.jobs.inputs import drop_unscorable, load_scene, load_views
    from g2ard.jobs.teaching import Teaching
    from g2ard.stages.evaluate import evaluate

    if real_path(first) == find_source(second) or real_path(second) == find_source(first):
        return None
    if not (is_run(first) and is_run(second)):
        both = f"{first} {second}"
        return f"to see which is closer to their dense scene: g2ard evaluate {both} --teacher DENSE"
    try:
        common = find_common([first, second], background=True)
    except InputError as error:
        return f"cannot say which is closer to their dense scene: {error}"
    assert common is not None
    source = None if common.teacher is None else load_scene(common.teacher, run.say)
    teaching = Teaching.by(source, colour, chosen=True, insisted=common.photos, say=run.say)
    cameras = load_views(common.views, "test", common.size, unpictured=source is not None)
    teaching.propose_background(cameras)
    targets = drop_unscorable(teaching.targets(cameras, run.say))
    scores = [
        evaluate(splats, targets, background=colour, progress=run.progress)
        for splats in (dense, other)
    ]
    line = describe_better(name_scenes([first, second]), scores, targets, "test")
    targets_of = "the photos" if common.teacher is None else str(common.teacher)
    return f"against {targets_of}, {line}"
