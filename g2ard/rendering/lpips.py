"""LPIPS (Zhang et al. 2018), version 0.1, with weights supplied by the user; nothing is downloaded."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.errors import InputError, require_torch

_MEAN, _STD = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""LPIPS's normalisation of images in [−1, 1]."""

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
        device: torch's device to compute on.

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
        device: str = "cpu",
    ) -> None:
        self.net, self.scaled, self.device = net, scaled, device
        try:
            self._layers = {
                i: [backbone[f"features.{i}.{name}"].to(device) for name in ("weight", "bias")]
                for i in _CONV[net]
            }
            self._linear = [
                linear[f"lin{i}.model.1.weight"].reshape(1, -1, 1, 1).to(device) for i in range(5)
            ]
        except KeyError as error:
            raise InputError(f"LPIPS {net}: the weights lack {error}") from None

    def __call__(self, image: NDArray[np.float32], target: NDArray[np.float32]) -> float:
        """Return the distance of two (H, W, 3) images in [0, 1]."""
        import torch

        with torch.inference_mode():
            total = 0.0
            for a, b, weight in zip(self._maps(image), self._maps(target), self._linear, strict=True):
                difference = (_unit(a) - _unit(b)) ** 2
                total += float((difference * weight).sum(1).mean())
        return total

    def _maps(self, image: NDArray[np.float32]) -> list[Any]:
        import torch
        from torch.nn import functional

        x = torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))[None].to(self.device)
        x = 2 * x - 1 if self.scaled else x
        mean, std = (torch.tensor(v, device=self.device).reshape(1, 3, 1, 1) for v in (_MEAN, _STD))
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


def load_lpips(folder: Path, *, scaled: bool = True, device: str = "cpu") -> dict[str, Lpips]:
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
                raise InputError(f"not a torch state dict ({type(error).__name__})", path=path) from None
        out[net] = Lpips(net, files[0], files[1], scaled=scaled, device=device)
    if not out:
        raise InputError(
            "no LPIPS weights (alexnet*.pth and alex.pth, or vgg16*.pth and vgg.pth)", path=folder
        )
    return out


def _unit(x: Any) -> Any:
    """Normalise each pixel's feature vector to unit length."""
    return x / (x.pow(2).sum(1, keepdim=True).sqrt() + 1e-10)
