"""Matchers: corresponding pixels of a photo and a render.

A matcher is a function of two (H, W, 3) float images in [0, 1], the photo and the render, that returns two
(M, 2) arrays of pixel coordinates (u, v) whose rows correspond. The origin is the image's corner: the centre
of the first pixel is (½, ½), as in COLMAP and in K.
"""

import importlib
import os
import platform
import sys
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import numpy as np

from g2ard.arrays import Float, Float32, Int
from g2ard.errors import InputError, MissingDependencyError
from g2ard.stages.register.grey import grey_of

Pairs = tuple[Float, Float]
Matcher = Callable[[Float32, Float32], Pairs]

_UPSAMPLED_SIDE = 500
"""Longer side in pixels up to which SIFT upsamples an image, because small images have few features."""

_PYCOLMAP_PLATFORMS = (("linux", "x86_64"), ("darwin", "arm64"), ("win32", "AMD64"))
"""Platforms with pycolmap wheels; there is no source distribution, so the extra omits it elsewhere."""


def matcher_named(name: str, ratio: float, most: int) -> Matcher | None:
    """Return the named matcher; None means direct alignment only.

    Args:
        name: "auto" (SIFT if the extra `register` is installed), "sift", "direct" or "MODULE:FUNCTION".
        ratio: see `Sift`.
        most: see `Sift`.

    Raises:
        InputError: an unknown name, module or function.
        MissingDependencyError: a matcher is requested but pycolmap, which solves for poses, is unavailable.

    >>> matcher_named("direct", 0.85, 4096) is None
    True
    >>> matcher_named("some", 0.85, 4096)
    Traceback (most recent call last):
    g2ard.errors.InputError: matcher: expected auto, sift, direct or MODULE:FUNCTION, got 'some'
    """
    absent = "" if name == "direct" else _explain_unusable()
    if name == "direct" or (name == "auto" and absent):
        return None
    if name not in ("auto", "sift") and not all(name.partition(":")):
        raise InputError(
            f"expected auto, sift, direct or MODULE:FUNCTION, got {name!r}", parameter="matcher"
        )
    if absent:
        raise MissingDependencyError(
            f"poses from matches need pycolmap ({absent})",
            parameter="matcher",
            hint="pip install pycolmap",
        )
    if name in ("auto", "sift"):
        return Sift(ratio, most)
    return _load_plugin(name)


def _explain_unusable() -> str:
    """Return why pycolmap is unavailable, or ""."""
    if sys.modules.get("pycolmap", ...) is None or find_spec("pycolmap") is None:
        where = (sys.platform, platform.machine())
        if where in _PYCOLMAP_PLATFORMS:
            no_wheel = ""
        else:
            no_wheel = f", and has no wheel for {' '.join(where)}"
        return f"pycolmap is not installed{no_wheel}"
    try:
        importlib.import_module("pycolmap")
    except Exception as error:
        return f"pycolmap is installed but cannot be imported: {_describe(error)}"
    return ""


def _load_plugin(name: str) -> Matcher:
    """Load a user's function, also from modules in the working directory."""
    module, _, function = name.partition(":")
    path = list(sys.path)
    sys.path.insert(0, os.getcwd())
    try:
        available = getattr(importlib.import_module(module), function, None)
    except Exception as error:
        raise InputError(f"matcher {name}: cannot import {module}: {_describe(error)}") from error
    finally:
        sys.path[:] = path
    if not callable(available):
        raise InputError(f"matcher {name}: {module} has no function {function}")

    def match(photo: Float32, render: Float32) -> Pairs:
        try:
            pairs = available(photo, render)
        except (Exception, SystemExit) as error:
            raise InputError(f"matcher {name}: {_describe(error)}") from error
        return checked_pairs(f"matcher {name}", pairs, photo.shape, render.shape)

    return match


def _describe(error: BaseException) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())


def _as_array(points: Any) -> Float:
    array = np.asarray(points, np.float64)
    if len(points) == 0:
        return array.reshape(-1, 2)
    return array


def checked_pairs(what: str, pairs: Any, *shapes: tuple[int, ...]) -> Pairs:
    """Validate a matcher's result and return two (M, 2) float64 arrays.

    Pairs outside the images are dropped, and so are further elements such as confidences.

    Raises:
        InputError: another type or shape, values that are not finite, or no pair inside the images.

    >>> checked_pairs("m", ([[1, 2], [9, 1]], [[3, 1], [0, 0]]), (4, 4, 3), (4, 4, 3))[1].tolist()
    [[3.0, 1.0]]
    """
    expected = f"{what}: expected two (M, 2) arrays of pixel coordinates"
    if isinstance(pairs, tuple | list) and len(pairs) > 2:
        pairs = pairs[:2]
    try:
        a, b = (_as_array(points) for points in pairs)
    except (TypeError, ValueError):
        raise InputError(f"{expected}, got {type(pairs).__name__}") from None
    if a.ndim != 2 or a.shape[1:] != (2,) or a.shape != b.shape:
        raise InputError(f"{expected}, got shapes {a.shape} and {b.shape}")
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise InputError(f"{expected}, got values that are not finite")
    within = np.ones(len(a), bool)
    for points, (height, width, *_) in zip((a, b), shapes, strict=True):
        inside = points >= 0
        inside &= points <= [width, height]
        within &= inside.all(1)
    if len(a) and not within.any():
        sizes = " and ".join(f"{width}×{height}" for height, width, *_ in shapes)
        raise InputError(
            f"{expected}, got {len(a)} pairs, none of them within the images ({sizes})"
        )
    return a[within], b[within]


class Sift:
    """RootSIFT by pycolmap on the CPU, matched by `mutual`; features of the current photo are cached.

    Images larger than `_UPSAMPLED_SIDE` pixels are not upsampled: poses are as good, 3.2 times faster.

    Descriptors are bytes of norm 512, so dot products are integers below 2²⁴, exact in float32 in any
    summation order.

    Args:
        ratio: see `mutual`.
        most: maximum features per image; the strongest are kept.
    """

    def __init__(self, ratio: float, most: int) -> None:
        import pycolmap

        pycolmap.logging.minloglevel = 2  # silence the log line per extractor
        options = pycolmap.FeatureExtractionOptions()
        options.use_gpu = False
        options.num_threads = 1
        options.sift.max_num_features = most
        self._extractors = []
        for options.sift.first_octave in (-1, 0):
            self._extractors.append(pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu))
        self._ratio = ratio
        self._kept: tuple[Float32, tuple[Float, Float32]] | None = None

    def __call__(self, photo: Float32, render: Float32) -> Pairs:
        if self._kept is None or self._kept[0] is not photo:
            self._kept = photo, self.features(photo)
        a, of_a = self._kept[1]
        b, of_b = self.features(render)
        i, j = mutual(of_a, of_b, self._ratio)
        return a[i], b[j]

    def features(self, image: Float32) -> tuple[Float, Float32]:
        """Return (M, 2) positions and (M, 128) integer-valued descriptors."""
        grey = np.clip(grey_of(image) * 255 + 0.5, 0, 255).astype(np.uint8)
        doubled, whole = self._extractors
        if max(grey.shape) <= _UPSAMPLED_SIDE:
            extractor = doubled
        else:
            extractor = whole
        keypoints, descriptors = extractor.extract_from_uint8_array(np.ascontiguousarray(grey))
        places = np.array([(point.x, point.y) for point in keypoints], np.float64).reshape(-1, 2)
        return places, descriptors.data.astype(np.float32)


def sift_or_none(ratio: float, most: int) -> Sift | None:
    """Return SIFT if it is available."""
    return None if _explain_unusable() else Sift(ratio, most)


def mutual(a: Float32, b: Float32, ratio: float) -> tuple[Int, Int]:
    """Return mutual nearest rows of `a` and `b` that are nearer than `ratio` times a's second nearest.

    Both are (…, D) integers whose dot products are below 2²⁴.
    """
    if not len(a) or not len(b):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    squares = (a * a).sum(1)[:, None] + (b * b).sum(1)[None, :]
    squares -= 2 * (a @ b.T)
    nearest = squares.argmin(1)
    back = squares.argmin(0)
    rows = np.arange(len(a))
    least = squares[rows, nearest].copy()
    squares[rows, nearest] = np.inf
    good = back[nearest] == rows
    good &= least < ratio**2 * squares.min(1)
    return rows[good], nearest[good]
