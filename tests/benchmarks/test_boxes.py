"""The study of boxes: only skipping faint boxes changes the image, and by a step of 8 bits at most."""

from pathlib import Path

from helpers.studies import ball_of, measured


def test_boxes_are_the_whole_image(tmp_path: Path) -> None:
    rows = measured("boxes", ball_of(tmp_path, 1200), tmp_path / "out", boxes="2,9", views="5")
    assert [(row["boxes"], row["method"]) for row in rows] == [
        (boxes, skipped) for boxes in (2, 9) for skipped in ("nothing", "stopped", "faint")
    ]
    for row in rows:
        assert row["largest_error"] < (1.2 / 255 if row["method"] == "faint" else 1e-6)
        assert 1 <= row["rows_per_gaussian"] < 3
        assert 0 < row["drawn_share"] <= 1
    for nothing, stopped, faint in (rows[:3], rows[3:]):
        assert 1 == nothing["drawn_share"] >= stopped["drawn_share"] >= faint["drawn_share"]
