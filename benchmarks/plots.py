"""Draw docs/plots/*.svg from the recorded CSVs: `python -m benchmarks.plots` in the repository's root.

tests/test_docs.py checks that the plots are up to date.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable
from pathlib import Path

from g2ard.report.charts import Point, draw_chart

ROOT = Path(__file__).resolve().parent.parent
RECORD = ROOT / "benchmarks" / "record"
PEERS = ("splat-transform", "splat-transform-adaptive")
COLORS = ("#3b6fb6", "#d1495b", "#3a8f5c", "#e09f3e", "#7b5ea7", "#5b8e9c", "#8d6b4f")
STYLE = (
    ".grid{stroke:#ddd}.tick,.axis,.name{font:11px sans-serif;fill:#555}.name{fill:#111}"
    ".dot{stroke:#fff;stroke-width:1}.line{fill:none;stroke-width:2}"
)


def rows(path: str) -> list[dict[str, str]]:
    with open(RECORD / path, newline="", encoding="utf-8") as file:
        return [row for row in csv.DictReader(file) if not row.get("error")]


def standalone(svg: str, series: Iterable[str]) -> str:
    """Return a chart as an SVG file with colours, legend and background."""
    names = list(series)
    colors = "".join(f".dot.s{i}{{fill:{c}}}.line.s{i}{{stroke:{c}}}" for i, c in enumerate(COLORS))
    legend = []
    for i, name in enumerate(names):
        x, y = 60 + 165 * (i % 3), 358 + 18 * (i // 3)
        legend.append(f'<rect x="{x}" y="{y - 9}" width="10" height="10" fill="{COLORS[i]}"/>')
        legend.append(f'<text class="name" x="{x + 15}" y="{y}">{name}</text>')
    height = 346 + 18 * ((len(names) + 2) // 3) + 4
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 560 {height}" '
    body = svg.split("<svg ", 1)[1].replace('viewBox="0 0 560 340" ', "", 1)
    start, rest = body.split(">", 1)
    rest = rest.removesuffix("</svg>")
    background = f'<rect width="560" height="{height}" fill="#fff"/>'
    return (
        f"{head}{start}><style>{STYLE}{colors}</style>{background}{rest}{''.join(legend)}</svg>\n"
    )


def lead(kind: str) -> str:
    """Plot the gain of `default` over the better peer by ratio, dB, in one kind of views."""
    recorded = [
        r for r in rows("intel-xeon-2c/simplify-standing-2026-11-22.csv") if r["views_kind"] == kind
    ]
    psnr = {(r["scene"], float(r["ratio"]), r["method"]): float(r["psnr"]) for r in recorded}
    scenes = sorted({scene for scene, _, _ in psnr})
    points = []
    for (scene, ratio, method), value in sorted(psnr.items()):
        peers = [psnr[scene, ratio, peer] for peer in PEERS if (scene, ratio, peer) in psnr]
        if method == "default" and peers:
            points.append(Point(ratio, value - max(peers), scenes.index(scene), text=scene))
    label = f"dB over the better peer, {kind} views"
    return standalone(
        draw_chart(points, x_label="ratio", y_label=label, log=True, joined=True), scenes
    )


def curve(scene: str, variants: tuple[str, ...]) -> str:
    """Plot PSNR on held-out views against seconds of recovery, at 10×, after reaching the final count."""
    recorded = [
        r
        for r in rows("amd-epyc-2c/recover-curves-2026-11-21.csv")
        if r["scene"] == scene
        and float(r["ratio"]) == 10
        and r["variant"] in variants
        and r["count"] == r["budget"]  # rounds pass through larger counts first
    ]
    points = [
        Point(
            float(r["seconds"]),
            float(r["psnr"]),
            variants.index(r["variant"]),
            text=f"{r['step']} steps",
        )
        for r in recorded
    ]
    drawn = draw_chart(
        points, x_label="seconds of recovery", y_label="PSNR, dB", log=True, joined=True
    )
    return standalone(drawn, variants)


def frontier() -> str:
    """Plot PSNR in unseen views of the usual kind against the CPU time of whole commands, for two scenes."""
    names = [
        f"{scene}: {whose}"
        for scene in ("playbot", "guitar")
        for whose in ("g2ard", "splat-transform")
    ]
    points = []
    for row in rows("amd-epyc-2c/frontier-2026-11-28.csv"):
        whose = "splat-transform" if row["method"] == "splat-transform" else "g2ard"
        if row["views_kind"] == "pool" and (name := f"{row['scene']}: {whose}") in names:
            at = Point(
                float(row["cpu_s"]), float(row["psnr"]), names.index(name), text=row["method"]
            )
            points.append(at)
    drawn = draw_chart(points, x_label="CPU seconds", y_label="PSNR, dB", log=True, joined=True)
    return standalone(drawn, names)


def sizes() -> str:
    """Plot PSNR in unseen views of the usual kind against their size, for two scenes."""
    methods = {"splat-transform": "splat-transform", "default": "simplify", "distill": "distill"}
    names = [f"{scene}: {method}" for scene in ("playbot", "guitar") for method in methods.values()]
    points = []
    for row in rows("amd-epyc-2c/sizes-2026-11-28.csv"):
        if row["views_kind"] == "pool" and row["method"] in methods:
            name = f"{row['scene']}: {methods[row['method']]}"
            points.append(
                Point(float(row["scale"]), float(row["psnr"]), names.index(name), text=name)
            )
    drawn = draw_chart(
        points, x_label="size of views / 800 px", y_label="PSNR, dB", log=True, joined=True
    )
    return standalone(drawn, names)


def plots() -> dict[str, str]:
    """Return file names and their contents."""
    return {
        "frontier.svg": frontier(),
        "sizes.svg": sizes(),
        "simplify-pool.svg": lead("pool"),
        "simplify-standing.svg": lead("standing"),
        "recover-guitar.svg": curve(
            "guitar 400px", ("default@300", "default@1000", "default@2000")
        ),
        "recover-playbot.svg": curve(
            "playbot/0_0 800px", ("default@300", "default@1000", "default@3000")
        ),
    }


def main() -> None:
    folder = ROOT / "docs" / "plots"
    folder.mkdir(exist_ok=True)
    for name, svg in plots().items():
        (folder / name).write_text(svg, encoding="utf-8")


if __name__ == "__main__":
    main()
