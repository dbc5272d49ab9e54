"""Summary of a `g2ard distill` run: table, warnings, views."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from g2ard.cli.frame import Run
from g2ard.progress import plural

if TYPE_CHECKING:
    from g2ard.jobs.fit import Aim
    from g2ard.scene.splats import Splats

_LOSS, _SSIM_LOSS = 0.05, 0.001
"""Losses against the simplified scene that are reported, in dB and SSIM."""

_FEW = 0.005
"""Share of the scene too small to report."""


def write_table(run: Run, report: dict[str, Any]) -> None:
    """Print counts, sizes and scores of the dense, the simplified and the recovered scene."""
    kinds = [report["scores"]] + ([report["apart"]] if report["apart"] else [])

    def row(name: str, count: int, size: int) -> list[str]:
        figures = []
        for scores in kinds:
            score = scores.get(name)
            figures += [f"{score['psnr']:.2f}", f"{score['ssim']:.4f}"] if score else ["–", "–"]
        return [name, f"{count:,}", f"{size / 1e6:.2f}", f"{size / count:.0f}", *figures]

    given = "start" if run.config.get("scene", "") is None else "dense"  # started from photos alone
    size = report["bytes"]
    seconds = {name: value for name, value in report["seconds"].items() if name != "resumed"}
    times = ", ".join(f"{name} {value:.1f} s" for name, value in seconds.items())
    counts = [len(scores["recovered"]["views"]) for scores in kinds]
    apart = f" and {counts[1]:,} near views" if len(kinds) > 1 else ""
    run.console.table(
        f"{plural(counts[0], 'held-out view')}{apart} against {report['against']}; {times}",
        [
            "scene",
            "Gaussians",
            "MB as .ply",
            "bytes each",
            "PSNR",
            "SSIM",
            *["PSNR near", "SSIM near"][: 2 * (len(kinds) - 1)],
        ],
        [
            row(given, report["input_count"], size["input"]),
            row("simplified", report["output_count"], size["output"]),
            row("recovered", report["output_count"], size["output"]),
        ],
    )


def told(report: dict[str, Any], *, verbose: bool = False) -> list[str]:
    """Return lines on recovery's outcome, losses and unseen parts; `verbose` adds idle regularisers."""
    from g2ard.stages.recover.report import RecoverReport, outcome, unregularized_rounds

    rounds = [[RecoverReport.of(done) for done in entry.get("recover", [])] for entry in report["rounds"]]
    lines = [outcome(one) for entry in rounds for one in entry]
    lines += [unregularized_rounds(rounds)] if verbose else []
    found = [line for line in lines if line is not None]
    for kind, what in (("scores", "held-out views"), ("apart", "near views")):
        if not report[kind]:
            continue
        before, after = (report[kind][name] for name in ("simplified", "recovered"))
        lost_db, lost_ssim = before["psnr"] - after["psnr"], before["ssim"] - after["ssim"]
        if lost_ssim > _SSIM_LOSS and lost_db < 0:  # neither scene is better
            found.append(f"recovery lost {lost_ssim:.3f} SSIM and gained {-lost_db:.2f} dB in {what}")
            continue
        if lost_db > _LOSS or lost_ssim > _SSIM_LOSS:
            how = f"{lost_db:.2f} dB" if lost_db > _LOSS else f"{lost_ssim:.3f} SSIM"
            found.append(
                f"warning: recovery lost {how} in {what}; the simplified scene is better there"
                " (--keep writes it too)"
            )
            continue
        pairs = zip(*(report[kind][name]["views"] for name in ("simplified", "recovered")), strict=True)
        lost = sum(b["psnr"] < a["psnr"] - _LOSS for a, b in pairs)
        if lost:
            found.append(
                f"{lost} of {len(report[kind]['recovered']['views'])} {what} lost PSNR; their mean gained"
            )
    if report["unseen"] and report["unseen"] > _FEW:
        found.append(f"{report['unseen']:.0%} of the scene is in no view: simplified but not recovered")
    return found


def say_views(run: Run, views: dict[str, Any] | None, chosen: bool) -> None:
    """Print the number of unused and selected views, if not all candidates are used."""
    if views is None:
        return
    if views["refused"]:
        count = plural(len(views["refused"]), "view")
        run.say(f"{count} not used: the scene is not in sight, or the camera is inside it")
    if chosen:
        run.say(
            f"views: {len(views['chosen'])} of {views['candidates']} by {views['policy']};"
            f" the rest would have added {100 * views['left_out']:.1f} %"
        )


def say_weight(run: Run, source: Path, output: Path, splats: Splats, *, lifted: Splats | None = None) -> None:
    """Print a hint if the output is larger than its source file, or than the `lifted` points."""
    inputs = [] if lifted is None else [(lifted.nbytes, "the lifted points have")]
    if source.is_file() and source.suffix.lower() != ".json":
        inputs.append((source.stat().st_size, f"{source.name} has"))
    made = output.stat().st_size
    given, what = min(inputs, default=(made + 1, ""))
    if made < given:
        return
    sizes = f"{output}: {made / 1e6:.2f} MB, {what} {given / 1e6:.2f} MB"
    share = splats.shN.nbytes / splats.nbytes
    hint = "packed formats are smaller than .ply"
    if share:
        hint = f"{share:.0%} of it is SH above degree 0 (--set recover.sh_degree=0 removes it)"
    run.say(f"{sizes}: {hint}")


def tell_quality(run: Run, aim: Aim, splats: Splats) -> None:
    """Print the quality of a result with a quality budget; exit with status 3 if it is too low."""
    judgement = aim.judge(splats)
    if judgement is None:
        return
    met, line = judgement
    if not met:
        run.unmet(line)
    run.say(line)
