"""Keys of jobs: the same at a job's start and at its end, wherever a test runs one."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import pytest

from g2ard.pipeline.steps import Steps
from g2ard.scene.splats import Splats
from g2ard.stages.recover.loop import Loop
from g2ard.system.keys import key_of
from g2ard.tiles.executor import Workers

_CACHED = ("key", "source", "_digest")
"""Attributes that keep a key or a hash once it is computed."""


def forget(value: Any) -> None:
    """Forget the keys of a job and of all that it holds, so that they are computed again."""
    own = getattr(value, "__dict__", {})
    for name in _CACHED:
        own.pop(name, None)
    for item in own.values():
        if isinstance(item, Splats) or hasattr(item, "cameras"):
            forget(item)
    for targets, _ in own.get("_places", ()):
        forget(targets)


def is_foreign(value: Any) -> bool:
    """Return whether a job holds targets of a class that is not g2ard's, whose key asks for every image."""
    if hasattr(value, "cameras") and not type(value).__module__.startswith("g2ard."):
        return True
    held = [
        *getattr(value, "__dict__", {}).values(),
        *(targets for targets, _ in getattr(value, "_places", ())),
    ]
    return any(is_foreign(item) for item in held if hasattr(item, "cameras"))


@contextmanager
def lasting_keys() -> Iterator[None]:
    """Fail if a job that runs here has another key at its end."""
    changed: list[str] = []

    def compare(name: str, key: Callable[[], str], run: Callable[[], Any], *inputs: Any) -> Any:
        def anew() -> str:
            for value in inputs:
                forget(value)
            found = key()
            for value in inputs:
                forget(value)
            return found

        if any(map(is_foreign, inputs)):
            return run()
        before = anew()
        try:
            return run()
        finally:
            if anew() != before:
                changed.append(name)

    def loop(run: Any) -> Any:
        def watched(self: Loop, *arguments: Any) -> Any:
            return compare("recovery", lambda: self.key, lambda: run(self, *arguments), self)

        return watched

    def steps(run: Any) -> Any:
        def watched(self: Steps, name: str, scene: Splats, settings: Any, *more: Any) -> Any:
            given = [cell.cell_contents for cell in settings.__closure__ or ()]

            def key() -> str:
                return key_of([name, scene, settings()])

            return compare(
                name, key, lambda: run(self, name, scene, settings, *more), scene, *given
            )

        return watched

    def workers(run: Any) -> Any:
        def watched(self: Workers, tasks: Sequence[Any], stage: str) -> Any:
            return compare(
                stage, lambda: key_of([task.key for task in tasks]), lambda: run(self, tasks, stage)
            )

        return watched

    with pytest.MonkeyPatch.context() as patches:
        for kind, name, watch in (
            (Loop, "choose_rates", loop),
            (Loop, "run", loop),
            (Steps, "run", steps),
            (Workers, "run", workers),
        ):
            patches.setattr(kind, name, watch(getattr(kind, name)))
        yield
    assert not changed, f"jobs whose key at their end is not that at their start: {changed}"
