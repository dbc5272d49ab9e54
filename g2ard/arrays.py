"""Names for the types of arrays in annotations; docstrings give the shapes."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Values = NDArray[Any]
"""Numbers of any type."""

Float = NDArray[np.float64]
"""Numbers in double precision: positions, directions, poses, weights."""

Float32 = NDArray[np.float32]
"""Numbers in single precision, as kernels and files take them: the arrays of scenes, and images."""

Mask = NDArray[np.bool_]
"""Whether each row or pixel counts."""

Int = NDArray[np.int64]
"""Counts, and indices of rows."""

Rows = NDArray[np.intp]
"""Indices of rows from numpy's own searches and sorts."""

Bytes = NDArray[np.uint8]
"""Bytes, such as the channels of 8-bit images."""
