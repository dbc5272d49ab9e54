"""Regions of interest in reports: the worst part of a view, or a given one, at full resolution."""

import base64
import json
import re
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from g2ard import io
from g2ard.errors import InputError
from g2ard.report.page import Comparison, Page, Shown, worst_windows
from g2ard.report.window import Crop, Window
from helpers.commands import CommandLine, succeeds
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
            mask[window.pixels(60, 80)] += 1
        assert mask.max() == 1
        error = (image.astype(float) ** 2).sum(-1)
        rows, columns = first.pixels(60, 80)
        best = max(
            error[i : i + rows.stop - rows.start, j : j + columns.stop - columns.start].sum()
            for i in range(60 - (rows.stop - rows.start) + 1)
            for j in range(80 - (columns.stop - columns.start) + 1)
        )
        assert error[rows, columns].sum() == best
        assert error[second.pixels(60, 80)].sum() <= best
    assert len(worst_windows(target[:1, :1], target[:1, :1])) == 1  # no room for a second


def test_crops_are_cut_at_full_resolution() -> None:
    rng = np.random.default_rng(0)
    target = np.repeat(np.repeat(rng.integers(0, 255, (75, 100, 3), np.uint8), 20, 0), 20, 1)
    page = Page("A page")
    window = Window(0.1, 0.2, 0.2, 0.2)
    page.comparison(Comparison("a view", target, [Shown("same", target, "9 dB")], [window]))
    html = page.text()
    check_page(html)
    whole, same, *crops = images_of(html)
    assert max(whole.shape) == max(same.shape) == 1280
    assert [crop.shape for crop in crops] == [(300, 400, 3)] * 2
    expected = target[300:600, 200:600].astype(float)
    assert np.abs(crops[0] - expected).mean() < 12  # JPEG
    assert "left:10.00%;top:20.00%;width:20.00%;height:20.00%" in html


@pytest.mark.parametrize(
    "text", ["1,2", "0,0,0,1", "0.9,0,0.2,0.1", "-1,0,.5,.5", "a,b,c,d", "x:", "nan,0,1,1"]
)
def test_invalid_crops_are_named(text: str) -> None:
    with pytest.raises(InputError, match="crop"):
        Crop.parse(text)


def test_command(command_line: CommandLine, tmp_path: Path) -> None:
    io.write_splats(tmp_path / "ball.ply", checkered_ball(600))
    io.write_views(tmp_path / "views.json", around(16, size=(48, 36)))
    common = ["distill", "ball.ply", "-r", "4", "--views", "views.json", "--steps", "5"]
    crops = ["--crop", "view_008:0.25,0.25,0.5,0.5", "--crop", "0,0,0.5,0.25"]
    succeeds(command_line, tmp_path, *common, *crops, "-o", "run")
    html = (tmp_path / "run" / "report.html").read_text()
    check_page(html)
    first, second = html.split('<section class="view">')[1:3]
    assert "<h4>view_008</h4>" in first
    assert first.count('class="roi') == 2
    assert second.count('class="roi') == 1
    assert {(36, 48), (18, 24), (9, 24)} <= {image.shape[:2] for image in images_of(html)}
    assert html.count('<section class="view">') == 3
    status, _, err = command_line(*common, "--crop", "moon:0,0,1,1", "-o", "none", cwd=tmp_path)
    assert (status, "Traceback" in err) == (1, False)
    assert "--crop: expected one of the 2 scored views (view_000, view_008), got moon" in err
    assert not (tmp_path / "none").exists()
    assert command_line(*common, "--crop", "9,9,9,9", "-o", "none", cwd=tmp_path)[0] == 2


def test_the_caption_of_a_crop_names_its_image() -> None:
    page = Page("report", "")
    grey = np.full((60, 80, 3), 128, np.uint8)
    page.comparison(Comparison("view", grey, [Shown("small", grey // 2, "23.40 dB")]))
    text = page.text()
    captions = re.findall(r'class="crop">.*?<figcaption>(.*?)</figcaption>', text)
    assert set(captions) == {"target", "small<br>whole view <b>23.40 dB</b>"}
