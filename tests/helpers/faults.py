"""Checks of what an `InputError` names."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from g2ard.errors import InputError

Fault = tuple[str | None, int | None] | str
"""The property and index that an error must name, or words that its message must hold."""


def check_fault(error: InputError, path: Path, fault: Fault) -> None:
    """Check that an error is one line that names a file, and in it a property and an index."""
    assert error.path == path, error
    assert "\n" not in str(error)
    if isinstance(fault, str):
        assert re.search(fault, str(error)), error
    else:
        assert (error.property, error.index) == fault, error


@contextmanager
def faulty(path: Path, fault: Fault) -> Iterator[None]:
    """Expect an `InputError` that names a file, and in it a property and an index."""
    with pytest.raises(InputError) as caught:
        yield
    check_fault(caught.value, path, fault)
