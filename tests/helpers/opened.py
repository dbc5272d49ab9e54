"""Files as readers open them: scenes with notes, and rows in blocks."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from g2ard.io import Source
from g2ard.io.source import joined
from g2ard.io.types import Note
from g2ard.scene.splats import Splats


class Scene(NamedTuple):
    splats: Splats
    notes: tuple[Note, ...]


def read_scene(path: str | Path) -> Scene:
    source = Source(path)
    return Scene(source.whole(), source.notes)


def stream_of(paths: str | Path | Sequence[str | Path]) -> Any:
    """Open a file, or several as one, for reading in blocks."""
    return joined([Source(path) for path in ([paths] if isinstance(paths, str | Path) else paths)])
