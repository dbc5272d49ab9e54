"""Colours of merged Gaussians, fitted to renders of the dense scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

import g2ard._core as _core
from g2ard.arrays import Float, Float32
from g2ard.progress import Progress, silent
from g2ard.rendering.renderer import RasterSettings, View, arrays_of, centred, settings_for, view_of
from g2ard.scene.cameras import Cameras
from g2ard.scene.samples import take_evenly
from g2ard.scene.splats import SH_C0, Splats
from g2ard.system.threads import in_threads

_VIEWS = 16
"""Largest number of views that colours are fitted to; 32 gain 0.04 dB more."""

_FLOOR = 0.05
"""Share of the mean weight added to every Gaussian's, so that colours hardly seen stay unchanged."""

_DARKNESS = (0.0, 0.0, 0.0)


def recoloured(
    dense: Splats,
    small: Splats,
    views: Cameras,
    progress: Progress = silent,
) -> Splats:
    """Shift the colours of a simplified scene towards those that the dense scene shows in its place.

    With t, A the dense scene's image and opacity, i, B those of the simplified one and w = αT a Gaussian's
    weight in a pixel, its shift is Σ w·(B·t − A·i) / Σ w·A·B. Images are linear in colours and Σ w = B, so
    this step never increases Σ A·B²·|t/A − i/B|², the error of the colours alone: where the simplified scene
    lets light through or covers too much, colours do not make up for it.

    Args:
        dense: rows in an order that depends only on content, because equal depths are drawn in it.
        views: up to 16 of them are rendered, evenly spaced.
    """
    chosen = seen_by(views)
    settings = settings_for(dense.means, antialiased=dense.antialiased)
    dense, cameras = centred(dense, chosen)
    arrays = arrays_of(dense)

    def shown(view: int) -> tuple[Float32, Float32]:
        image, alpha, *_ = _draw(
            _core.Rasterizer(), arrays, view_of(cameras, view, settings), settings
        )
        return image, alpha

    return shifted(small, chosen, shown, settings, progress)


def seen_by(views: Cameras) -> Cameras:
    """Return the views to which colours are fitted."""
    return take_evenly(views, _VIEWS)


def shifted(
    small: Splats,
    views: Cameras,
    shown: Callable[[int], tuple[Float32, Float32]],
    settings: RasterSettings,
    progress: Progress = silent,
) -> Splats:
    """Shift the colours of a simplified scene, see `recoloured`.

    Args:
        shown: view → (H, W, 3) image and (H, W) opacity of the dense scene.
        settings: conventions of both scenes.
    """
    progress("colours", 0, 0)
    drawable, cameras = centred(small, views)
    arrays = arrays_of(drawable)

    def sums(view: int) -> Float:
        image, alpha = shown(view)
        rasterizer = _core.Rasterizer()
        camera = view_of(cameras, view, settings)
        own_image, opacity, *_ = _draw(rasterizer, arrays, camera, settings)
        alpha = alpha[..., None]
        own_alpha = opacity[..., None]
        error = own_alpha * image - alpha * own_image
        weight = np.broadcast_to(alpha * own_alpha, image.shape)
        found = [rasterizer.backward(arrays, np.ascontiguousarray(a))[4] for a in (error, weight)]
        return np.stack(found).astype(np.float64)

    error = weight = np.zeros_like(arrays[4], np.float64)
    for found in in_threads(sums, range(len(views))):
        error = error + found[0]
        weight = weight + found[1]
    shift = error / np.maximum(weight + _FLOOR * weight.mean(), np.finfo(np.float64).tiny)
    return replace(small, sh0=(small.sh0 + shift / SH_C0).astype(np.float32))


def _draw(
    rasterizer: _core.Rasterizer,
    arrays: Any,
    camera: View,
    settings: RasterSettings,
) -> Any:
    return rasterizer.forward(arrays, camera, settings, list(_DARKNESS))
