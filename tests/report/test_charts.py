"""Charts of benchmark reports."""

import numpy as np

from g2ard.report.charts import Point, draw_chart, find_front


def test_pareto_points_are_beaten_by_none() -> None:
    rng = np.random.default_rng(0)
    points = [Point(x, y, 0) for x, y in rng.normal(size=(60, 2)).round(1)]
    expected = {
        (p.x, p.y)
        for p in points
        if not any((q.x <= p.x and q.y >= p.y and (q.x, q.y) != (p.x, p.y)) for q in points)
    }
    assert {(p.x, p.y) for p in find_front(points)} == expected
    assert draw_chart([], x_label="x", y_label="y") == ""
    assert "NaN" not in draw_chart(
        [Point(1, 2, 0)], x_label="x", y_label="y", log=True, joined=True, front=True
    )
