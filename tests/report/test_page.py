"""Report pages: what the page of a run says."""

import re
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from g2ard.report.distilled import _choose_worst, summarize_run
from g2ard.report.run import RunReport, describe_sizes, list_rows, summarize_by_kind
from g2ard.stages.evaluate import Means, ViewScore
from helpers.commands import CommandLine, succeeds
from helpers.studies import check_page, study


def test_distill_writes_a_report(command_line: CommandLine, tmp_path: Path) -> None:
    study(tmp_path)
    options = ["-r", "4", "--views", "views.json", "--steps", "5", "--size", "32", "-o", "run"]
    succeeds(command_line, tmp_path, "distill", "ball.ply", *options)
    html = (tmp_path / "run" / "report.html").read_text()
    check_page(html)
    assert re.search(
        r'<p class="lead">300 of 1,200 Gaussians reproduce the dense scene at \d+\.\d dB', html
    )
    assert html.index("<table>") < html.index("Worst views")
    worst = [
        float(found)
        for found in re.findall(r"<option[^>]*>result (\S+) dB", html[html.index("Worst") :])
    ]
    assert len(worst) == 3
    assert worst == sorted(worst)
    assert "ball.ply" in html


VIEWS = [
    ViewScore(psnr, 0.9, name=name, kind="near" if "near" in name else "usual")
    for name, psnr in zip(
        ("pose_0", "pose_1", "near_0", "near_1", "near_2"), (38, 30, 29, 25, 27), strict=True
    )
]


def test_pictures_are_the_worst_view_of_each_kind_in_turn() -> None:
    assert [VIEWS[row].name for row in _choose_worst(VIEWS)] == ["near_1", "pose_1", "near_2"]
    assert _choose_worst(VIEWS[:1]) == [0]


def _report(**known: Any) -> RunReport:
    return RunReport(**{field.name: known.get(field.name) for field in fields(RunReport)})


def test_the_verdict_names_the_weakest_kind_of_view() -> None:
    counts = {"input_count": 90, "output_count": 9, "size": "48×36 px"}
    report = _report(**counts, against="renders", kinds=summarize_by_kind(VIEWS, VIEWS))
    told = "9 of 90 Gaussians reproduce the dense scene at 29.8 dB, the mean of 5 held-out views of 48×36 px"
    assert summarize_run(report) == f"{told}; near views are weakest (27.0 dB)."
    assert (
        summarize_run(replace(report, kinds=())) == "9 Gaussians; no held-out view shows the scene."
    )
    of_photos = summarize_run(replace(report, lifted=True, against="photos"))
    assert of_photos.startswith("9 Gaussians from 90 points reproduce the photos at")
    full = Means(26.04, 0.8, 30, 0.9, scored_in="5 photos, 96×72 px")
    told = summarize_run(replace(report, own_size={"recovered": full}))
    assert (
        "at 26.0 dB in 5 photos, 96×72 px, the views' own size; at 29.8 dB, the mean of 5" in told
    )
    sizes = {"simplified": replace(full, psnr=24.5), "recovered": full}
    first, *others = list_rows(replace(report, own_size=sizes))
    assert first[:3] == ["full size", "5", "24.50 → 26.04"]
    assert describe_sizes(replace(report, own_size=sizes)) == f"{report.size} (full size: 96×72 px)"
    assert others == list_rows(report)
    assert list_rows(report)[0][0] == "usual"
