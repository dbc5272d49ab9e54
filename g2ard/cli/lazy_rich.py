"""Lazy loading of rich modules that typer imports but rarely uses, a sixth of the time of --help."""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import Any

_UNUSED = {"rich.markdown": "Markdown", "rich.traceback": "Traceback"}
"""Module → the class that typer imports from it."""


class _Deferred(type):
    """Metaclass of a placeholder for the class of its module and name."""

    def __call__(cls, *args: Any, **options: Any) -> Any:
        return getattr(_loaded(cls.__module__), cls.__name__)(*args, **options)

    def __getattr__(cls, name: str) -> Any:
        if name.startswith("__"):  # looked up by Python itself
            raise AttributeError(name)
        return getattr(getattr(_loaded(cls.__module__), cls.__name__), name)


class _Stand(ModuleType):
    """Placeholder for the module of its name."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # looked up by the import system
            raise AttributeError(name)
        return getattr(_loaded(self.__name__), name)


def _loaded(name: str) -> ModuleType:
    if isinstance(sys.modules.get(name), _Stand):
        del sys.modules[name]
    return importlib.import_module(name)


def defer_rich() -> None:
    """Install placeholders that load the modules on first use."""
    for name, of in _UNUSED.items():
        if name not in sys.modules:
            stand = _Stand(name)
            setattr(stand, of, _Deferred(of, (), {"__module__": name}))
            sys.modules[name] = stand
