"""`g2ard view`: scenes → an HTML page with a viewer."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import typer

from g2ard.cli import options as opt
from g2ard.cli.command import command
from g2ard.cli.run import Run
from g2ard.io import Source
from g2ard.report.labels import label_scenes

_LARGEST_DENSE = 2_000_000
"""Largest dense scene that is shown beside a run's result."""


@command(
    "view", example="g2ard view dense.ply run/ -o compare.html", scenes=True, without=("seed",)
)
def view(
    run: Run,
    scene: Annotated[
        Path,
        typer.Argument(
            metavar="SCENE|RUN|LEVELS",
            help="A scene, the folder of a `distill` run (right of its dense scene), or levels of `lod`.",
        ),
    ],
    other: Annotated[
        Path | None,
        typer.Argument(
            metavar="[SCENE|RUN]",
            help="Second scene, right of a divider; dense scenes stay left.",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            metavar="FILE.html",
            help="Write the page here, instead of opening the browser.",
        ),
    ] = None,
    views: opt.ViewsOrMadeOption = None,
    images: opt.ImagesOption = None,
    start: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="View to open with; by default the one that shows most."),
    ] = None,
    background: opt.BackgroundOption = None,
    up: opt.UpOption = None,
) -> None:
    """Show one scene, or compare two, in the browser; -o writes an HTML page.

    Without -o, the page is served to this machine alone (127.0.0.1) until Ctrl-C.
    """
    if output is not None:
        _write(run, scene, other, output, views, images, start, background, up)
        return
    if _is_levels(scene):
        if other is not None:
            raise typer.BadParameter(f"{scene}: levels of detail cannot be compared")
        run.refuse_typed("on levels of detail", "views", "images", "start", "background", "up")
        _show(run, scene, "index.html")
        return
    with TemporaryDirectory(prefix="g2ard-") as folder:
        page = Path(folder) / "view.html"
        _write(run, scene, other or _find_dense(scene), page, views, images, start, background, up)
        _show(run, page.parent, page.name)


def _is_levels(path: Path) -> bool:
    """Return whether a folder holds levels of detail with their page."""
    levels = ("lod-meta.json", "tileset.json")
    return (path / "index.html").is_file() and any((path / name).is_file() for name in levels)


def _find_dense(path: Path) -> Path | None:
    """Return the scene that a run was made of, if it is there and browsers can show it."""
    from g2ard.jobs.comparison import find_source

    dense = find_source(path)
    if dense is None or not dense.is_file():
        return None
    return dense if Source(dense).count <= _LARGEST_DENSE else None


def _write(
    run: Run,
    scene: Path,
    other: Path | None,
    output: Path,
    given: Any,
    images: Path | None,
    start: str | None,
    background: opt.Triple | None,
    up: opt.Triple | None,
) -> None:
    """Write the page of one scene or two."""
    from g2ard.io import read_views
    from g2ard.jobs.comparison import is_made_of_points, put_dense_first
    from g2ard.jobs.inputs import GivenViews
    from g2ard.jobs.viewer_frame import choose_backdrop, choose_frame

    views = opt.with_images(given, images)
    run.claim_file("--output", output, page=True)
    shown, roles = ([scene], ()) if other is None else put_dense_first(scene, other)
    sources = [Source(path, run.render_model) for path in shown]
    loaded = [run.load(source) for source in sources]
    if views is None and scene.is_dir() and (own := scene / "views.json").is_file():
        # generated ones show what trains
        views = own if any(read_views(own).image_paths) else "made"
    stand = choose_frame(loaded[0], GivenViews(views, sources[0].file, up, say=run.say), start)
    labels = label_scenes(sources, [len(splats) for splats in loaded], roles)
    known = opt.background_of(run, background, scene, other)
    opened = sources[shown.index(scene)]
    run.begin("page")
    written, scene_sizes = stand.write_page(
        output,
        labels,
        loaded,
        background=choose_backdrop(known, loaded, of_points=is_made_of_points(scene, opened)),
        overwrite=run.overwrite,
        progress=run.progress,
    )
    run.note_written(output)
    sizes = " and ".join(f"{size / 1e6:.2f}" for size in scene_sizes)
    run.say(f"{output}: {' | '.join(labels)}; {sizes} MB as SOG, {written / 1e6:.2f} MB in all")
    run.result(
        {
            "output": str(output),
            "bytes": written,
            "scenes": [
                {"scene": str(source.file), "count": len(splats), "bytes": size}
                for source, splats, size in zip(sources, loaded, scene_sizes, strict=True)
            ],
            "start": stand.name,
            "up": stand.up.tolist(),
        }
    )


def _show(run: Run, folder: Path, page: str) -> None:
    """Open a page of a folder in the browser, and serve the folder to this machine alone until Ctrl-C."""
    import webbrowser
    from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
    from threading import Event, Thread

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, format: str, *args: Any) -> None:
            """Log nothing."""

    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder))) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_address[1]}/{page}"
        run.console.close()
        run.answer(f"{address} (Ctrl-C ends)")
        try:
            webbrowser.open(address)
            Event().wait()
        except KeyboardInterrupt:
            run.say("stopped")
        finally:
            server.shutdown()
