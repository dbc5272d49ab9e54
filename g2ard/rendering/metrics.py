"""Scores of float images in [0, 1]: PSNR, PSNR and correlation of gradients, lost detail, SSIM, LPIPS."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import g2ard._core as _core
from g2ard.arrays import Float32, Mask
from g2ard.errors import InputError, require_torch

_Image = NDArray[np.floating[Any]]


def psnr(image: _Image, target: _Image, mask: Mask | None = None) -> float:
    """Return the PSNR, −10·log₁₀ MSE for a peak of 1, at most 100 dB (identical images); NaN for NaN pixels.

    Args:
        image: (H, W, C) in [0, 1].
        target: of the same shape.
        mask: (H, W), True for pixels that count; None means all.

    Raises:
        InputError: shapes that differ.

    >>> round(psnr(np.full((2, 2, 3), 0.5), np.full((2, 2, 3), 0.6)), 4)
    20.0
    """
    if mask is not None:
        image = image[mask][:, None]
        target = target[mask][:, None]
    found = _core.psnr(_as_float32(image), _as_float32(target))
    return float(np.minimum(100.0, found))


def edge_psnr(image: _Image, target: _Image, mask: Mask | None = None) -> float:
    """Return the PSNR of the images' gradients: how well edges, wires and text are kept.

    It is −10·log₁₀ of the mean squared error of the differences between neighbouring pixels, along rows and
    columns, for a peak of 1, at most 100 dB, also if none counts. A smooth error of colour hardly counts, a
    lost line does.

    >>> flat, shifted = np.full((4, 4, 3), 0.4), np.full((4, 4, 3), 0.6)
    >>> line = flat.copy()
    >>> line[:, 2] = 0.6
    >>> edge_psnr(flat, shifted), round(edge_psnr(flat, line), 2)
    (100.0, 18.75)
    """
    count, error, *_ = _core.steps(
        _as_float32(image),
        _as_float32(target),
        _counts(mask),
    )
    if error == 0 or not count:
        return 100.0
    psnr = -10 * np.log10(error / count)
    return float(np.minimum(100.0, psnr))


def detail(image: _Image, target: _Image, mask: Mask | None = None) -> float:
    """Return how much of the target's detail an image has: the correlation of their gradients.

    Gradients are the differences g between neighbouring pixels, as in `edge_psnr`. The result is
    (Σ g·g′ + ε) / √((Σ g² + ε)(Σ g′² + ε)): 1 for the same detail at any contrast or brightness, near 0 for
    blur, noise or lines in another place, below 0 for a negative. PSNR weighs lines and print by their area,
    this by their contrast. ε, the energy of differences of 0.0001, lets two flat images score 1.

    >>> flat = np.full((4, 4, 3), 0.4)
    >>> line, fainter, beside = flat.copy(), flat.copy(), flat.copy()
    >>> line[:, 1], fainter[:, 1], beside[:, 3] = 0.6, 0.5, 0.6
    >>> [round(detail(image, line), 2) for image in (line, fainter, flat, beside)]
    [1.0, 1.0, 0.0, 0.0]
    >>> detail(flat, flat + 0.1)
    1.0
    """
    count, _, own, wanted, common = _core.steps(
        _as_float32(image),
        _as_float32(target),
        _counts(mask),
    )
    least = max(1, count) * _INVISIBLE**2
    energy = (own + least) * (wanted + least)
    return float((common + least) / np.sqrt(energy))


_INVISIBLE = 1e-4
"""Difference between neighbouring pixels that nobody sees: a fortieth of a step of 8 bits."""


def lost_detail(image: _Image, target: _Image, mask: Mask | None = None) -> float:
    """Return how visible the detail is that an image lacks in its worst regions; 1 is just noticeable.

    Detail is local contrast: luminance minus its mean over 9 pixels, divided by that mean (Weber). In regions
    of 32×32 pixels, about a degree of sight, the loss is the contrast of the target's detail less the part
    that the image shows. It is divided by the least difference of contrast that people notice, which grows
    with the contrast itself (Legge and Foley 1980). Flat regions, noise and detail that only the image has do
    not count. The result is exceeded in one region of 100 with visible detail; 0 without such a region.

    >>> stripes = np.tile(np.where(np.arange(64) % 4 < 2, 0.4, 0.5)[:, None], (64, 1, 3))
    >>> flat = np.full_like(stripes, 0.45)
    >>> lost_detail(stripes, stripes), lost_detail(stripes, flat), lost_detail(flat, stripes) > 1
    (0.0, 0.0, True)
    """
    wanted, common = _core.contrasts(
        _as_float32(image),
        _as_float32(target),
        _counts(mask),
    ).T
    contrast = np.sqrt(wanted)
    visible = contrast > _SEEN_CONTRAST
    if not visible.any():
        return 0.0
    contrast = contrast[visible]
    lost = (wanted - common)[visible] / contrast
    lost = np.maximum(lost, 0)
    noticed = _SEEN_CONTRAST * (contrast / _SEEN_CONTRAST) ** _MASKING
    return float(np.quantile(lost / noticed, 0.99))


_SEEN_CONTRAST = 0.015
"""Contrast that is just seen (Weber fraction)."""
_MASKING = 0.7
"""Exponent of its growth over a contrast that is seen."""


def ssim(image: _Image, target: _Image, mask: Mask | None = None) -> float:
    """Return the mean structural similarity: 11×11 Gaussian window, σ 1.5, values in 0–1, as INRIA's.

    Without a mask, pixels beyond the image's edge are black. With one, they have no part, like all pixels
    outside it, so that even a mask of the whole image changes the score near the edge.

    The result is the mean over pixels and channels that count, in [−1, 1]; 1 if none does. Each window's
    weights are multiplied by the mask and divided by their sum.

    >>> black, white, mask = np.zeros((16, 16, 1)), np.ones((16, 16, 1)), np.zeros((16, 16), bool)
    >>> mask[:4, 12:] = True
    >>> round(ssim(black, white, mask), 4)
    0.0001
    >>> round(ssim(np.eye(16)[:, :, None], np.eye(16)[:, :, None]), 6)
    1.0
    """
    return _core.ssim(_as_float32(image), _as_float32(target), _counts(mask))


def _as_float32(image: _Image) -> Float32:
    return np.ascontiguousarray(image, dtype=np.float32)


def _counts(mask: Mask | None) -> Mask | None:
    if mask is None:
        return None
    return np.ascontiguousarray(mask)


class Metric(NamedTuple):
    """A score of images, and its column in tables of means.

    Args:
        measure: function of an image, its target and the (H, W) pixels that count.
        heading: column of tables.
        digits: decimals in tables.
        legend: line under tables, where the heading is not enough.
    """

    measure: Callable[[_Image, _Image, Mask | None], float]
    heading: str
    digits: int
    legend: str = ""


METRICS = {
    "psnr": Metric(psnr, "PSNR", 2, "PSNR in dB"),
    "ssim": Metric(ssim, "SSIM", 4),
    "edge_psnr": Metric(edge_psnr, "edges", 2, "edges: PSNR of the images' gradients, in dB"),
    "detail": Metric(detail, "detail", 2, "detail: their correlation, at most 1"),
}
"""Metrics by the names of their fields in `g2ard.stages.evaluate.Scores`."""


_MEAN = (-0.030, -0.088, -0.188)
"""Mean of LPIPS's normalisation of images in [−1, 1]."""

_STD = (0.458, 0.448, 0.450)
"""Standard deviation of that normalisation."""

_CONV = {
    "alex": {0: (4, 2), 3: (1, 2), 6: (1, 1), 8: (1, 1), 10: (1, 1)},
    "vgg": dict.fromkeys((0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28), (1, 1)),
}
"""Convolutions of torchvision's `features` by index, each followed by a ReLU → (stride, padding)."""

_POOL = {"alex": {2: 3, 5: 3}, "vgg": {4: 2, 9: 2, 16: 2, 23: 2}}
_TAPS = {"alex": (1, 4, 7, 9, 11), "vgg": (3, 8, 15, 22, 29)}
_FILES = {"alex": ("alexnet*.pth", "alex.pth"), "vgg": ("vgg16*.pth", "vgg.pth")}


class Lpips:
    """LPIPS distance by one network: 0 for equal images, about 1 at worst.

    Args:
        net: "alex" or "vgg".
        backbone: torchvision's state dict of the network (features.N.weight, features.N.bias).
        linear: LPIPS's linear layers (linN.model.1.weight, shape (1, C, 1, 1)).
        scaled: map images from [0, 1] to [−1, 1], the range the networks were fitted for. False passes them
            unscaled, as 3DGS's evaluation does (graphdeco-inria/gaussian-splatting#1239). Scores of the two
            are not comparable.

    Raises:
        InputError: missing weights.
    """

    def __init__(
        self,
        net: str,
        backbone: dict[str, Any],
        linear: dict[str, Any],
        *,
        scaled: bool = True,
    ) -> None:
        self.net = net
        self.scaled = scaled
        try:
            self._layers = {}
            for i in _CONV[net]:
                layer = f"features.{i}"
                self._layers[i] = [backbone[f"{layer}.weight"], backbone[f"{layer}.bias"]]
            self._linear = [linear[f"lin{i}.model.1.weight"].reshape(1, -1, 1, 1) for i in range(5)]
        except KeyError as error:
            raise InputError(f"LPIPS {net}: the weights lack {error}") from None

    def __call__(self, image: Float32, target: Float32) -> float:
        """Return the distance of two (H, W, 3) images in [0, 1]."""
        import torch

        with torch.inference_mode():
            total = 0.0
            for a, b, weight in zip(
                self._maps(image), self._maps(target), self._linear, strict=True
            ):
                difference = (_normalize(a) - _normalize(b)) ** 2
                total += float((difference * weight).sum(1).mean())
        return total

    def _maps(self, image: Float32) -> list[Any]:
        import torch
        from torch.nn import functional

        x = torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))[None]
        if self.scaled:
            x = 2 * x - 1
        mean, std = (torch.tensor(v).reshape(1, 3, 1, 1) for v in (_MEAN, _STD))
        x = (x - mean) / std
        taps = []
        for i in range(_TAPS[self.net][-1] + 1):
            if i in self._layers:
                weight, bias = self._layers[i]
                stride, padding = _CONV[self.net][i]
                x = functional.conv2d(x, weight, bias, stride=stride, padding=padding)
            elif i in _POOL[self.net]:
                x = functional.max_pool2d(x, _POOL[self.net][i], stride=2)
            else:
                x = functional.relu(x)
            if i in _TAPS[self.net]:
                taps.append(x)
        return taps


def load_lpips(folder: Path, *, scaled: bool = True) -> dict[str, Lpips]:
    """Load the networks whose weights are in a folder: alexnet*.pth with alex.pth, vgg16*.pth with vgg.pth.

    The first of each pair holds torchvision's ImageNet weights, the second LPIPS's linear layers (v0.1).

    Raises:
        InputError: neither pair is in the folder, or a file is not a state dict.
        MissingDependencyError: torch is not installed.
    """
    require_torch("LPIPS")
    import torch

    out = {}
    for net, (backbone, linear) in _FILES.items():
        weight_files = sorted(folder.glob(backbone))
        if not weight_files or not (folder / linear).is_file():
            continue
        files = []
        for path in (weight_files[0], folder / linear):
            try:
                files.append(torch.load(path, map_location="cpu", weights_only=True))
            except Exception as error:  # torch raises any exception from unpickling
                raise InputError(
                    f"not a torch state dict ({type(error).__name__})", path=path
                ) from None
        out[net] = Lpips(net, files[0], files[1], scaled=scaled)
    if not out:
        raise InputError(
            "no LPIPS weights (alexnet*.pth and alex.pth, or vgg16*.pth and vgg.pth)", path=folder
        )
    return out


def _normalize(x: Any) -> Any:
    """Normalise each pixel's feature vector to unit length."""
    return x / (x.pow(2).sum(1, keepdim=True).sqrt() + 1e-10)
