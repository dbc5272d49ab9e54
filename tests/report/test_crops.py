"""Crops in reports: the worst parts of a view, at full resolution."""

import base64
import json
import re
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from g2ard.rendering.targets import TeacherRenders
from g2ard.report import distilled
from g2ard.report.page import Page, Shown, pixels, worst_windows
from g2ard.scene.cameras import Cameras
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
        first, second = worst_windows(image, target)
        mask = np.zeros(target.shape[:2], int)
        for window in (first, second):
            mask[pixels(window, 60, 80)] += 1
        assert mask.max() == 1
        error = (image.astype(float) ** 2).sum(-1)
        rows, columns = pixels(first, 60, 80)
        best = max(
            error[i : i + rows.stop - rows.start, j : j + columns.stop - columns.start].sum()
            for i in range(60 - (rows.stop - rows.start) + 1)
            for j in range(80 - (columns.stop - columns.start) + 1)
        )
        assert error[rows, columns].sum() == best
        assert error[pixels(second, 60, 80)].sum() <= best
    assert len(worst_windows(target[:1, :1], target[:1, :1])) == 1  # no room for a second


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
    captions = re.findall(r'class="crop">.*?<figcaption>(.*?)</figcaption>', text)
    assert set(captions) == {"target", "small<br>whole view <b>23.40 dB</b>"}


def test_the_preview_shows_views_with_most_of_the_scene_in_frame(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    ball = checkered_ball(200)
    near, far = (around(3, (32, 24), distance) for distance in (1.2, 4.0))
    cameras = Cameras.of(
        replace(camera, name=f"{name}_{i}")
        for i, pair in enumerate(zip(near, far, strict=True))
        for name, camera in zip(("near", "far"), pair, strict=True)
    )
    labels: list[str] = []
    monkeypatch.setattr(
        distilled, "contact_sheet", lambda rows, _, row_labels: labels.extend(row_labels) or rows[0][0]
    )
    distilled.preview(tmp_path / "preview.png", TeacherRenders(ball, cameras), [("ball", ball)])
    assert [label.split(",")[0] for label in labels] == ["far_0", "far_1", "far_2"]
