"""`g2ard evaluate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from g2ard.cli.frame import Run, command
from g2ard.cli.options import BackgroundOption, LookOption, SizeOption, SplitOption, TeacherOption


@command("evaluate", example="g2ard evaluate small.ply --views poses.json --teacher scene.ply --json -")
def evaluate(
    run: Run,
    scenes: Annotated[list[Path], typer.Argument(metavar="SCENE...", help="Scenes to score.")],
    views: LookOption,
    teacher: TeacherOption = None,
    anchors: Annotated[
        Path | None,
        typer.Option(metavar="SCENE", help="The same Gaussians before recovery: adds Drift95 and its kin."),
    ] = None,
    lpips: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Weights of LPIPS; without them it is absent.")
    ] = None,
    split: SplitOption = "test",
    size: SizeOption = None,
    background: BackgroundOption = None,
) -> None:
    """PSNR, SSIM, size and needle share of scenes, against photos or a teacher's renders."""
    from g2ard.cli.scenes import load_scene, load_views, make_targets
    from g2ard.errors import InputError
    from g2ard.evaluate import evaluate as score
    from g2ard.lpips import load_lpips
    from g2ard.recover.anchors import Anchors, drift95, needle

    colour = background or (0.0, 0.0, 0.0)
    dense = load_scene(run, teacher) if teacher else None
    frozen = load_scene(run, anchors) if anchors else None
    targets = make_targets(run, load_views(run, views, split, size), dense, colour)
    networks = load_lpips(lpips) if lpips else None
    rows: list[dict[str, Any]] = []
    for path in scenes:
        splats = load_scene(run, path)
        scored = score(
            splats, targets, background=colour, lpips=networks, progress=run.progress, stage=path.name
        )
        row = {"scene": str(path), **scored.as_dict(), "drift95": None, "needle": needle(splats.scales)}
        row["file_bytes"] = path.stat().st_size if path.is_file() else None
        if frozen is not None:
            if len(frozen) != len(splats):
                raise InputError(f"{anchors}: {len(frozen)} Gaussians, {path} has {len(splats)}")
            row["drift95"] = drift95(Anchors.of(frozen), splats.means)
        rows.append(row)
    run.console.table(
        f"{len(targets.cameras)} views, against {'the teacher' if dense else 'photos'}",
        ["scene", "Gaussians", "MB", "PSNR", "SSIM", "LPIPS", "needle"],
        [
            [
                Path(r["scene"]).name,
                f"{r['count']:,}",
                f"{r['bytes'] / 1e6:.2f}",
                f"{r['psnr']:.2f}",
                f"{r['ssim']:.4f}",
                " ".join(f"{net} {value:.4f}" for net, value in (r["lpips"] or {}).items()) or "–",
                f"{r['needle']:.1%}",
            ]
            for r in rows
        ],
    )
    run.result({"against": "teacher" if dense else "photos", "scenes": rows})
