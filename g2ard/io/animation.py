"""Animations: images in order as .gif, .webp or, by ffmpeg, .mp4."""

import itertools
import shutil
import subprocess
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from g2ard.errors import InputError, MissingDependencyError
from g2ard.io.atomic import atomic_output

SUFFIXES = (".gif", ".webp", ".mp4")


def check_animation(path: Path) -> None:
    """Check that an animation of this suffix can be written."""
    if path.suffix.lower() == ".mp4" and shutil.which("ffmpeg") is None:
        raise MissingDependencyError(
            "an .mp4 needs the program ffmpeg", path=path, hint="install it, or write .webp or .gif"
        )


def write_animation(
    path: Path, images: Iterable[NDArray[np.uint8]], *, fps: float = 25, overwrite: bool = False
) -> None:
    """Write images of one size as an endless animation.

    Args:
        path: the file; its suffix decides the format.
        fps: images a second; .gif rounds to hundredths of a second.
    """
    check_animation(path)
    frames = _one_size(path, iter(images))
    with atomic_output(path, overwrite) as temporary:
        if path.suffix.lower() == ".mp4":
            _encode(temporary, frames, fps)
            return
        first, *rest = [Image.fromarray(frame) for frame in frames]
        options: dict[str, Any] = {"duration": 1000 / fps, "loop": 0, "quality": 80, "optimize": True}
        first.save(temporary, save_all=True, append_images=rest, **options)


def _one_size(path: Path, frames: Iterator[NDArray[np.uint8]]) -> Iterator[NDArray[np.uint8]]:
    first = next(frames)
    for frame in itertools.chain([first], frames):
        if frame.shape != first.shape:
            sizes = " and ".join(f"{width}×{height}" for height, width, _ in (first.shape, frame.shape))
            raise InputError(f"views of one size make an animation, got {sizes}", path=path)
        yield np.ascontiguousarray(frame)


def _encode(path: Path, frames: Iterator[NDArray[np.uint8]], fps: float) -> None:
    """Pipe raw frames to ffmpeg; H.264 with 4:2:0 needs even sides, so odd ones lose a pixel."""
    first = next(frames)
    height, width = first.shape[:2]
    command = ["ffmpeg", "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24"]
    command += ["-s", f"{width}x{height}", "-r", f"{fps:g}", "-i", "-"]
    command += ["-vf", "crop=trunc(iw/2)*2:trunc(ih/2)*2", "-pix_fmt", "yuv420p", "-crf", "18", str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdin is not None
        assert process.stderr is not None
        try:
            for frame in itertools.chain([first], frames):
                process.stdin.write(frame.tobytes())
            process.stdin.close()
        except BrokenPipeError:
            pass
        said = process.stderr.read().decode(errors="replace").strip()
    if process.returncode:
        raise InputError(f"ffmpeg failed: {said.splitlines()[-1] if said else process.returncode}", path=path)
