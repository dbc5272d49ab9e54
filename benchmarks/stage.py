"""A stage that was run, and the names by which it is found again."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks.definition import Definition, SceneSpec
from benchmarks.process import Usage
from g2ard import __version__

__all__ = ["Stage", "fingerprint", "folder_of", "scene_key"]


def fingerprint(value: Any) -> str:
    """A short hash of anything that JSON can hold."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, default=str).encode()).hexdigest()[:16]


def scene_key(definition: Definition, scene: SceneSpec) -> str:
    """Changes with the scene, its files and the size of its views."""
    stated = {**asdict(scene), "size": definition.size, "version": __version__}
    files = () if scene.synth is not None else (scene.prior, scene.train, scene.adapt, *scene.score.values())
    stamps = [_stamp(definition.folder / file) for file in files if file is not None]
    return fingerprint({**stated, "files": stamps})


def folder_of(work: Path, definition: Definition, scene: SceneSpec) -> Path:
    """Where a scene's stages lie."""
    return work / f"{scene.name.replace('/', '_')}-{scene_key(definition, scene)}"


@dataclass(frozen=True)
class Stage:
    """A stage that has run.

    Args:
        key: of all that went into it.
        output: its scene or views.
        usage: of its process.
        report: what it reported.
    """

    key: str
    output: Path
    usage: Usage
    report: dict[str, Any]


def _stamp(path: Path) -> Any:
    """What tells one version of a file or folder from another, without reading it."""
    if not path.exists():
        return None
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    return [(f.name, f.stat().st_size, f.stat().st_mtime_ns) for f in files if f.is_file()]
