"""Crops in reports: the worst parts of a view, at full resolution."""

import base64
import json
import re
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from g2ard.io.images import to_bytes
from g2ard.rendering.targets import TeacherRenders
from g2ard.report import distilled
from g2ard.report.page import Page, Shown, find_worst_windows, slice_window
from g2ard.report.sheet import draw_contact_sheet
from g2ard.stages.evaluate import evaluate
from helpers.scenes import around, checkered_ball
from helpers.studies import check_page


def images_of(html: str) -> list[np.ndarray]:
    found = re.search(r'id="images">(.*?)</script>', html)
    pictures = [Image.open(BytesIO(base64.b64decode(text))) for text in json.loads(found[1])]
    return [np.asarray(picture) for picture in pictures]


def test_worst_windows_hold_the_error_and_do_not_overlap() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        target = np.zeros((60, 80, 3), np.uint8)
        image = rng.integers(0, 255, target.shape, np.uint8)
        first, second = find_worst_windows(image, target)
        mask = np.zeros(target.shape[:2], int)
        for window in (first, second):
            mask[slice_window(window, 60, 80)] += 1
        assert mask.max() == 1
        error = (image.astype(float) ** 2).sum(-1)
        rows, columns = slice_window(first, 60, 80)
        best = max(
            error[i : i + rows.stop - rows.start, j : j + columns.stop - columns.start].sum()
            for i in range(60 - (rows.stop - rows.start) + 1)
            for j in range(80 - (columns.stop - columns.start) + 1)
        )
        assert error[rows, columns].sum() == best
        assert error[slice_window(second, 60, 80)].sum() <= best
    assert len(find_worst_windows(target[:1, :1], target[:1, :1])) == 1  # no room for a second


def test_crops_are_cut_at_full_resolution() -> None:
    rng = np.random.default_rng(0)
    target = np.repeat(np.repeat(rng.integers(0, 255, (75, 100, 3), np.uint8), 20, 0), 20, 1)
    wrong = target.copy()
    wrong[300:720, 200:760] = 255 - target[300:720, 200:760]  # a window's size: 28 % of each side
    page = Page("A page")
    page.comparison("a view", target, [Shown("wrong", wrong, "9 dB")])
    html = page.text()
    check_page(html)
    whole, over, *crops = images_of(html)
    assert max(whole.shape) == max(over.shape) == 1280
    assert [crop.shape for crop in crops] == [(420, 560, 3)] * 4
    for crop, image in zip(crops, (target, wrong), strict=False):
        assert np.abs(crop - image[300:720, 200:760].astype(float)).mean() < 12  # JPEG
    assert "left:10.00%;top:20.00%;width:28.00%;height:28.00%" in html


def test_the_caption_of_a_crop_names_its_image() -> None:
    page = Page("report", "")
    grey = np.full((60, 80, 3), 128, np.uint8)
    page.comparison("view", grey, [Shown("small", grey // 2, "23.40 dB")])
    text = page.text()
    captions = re.findall(r'class="crop"[^>]*>.*?<figcaption>(.*?)</figcaption>', text)
    assert set(captions) == {"target", "small"}


def test_the_preview_has_the_scores_of_the_table_and_greys_what_is_not_scored(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    ball, cameras = checkered_ball(200), around(2, (32, 24))
    shown: list[Any] = []
    monkeypatch.setattr(
        distilled,
        "draw_contact_sheet",
        lambda rows, _, row_labels: shown.extend([rows, row_labels]) or rows[0][0],
    )
    mask = np.zeros((24, 32), bool)
    mask[6:18, 8:24] = True
    targets = TeacherRenders(ball, cameras)
    monkeypatch.setattr(targets, "mask", lambda view: mask, raising=False)
    half = ball.take(range(100))
    scenes = [("half", half)]
    renderers = distilled.create_renderers(scenes)
    drawn = [distilled.draw_pictures(targets, view, renderers) for view in range(2)]
    distilled.write_preview(tmp_path / "preview.png", drawn, scenes)
    rows, captions = shown
    table = evaluate(half, targets)
    assert captions == [f"{view.name}, half {view.psnr:.2f} dB" for view in table.views]
    for image in (image for row in rows for image in row):
        assert image.shape == (19 * 24, 19 * 32, 3)  # two make more than 1,200 pixels
        assert (image[::19, ::19][~mask] == 128).all()
    np.testing.assert_array_equal(rows[1][0][::19, ::19][mask], to_bytes(targets[1][mask]))


@pytest.mark.parametrize("width", [20, 60, 400])
def test_words_of_a_sheet_have_room(width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    written: list[tuple[float, float]] = []

    def text(self: Any, place: tuple[float, float], words: str, *, font: Any, **_: Any) -> None:
        written.append((place[0], place[0] + font.getlength(words)))

    monkeypatch.setattr("PIL.ImageDraw.ImageDraw.text", text)
    rows = [[np.zeros((30, width, 3), np.uint8)] * 3] * 2
    labels = ["target", "simplified: 50,000 Gaussians", "result: 50,000 Gaussians"]
    sheet = draw_contact_sheet(
        rows, labels, row_labels=["0027.jpg, simplified 24.32 dB, result 34.61 dB"] * 2
    )
    assert len(written) == 5
    assert all(end <= sheet.shape[1] for _, end in written)
    ends = [0.0, *(end for _, end in written[:3])]
    assert all(end <= start for end, (start, _) in zip(ends, written[:3], strict=False))
