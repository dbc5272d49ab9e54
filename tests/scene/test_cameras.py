"""`Cameras` rejects views that cannot be drawn, and names the first; for poses see `test_odd_values`."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from g2ard.errors import InputError
from helpers.scenes import around

VIEWS = around(5)


def values(name: str, value: float, *place: int) -> dict[str, np.ndarray]:
    """Return an array of the views with another value at a place, whose first index is the view."""
    array = getattr(VIEWS, name).copy()
    array[place] = value
    return {name: array}


NOT_FINITE, NO_FOCAL = (
    "has a pose or intrinsics that are not finite",
    "has a focal length that is not positive",
)


@pytest.mark.parametrize(
    ("fields", "fault"),
    [
        (values("viewmats", np.nan, 2, 0, 3), NOT_FINITE),
        (values("viewmats", -np.inf, 2, 1, 1), NOT_FINITE),
        (values("Ks", np.nan, 2, 0, 0), NOT_FINITE),
        (values("distortions", np.inf, 2, 4), NOT_FINITE),
        (values("viewmats", -2e12, 2, 0, 3), "above 1e+12"),
        (values("viewmats", 1e200, 2, 0, 0), "above 1e+12"),
        (values("Ks", 2e12, 2, 1, 1), "above 1e+12"),
        (values("widths", 0, 2), f"has an empty image, 0×{VIEWS.heights[2]}"),
        (
            values("widths", 2**62, 2),
            f"has {2**62:,}×{VIEWS.heights[2]} pixels; the limit is 160,000,000",
        ),
        (values("Ks", 0, 2, 0, 0), NO_FOCAL),
        (values("Ks", -50, 2, 1, 1), NO_FOCAL),
        (values("Ks", 0, 2, 0, 0) | values("viewmats", np.nan, 3, 0, 0), NO_FOCAL),
        (values("viewmats", np.nan, 2, 0, 0) | values("widths", 0, 2), NOT_FINITE),
    ],
)
def test_the_first_fault_of_the_first_wrong_view_is_told(
    fields: Mapping[str, Any], fault: str
) -> None:
    with pytest.raises(InputError) as caught:
        replace(VIEWS, **fields)
    assert fault in str(caught.value)
    assert VIEWS.names[2] in str(caught.value)
    assert (caught.value.index, caught.value.item) == (2, "view")


def test_there_may_be_no_views() -> None:
    assert len(VIEWS.take([])) == 0
