"""Scatter and line charts as SVG that follows the report page's light or dark colours."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

COLORS = (
    "#2563eb",
    "#d97706",
    "#059669",
    "#db2777",
    "#7c3aed",
    "#64748b",
    "#0891b2",
    "#b91c1c",
    "#65a30d",
)
_WIDTH = 560
"""Width of a chart in pixels."""
_HEIGHT = 340
"""Height of a chart in pixels."""
_LEFT = 54
"""Margin left of the axes in pixels."""
_RIGHT = 14
"""Margin right of the axes in pixels."""
_TOP = 12
"""Margin above the axes in pixels."""
_BOTTOM = 44
"""Margin below the axes in pixels."""


@dataclass(frozen=True)
class Point:
    """A dot of a chart.

    Args:
        x: horizontal value; positive on a logarithmic axis.
        y: vertical value.
        series: index of the colour, from 0.
        mark: 0 for a full dot, 1 for a pale one, 2 for a ring.
        text: tooltip.
        label: text beside the dot, if there is room; "" for none.
    """

    x: float
    y: float
    series: int
    mark: int = 0
    text: str = ""
    label: str = ""


def find_front(points: Sequence[Point]) -> list[Point]:
    """Return the Pareto front, sorted by x.

    >>> [p.x for p in find_front([Point(1, 5, 0), Point(2, 4, 0), Point(3, 9, 0)])]
    [1, 3]
    """
    front: list[Point] = []
    for point in sorted(points, key=lambda p: (p.x, -p.y)):
        if not front or point.y > front[-1].y:
            front.append(point)
    return front


def choose_ticks(low: float, high: float, *, log: bool = False) -> list[float]:
    """Return about six round values between two limits.

    >>> choose_ticks(0, 10), choose_ticks(0.9, 120, log=True)
    ([0, 2, 4, 6, 8, 10], [1, 2, 5, 10, 20, 50, 100])
    """
    if log:
        first = math.floor(math.log10(low))
        last = math.ceil(math.log10(high))
        steps = (1, 2, 5) if last - first <= 4 else (1,)
        ticks = []
        for exponent in range(first, last + 1):
            values = [step * 10.0**exponent for step in steps]
            ticks += [_round(v) for v in values if low * 0.999 <= v <= high * 1.001]
        return ticks
    raw = (high - low) / 5
    unit = 10.0 ** math.floor(math.log10(raw))
    step = unit * min((1, 2, 2.5, 5, 10), key=lambda m: abs(m * unit - raw))
    first = math.ceil(low / step - 1e-9)
    last = math.floor(high / step + 1e-9)
    return [_round(k * step) for k in range(first, last + 1)]


def _round(value: float) -> float:
    if value == int(value):
        return int(value)
    return round(value, 10)


class _Axis:
    """Map from values to pixels."""

    def __init__(
        self,
        values: Sequence[float],
        start: float,
        end: float,
        *,
        log: bool,
    ) -> None:
        self.log = log
        self._start = start
        self._end = end
        low = min(values)
        high = max(values)
        if log:
            low = low / 1.15
            high = high * 1.15
        else:
            room = 0.06 * (high - low) or 0.5
            low = low - room
            high = high + room
        self.low = low
        self.high = high

    def __call__(self, value: float) -> float:
        low = self.low
        high = self.high
        at = value
        if self.log:
            low = math.log(low)
            high = math.log(high)
            at = math.log(value)
        return self._start + (self._end - self._start) * (at - low) / (high - low)


def draw_chart(
    points: Sequence[Point],
    *,
    x_label: str,
    y_label: str,
    log: bool = False,
    joined: bool = False,
    front: bool = False,
) -> str:
    """Draw a chart.

    Args:
        points: the dots.
        x_label: label of the x axis.
        y_label: label of the y axis.
        log: use a logarithmic x axis.
        joined: connect dots of one series and mark.
        front: draw the Pareto front (left and up is better).

    Returns:
        An <svg> element; "" if there is no point to draw.
    """
    points = [
        p for p in points if math.isfinite(p.y) and math.isfinite(p.x) and (p.x > 0 or not log)
    ]
    if not points:
        return ""
    x = _Axis(
        [p.x for p in points],
        _LEFT,
        _WIDTH - _RIGHT,
        log=log,
    )
    y = _Axis(
        [p.y for p in points],
        _HEIGHT - _BOTTOM,
        _TOP,
        log=False,
    )
    parts = [*_draw_grid(x, y), _draw_captions(x_label, y_label)]
    if front:
        parts.append(_draw_front(find_front(points), x, y))
    if joined:
        parts += _draw_lines(points, x, y)
    parts += [_draw_dot(p, x(p.x), y(p.y)) for p in points]
    parts += _draw_names(points, x, y)
    return (
        f'<svg class="chart" viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" '
        f'aria-label="{escape(y_label)} against {escape(x_label)}">{"".join(parts)}</svg>'
    )


def _draw_grid(x: _Axis, y: _Axis) -> list[str]:
    out = []
    for value in choose_ticks(y.low, y.high):
        at = y(value)
        out.append(
            f'<line class="grid" x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{at:.1f}" y2="{at:.1f}"/>'
        )
        out.append(
            f'<text class="tick" x="{_LEFT - 6}" y="{at + 4:.1f}" text-anchor="end">{value:g}</text>'
        )
    for value in choose_ticks(x.low, x.high, log=x.log):
        at = x(value)
        bottom = _HEIGHT - _BOTTOM
        out.append(f'<line class="grid" x1="{at:.1f}" x2="{at:.1f}" y1="{_TOP}" y2="{bottom}"/>')
        place = f'x="{at:.1f}" y="{bottom + 16}" text-anchor="middle"'
        out.append(f'<text class="tick" {place}>{_abbreviate(value)}</text>')
    return out


def _abbreviate(value: float) -> str:
    """Abbreviate a count or duration: 1500000 → 1.5M."""
    for size, unit in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{value / size:g}{unit}"
    return f"{value:g}"


def _draw_captions(x_label: str, y_label: str) -> str:
    middle = (_LEFT + _WIDTH - _RIGHT) / 2
    up = (_TOP + _HEIGHT - _BOTTOM) / 2
    return (
        f'<text class="axis" x="{middle}" y="{_HEIGHT - 6}" text-anchor="middle">{escape(x_label)}</text>'
        f'<text class="axis" x="14" y="{up}" text-anchor="middle" '
        f'transform="rotate(-90 14 {up})">{escape(y_label)}</text>'
    )


def _draw_front(points: Sequence[Point], x: _Axis, y: _Axis) -> str:
    """Draw the front as a staircase: between two points the left one is still the best."""
    height = y(points[0].y)
    corners = [f"{x(points[0].x):.1f},{height:.1f}"]
    for point in points[1:]:
        across = x(point.x)
        corners.append(f"{across:.1f},{height:.1f}")
        height = y(point.y)
        corners.append(f"{across:.1f},{height:.1f}")
    corners.append(f"{_WIDTH - _RIGHT},{height:.1f}")
    return f'<polyline class="front" points="{" ".join(corners)}"/>'


def _draw_lines(points: Sequence[Point], x: _Axis, y: _Axis) -> list[str]:
    groups: dict[tuple[int, int], list[Point]] = {}
    for point in points:
        groups.setdefault((point.series, point.mark), []).append(point)
    out = []
    for (series, _), members in groups.items():
        members.sort(key=lambda p: p.x)
        path = " ".join(f"{x(p.x):.1f},{y(p.y):.1f}" for p in members)
        out.append(f'<polyline class="line s{series}" points="{path}"/>')
    return out


def _draw_dot(point: Point, x: float, y: float) -> str:
    css = f"dot s{point.series}" + (f" m{point.mark}" if point.mark else "")
    return f'<circle class="{css}" cx="{x:.1f}" cy="{y:.1f}" r="5"><title>{escape(point.text)}</title></circle>'


def _draw_names(points: Sequence[Point], x: _Axis, y: _Axis) -> list[str]:
    """Place labels beside their dots, best first; skip labels that would overlap another."""
    out: list[str] = []
    taken: list[tuple[float, float, float]] = []
    for point in sorted((p for p in points if p.label), key=lambda p: -p.y):
        width = 6.2 * len(point.label)
        left = x(point.x) + 9
        anchor = "start"
        at = left
        if left + width > _WIDTH - _RIGHT:
            anchor = "end"
            at = x(point.x) - 9
            left = at - width
        bottom = y(point.y) - 6
        if any(
            left < right and start < left + width and abs(bottom - b) < 12
            for start, right, b in taken
        ):
            continue
        taken.append((left, left + width, bottom))
        text = escape(point.label)
        out.append(
            f'<text class="name" x="{at:.1f}" y="{bottom:.1f}" text-anchor="{anchor}">{text}</text>'
        )
    return out


def draw_legend(series: Sequence[str], marks: Sequence[str] = ()) -> str:
    """Return the legend of colours (methods), and of marks with their names."""
    items = [
        f'<span><i class="s{i % len(COLORS)}"></i>{escape(name)}</span>'
        for i, name in enumerate(series)
    ]
    items += [f"<span>{escape(mark)}</span>" for mark in marks]
    return f'<p class="legend">{"".join(items)}</p>'


STYLE = (
    """<style>
.legend{color:var(--soft);font-size:13px}
.row{display:flex;flex-wrap:wrap;gap:16px}.row figure{flex:1 1 440px;margin:0;min-width:0;max-width:600px}
.chart{width:100%;height:auto;background:var(--card);border-radius:8px}
.grid{stroke:var(--line)}.tick,.axis,.name{font-size:11px;fill:var(--soft)}.name{fill:var(--fg)}
.dot{fill:var(--c);stroke:var(--bg);stroke-width:1.2}.line{fill:none;stroke:var(--c);stroke-width:2}
.m1{fill-opacity:.4;stroke:var(--c)}.m2{fill:var(--card);stroke:var(--c);stroke-width:2.5}
.front{fill:none;stroke:var(--soft);stroke-dasharray:5 4;stroke-width:1.3}
.legend span{margin-right:16px;white-space:nowrap}
.legend i{display:inline-block;width:11px;height:11px;border-radius:3px;background:var(--c);margin-right:6px}
@media(max-width:600px){.row figure{flex-basis:100%}}
"""
    + "".join(f".s{i}{{--c:{color}}}" for i, color in enumerate(COLORS))
    + "</style>"
)
"""Style of charts and legends on a page; one class per series."""
