"""Contact sheets hold their images."""

import numpy as np
import pytest

from g2ard.errors import InputError
from g2ard.io.images import to_bytes
from g2ard.report.sheet import draw_contact_sheet


def test_contact_sheet_holds_its_images() -> None:
    rng = np.random.default_rng(0)
    rows = [[rng.random((20, 30, 3)) for _ in range(3)], [rng.random((10, 30, 3))]]
    labels = ["photo", "simplified", "recovered"]
    sheet = draw_contact_sheet(rows, labels, row_labels=["one", "two"])
    assert sheet.dtype == np.uint8
    for image in (*rows[0], *rows[1]):
        windows = np.lib.stride_tricks.sliding_window_view(sheet, image.shape)[:, :, 0]
        assert (windows == to_bytes(image)).all((2, 3, 4)).sum() == 1
    assert draw_contact_sheet(rows, labels).shape[0] < sheet.shape[0]
    with pytest.raises(InputError, match="needs images"):
        draw_contact_sheet([], ["photo"])
