"""The viewer page that `g2ard distill` writes beside its report."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from g2ard.progress import plural

if TYPE_CHECKING:
    from g2ard.scene.cameras import Cameras
    from g2ard.scene.splats import Splats


def run_view(
    path: Path, scene: Path, splats: Splats, cameras: Cameras, background: tuple[float, float, float]
) -> tuple[int | None, str]:
    """Write the page of a run's scene, unless it is too large for smooth rendering in browsers.

    Args:
        path: the .html; an earlier run's is replaced or removed.
        scene: the scene's file, for its name.
        splats: the scene.
        cameras: candidates for the first view.
        background: RGB in [0, 1].

    Returns:
        Size of the page in bytes, None if it was not written, and a line to print.
    """
    from g2ard.jobs.budget import DEVICES
    from g2ard.jobs.viewer_frame import frame_with
    from g2ard.viewer import write_page

    count, most = len(splats), DEVICES["web"]
    if count > most:
        path.unlink(missing_ok=True)
        return None, f"{path} skipped: over {most:,} Gaussians (`g2ard view` writes it anyway)"
    stand = frame_with(splats, cameras)
    shown = [(f"{scene.name}: {plural(count, 'Gaussian')}", stand.of(splats))]
    written = write_page(path, shown, start=stand.start, background=background, overwrite=True)
    return written.bytes, f"view: {path} ({written.bytes / 1e6:.2f} MB)"
