"""One line and a picture of scenes, views and results, for notebooks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar


class Shown:
    """Base of classes that a notebook shows with a picture.

    Pictures need renders and views of layers above, so that `g2ard/__init__.py` says how they are made.
    """

    _html_of: ClassVar[Callable[[Any], str]]

    def _repr_html_(self) -> str:
        return Shown._html_of(self)
