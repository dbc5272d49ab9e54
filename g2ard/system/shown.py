"""One line and a picture of scenes, views and results, for notebooks."""

from __future__ import annotations

from importlib import import_module


class Shown:
    """Base of classes that a notebook shows with a picture.

    Pictures need renders and views, which layers above make, so that they are looked up when one is shown.
    """

    def _repr_html_(self) -> str:
        html: str = import_module("g2ard.jobs.notebook").html_of(self)
        return html
