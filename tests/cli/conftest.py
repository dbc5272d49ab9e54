"""The inputs of a run of every command."""

import shutil
from pathlib import Path

import pytest

from helpers.calls import write_inputs


@pytest.fixture(scope="session")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    write_inputs(folder)
    return folder


@pytest.fixture
def work(inputs: Path, tmp_path: Path) -> Path:
    """A copy of the inputs, where commands may write."""
    return shutil.copytree(inputs, tmp_path / "work")
