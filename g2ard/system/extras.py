"""Optional packages."""

from __future__ import annotations

from importlib.util import find_spec

from g2ard.errors import MissingDependencyError


def require_torch(feature: str) -> None:
    """Check that torch can be imported, without importing it."""
    if find_spec("torch") is None:
        raise MissingDependencyError(f"{feature} needs torch", hint="pip install 'g2ard[torch]'")
