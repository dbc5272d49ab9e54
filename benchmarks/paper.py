"""A study as `bench run --preset paper` runs it, and what it then says of itself."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from benchmarks.definition import Definition
from benchmarks.methods import METHODS, MethodSpec
from g2ard.config.presets import PRESETS

__all__ = ["as_in_the_paper", "with_released"]


def as_in_the_paper(study: Definition, released: bool | None = None, row: str | None = None) -> Definition:
    """The study with the paper's method in g2ard's place, at its rates and on its views.

    Every row of the paper's method, whatever it is called, takes the paper's rates; and, unless rows of the
    study state policies of their own, half of the training views by directional selection. Rows of g2ard's
    default method become the paper's, or go where the study has the paper's on that prior. The paper's rows
    come first, for a study's first row is ours. Results have harmonics of degree 3.

    Args:
        study: as it was read.
        released: whether each method's own schedule is run as well; None means that it is.
        row: of the paper's regularisers, trained, lift or noisy, for all its rows; None leaves each its own.
    """
    chosen = any(method.policy is not None for method in study.methods)
    rows = tuple(sorted(_rows(study.methods, chosen), key=lambda method: method.reduce != "paper"))
    if row is not None:
        rows = tuple(replace(m, preset=row) if m.reduce == "paper" else m for m in rows)
    papers = [method.name for method in rows if method.reduce == "paper"]
    others = [method.name for method in rows if method.reduce != "paper" and method.recovers]
    said = f"run with the paper's preset, harmonics of degree 3: {', '.join(papers)} at the paper's rates"
    lines = [said + (", on the views that each row states" if chosen else f", on {_HALF}")]
    if others and not chosen:
        rates = "at the study's own rates in equal steps and seconds, on all training views"
        lines.append(f"{', '.join(others)} {rates}")
    degree = _PAPER["recover.sh_degree"]
    whole = study.narrowed(methods=rows, sh_degree=degree).run_with("preset", *(lines if papers else ()))
    return with_released(whole, released is not False)


def with_released(study: Definition, released: bool) -> Definition:
    """The study with or without each method's own schedule beside equal steps and seconds."""
    if released == study.released:
        return study.run_with("released" if released else "matched")
    lines = [_BESIDE] if released and (study.steps or study.seconds) else []
    return study.narrowed(released=released).run_with("released" if released else "matched", *lines)


_PAPER = PRESETS["paper"]
_HALF = "50 % of the training views by directional selection"
_BESIDE = "rows of equal steps or seconds, for all methods, stand beside each method's released schedule"


def _rows(methods: Sequence[MethodSpec], chosen: bool) -> Iterator[MethodSpec]:
    there = {method.prior for method in methods if method.reduce == "paper"}
    for method in methods:
        if method.reduce == "default":
            if method.prior in there:
                continue
            method = _papers(method)
        if method.reduce == "paper":
            method = replace(method, schedule=_PAPER["recover.schedule"])
            if not chosen:
                policy, k = _PAPER["select.policy"], _PAPER["select.views_count"]
                method = replace(method, policy=policy, k=k)
        yield method


def _papers(own: MethodSpec) -> MethodSpec:
    """The paper's method under what a row of g2ard's states besides."""
    base = METHODS["g2ard-paper"]
    states = ("prior", "policy", "k", "shared_start", "preset", "anchor", "shape", "effective_rank", "period")
    stated = {name: getattr(own, name) for name in states}
    return replace(base, name=own.name.replace("g2ard", base.name, 1), **stated)
