"""Parts of rich that typer's help imports and never uses, a sixth of its time: they load if they are used."""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import Any

_UNUSED = {"rich.markdown": "Markdown", "rich.traceback": "Traceback"}
"""Module and the class that typer imports from it: for Markdown in help texts, and for tracebacks."""


class _Deferred(type):
    """A class that stands for the one of its name in the module of its name."""

    def __call__(cls, *args: Any, **options: Any) -> Any:
        return getattr(_loaded(cls.__module__), cls.__name__)(*args, **options)

    def __getattr__(cls, name: str) -> Any:
        if name.startswith("__"):  # what Python itself asks of a class
            raise AttributeError(name)
        return getattr(getattr(_loaded(cls.__module__), cls.__name__), name)


class _Stand(ModuleType):
    """A module that stands for the one of its name."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # what the import system asks of a module
            raise AttributeError(name)
        return getattr(_loaded(self.__name__), name)


def _loaded(name: str) -> ModuleType:
    if isinstance(sys.modules.get(name), _Stand):
        del sys.modules[name]
    return importlib.import_module(name)


def defer_rich() -> None:
    """Let the modules load when something of them is used, not when they are imported."""
    for name, of in _UNUSED.items():
        if name not in sys.modules:
            stand = _Stand(name)
            setattr(stand, of, _Deferred(of, (), {"__module__": name}))
            sys.modules[name] = stand
