"""The page for the browser that `g2ard distill` puts beside its report."""

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
    """Write the page of a run's scene, unless a browser would not show it smoothly.

    Args:
        path: the .html; what an earlier run left there is replaced, or goes.
        scene: the scene's file, whose name labels it.
        splats: the scene.
        cameras: one of them is the start, see `g2ard.policy.viewer_frame.frame_with`.
        background: RGB in [0, 1].

    Returns:
        Bytes of the page, None if there is none, and what to say of it.
    """
    from g2ard.policy.budget import DEVICES
    from g2ard.policy.viewer_frame import frame_with
    from g2ard.viewer import write_page

    count, most = len(splats), DEVICES["web"]
    if count > most:
        path.unlink(missing_ok=True)
        return None, f"no {path}: over {most:,} Gaussians (`g2ard view` writes one all the same)"
    stand = frame_with(splats, cameras)
    shown = [(f"{scene.name}: {plural(count, 'Gaussian')}", stand.of(splats))]
    written = write_page(path, shown, start=stand.start, background=background, overwrite=True)
    return written.bytes, f"view: {path} ({written.bytes / 1e6:.2f} MB)"
