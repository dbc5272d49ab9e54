"""g2ard: distil a dense 3D Gaussian scene into a compact, standard 3DGS model at an exact budget."""

from __future__ import annotations

__version__ = "0.1.0"
