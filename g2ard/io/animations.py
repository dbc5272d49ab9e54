"""Animations as GIF, WebP or MP4."""

from __future__ import annotations

import itertools
import shutil
import subprocess
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from g2ard.arrays import Bytes
from g2ard.errors import InputError, MissingDependencyError
from g2ard.io.atomic import atomic_output
from g2ard.io.types import Size

ANIMATIONS = (".gif", ".webp", ".mp4")


def check_animation(path: Path) -> None:
    """Check that an animation of this suffix can be written."""
    if path.suffix.lower() == ".mp4" and shutil.which("ffmpeg") is None:
        raise MissingDependencyError(
            "an .mp4 needs the program ffmpeg on PATH",
            path=path,
            hint="install it, or write .webp or .gif",
        )


def write_animation(
    path: Path,
    pictures: Iterable[Bytes],
    *,
    fps: float = 25,
    overwrite: bool = False,
) -> None:
    """Write images of one size as an endless animation in the format of the suffix.

    A .gif rounds their duration to hundredths of a second.
    """
    check_animation(path)
    shown = iter(pictures)
    first = next(shown)
    frames = _check_sizes(path, first.shape, itertools.chain([first], shown))
    with atomic_output(path, overwrite) as temporary:
        if path.suffix.lower() == ".mp4":
            _encode(temporary, (first.shape[1], first.shape[0]), frames, fps)
            return
        image, *rest = [Image.fromarray(frame) for frame in frames]
        options: dict[str, Any] = {
            "duration": 1000 / fps,
            "loop": 0,
            "quality": 80,
            "optimize": True,
        }
        image.save(
            temporary,
            save_all=True,
            append_images=rest,
            **options,
        )


def _check_sizes(
    path: Path,
    shape: tuple[int, ...],
    frames: Iterable[Bytes],
) -> Iterator[Bytes]:
    for frame in frames:
        if frame.shape != shape:
            sizes = f"{shape[1]}×{shape[0]} and {frame.shape[1]}×{frame.shape[0]}"
            raise InputError(f"views of one size make an animation, got {sizes}", path=path)
        yield np.ascontiguousarray(frame)


def _encode(
    path: Path,
    size: Size,
    frames: Iterable[Bytes],
    fps: float,
) -> None:
    """Pipe raw frames to ffmpeg; H.264 with 4:2:0 needs even sides, so odd ones lose a pixel."""
    command = ["ffmpeg", "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24"]
    command += ["-s", f"{size[0]}x{size[1]}", "-r", f"{fps:g}", "-i", "-"]
    command += [
        "-vf",
        "crop=trunc(iw/2)*2:trunc(ih/2)*2",
        "-pix_fmt",
        "yuv420p",
        "-crf",
        "18",
        str(path),
    ]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdin is not None
        assert process.stderr is not None
        try:
            for frame in frames:
                process.stdin.write(frame.tobytes())
            process.stdin.close()
        except BrokenPipeError:
            pass
        said = process.stderr.read().decode(errors="replace").strip()
    if process.returncode:
        raise InputError(
            f"ffmpeg failed: {said.splitlines()[-1] if said else process.returncode}", path=path
        )
