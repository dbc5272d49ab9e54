"""One invocation of a command: its options, messages, outputs and result."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NoReturn

import typer

from g2ard.cli.budget_options import Counts, Ratios
from g2ard.cli.claims import Claims
from g2ard.cli.console import Console
from g2ard.cli.usage import spell_in_flags
from g2ard.config.choices import Named, RenderModel, ViewFormat
from g2ard.config.schema import Config, full_paths, parse_settings
from g2ard.errors import InputError
from g2ard.io import Source, write_views
from g2ard.io.atomic import atomic_output
from g2ard.io.reports import plain
from g2ard.io.scene_formats import axes_note, scene_format
from g2ard.io.scenes import tell, write_scene
from g2ard.pipeline.presets import configure
from g2ard.progress import Detail
from g2ard.system import devices

if TYPE_CHECKING:
    from g2ard.io.stream import SceneStream
    from g2ard.scene.cameras import Cameras
    from g2ard.scene.splats import Splats


_UNRECORDED = {"quiet", "verbose", "overwrite", "json", "print_config", "config"}
"""Common options that have no part in the result."""


class Run(Claims):
    """One invocation of a command: its common options, its console and its result."""

    def __init__(
        self,
        name: str,
        common: Named,
        options: Named,
        flags: Mapping[str, str] = MappingProxyType({}),
        outputs: Collection[str] = ("output",),
        fields: Sequence[str] = (),
    ) -> None:
        given = (*options.values(), common["config"])
        super().__init__(
            given, (*map(options.get, outputs), common.get("work")), common["overwrite"]
        )
        self.name = name
        self.flags = flags  # parameter → flag
        self.fields = fields  # paths of settings that have flags
        self.shared = common
        self.seed: int = common["seed"]
        self.threads: int = common["threads"]
        self.device: str = common["device"]
        self.verbose: bool = common["verbose"]
        self.json: str | None = common["json"]
        self.console = Console(quiet=common["quiet"], name=name)
        self.render_model: RenderModel | None = common.get("render_model")
        self.typed: frozenset[str] = frozenset()  # options given on the command line
        self.noted = False  # whether a GPU failed
        self._adapter: str | None = None  # last adapter in use
        # outputs and checkpoints that remain, for messages of errors and Ctrl-C
        self.kept: list[str] = []
        self._failed: str | None = None  # what an error ended after the scene was written
        self._unshown: Exception | None = None  # the error of a page or picture
        told = {
            **options,
            **{name: value for name, value in common.items() if name not in _UNRECORDED},
        }
        self.config = {name: _flat(value) for name, value in told.items()}

    @property
    def callbacks(self) -> Named:
        """Arguments of jobs that report progress and messages."""
        return {"progress": self.progress, "say": self.say}

    def settle(self, config: Config, preset: str | None = None) -> tuple[Named, Config]:
        """Merge flags of settings and --set, which wins, into values by path and the config that they make.

        Args:
            config: the defaults.
            preset: preset that the values override.
        """
        options = {path: self.config[path.rpartition(".")[2]] for path in self.fields}
        given = {path: value for path, value in options.items() if value not in (None, [], ())}
        try:
            typed = parse_settings(self.config["set"] or [], config)
        except InputError as e:
            raise typer.BadParameter(f"--set: {e}") from None
        values = full_paths(given, config) | typed
        for other in ("recover.recovery_time", "recover.schedule.steps"):
            if "recover.steps" in values and other in values:
                flag = "--recovery-time" if "time" in other else f"--set {other}"
                raise typer.BadParameter(f"--steps and {flag} exclude each other; give one")
        try:
            return values, configure(config, preset or "auto", values)
        except InputError as e:
            name = e.parameter or ""
            if not name or any(f".{path}".endswith(f".{name}") for path in typed):
                raise typer.BadParameter(f"--set: {e}") from None
            option = e.at(parameter=name.rpartition(".")[2])
            raise typer.BadParameter(spell_in_flags(option, self.flags)) from None

    @contextmanager
    def usage(self) -> Iterator[None]:
        """Turn an `InputError` about an option's value into a usage error."""
        try:
            yield
        except InputError as error:
            raise typer.BadParameter(spell_in_flags(error, self.flags)) from None

    def refuse_typed(self, reason: str, *names: str) -> None:
        """Raise a usage error if an option without effect is on the command line; the reason ends it."""
        for name in names:
            if name in self.typed:
                raise typer.BadParameter(
                    f"{self.flags.get(name, name)} has no effect {reason}; remove it"
                )

    @contextmanager
    def finishing(self, what: str) -> Iterator[None]:
        """Begin a stage and name it in the message if it fails; the scene is already written."""
        self.begin(what.removeprefix("--"))
        try:
            yield
        except Exception:
            self._failed = self._failed or what
            raise

    @contextmanager
    def showing(self, what: str) -> Iterator[None]:
        """Begin a page or picture of a result; if it fails, the command does the rest, then ends in its
        error."""
        self.begin(what.removeprefix("--"))
        try:
            yield
        except Exception as error:
            if self._unshown is None:
                self._failed = what
                self._unshown = error

    def end(self) -> None:
        """Raise the error of the first page or picture that failed."""
        if self._unshown is not None:
            raise self._unshown

    def failure(self, reason: str) -> str:
        """Return the message of an error: what failed, why, and what remains."""
        failed = "" if self._failed is None else f"{self._failed} failed: "
        return "; ".join([failed + reason, *self.kept])

    def note_written(self, path: Path) -> None:
        """Remember an output that is complete, for messages of later errors."""
        self.kept.append(f"{path} is written")

    def progress(
        self, stage: str, done: int, total: int, info: Mapping[str, Any] | None = None
    ) -> None:
        """Report progress, after GPU messages since the last call."""
        self.tell_notes()
        self.console(stage, done, total, info)

    def begin(self, stage: str) -> None:
        """Report that a stage of unknown length begins; the next stage or message ends it."""
        self.progress(stage, 0, 0)

    def tell_notes(self) -> None:
        """Report full disks and GPU fallbacks since the last call, and warn once of a software renderer."""
        from g2ard.system import spill  # it loads NumPy, which --help does without

        for note in spill.notes():
            self.console.say(note)
        if self.device in ("auto", "gpu"):
            for note in devices.notes():
                self.noted = True
                self.console.say(note)
            adapter = devices.state().adapter
            if adapter not in (None, self._adapter) and devices.is_software():
                told = f"{adapter} is a software renderer, usually slower than --device cpu"
                self.console.say(f"warning: --device {self.device}: {told}")
            self._adapter = adapter

    def say(self, text: str) -> None:
        """Print a line of status to stderr, unless --quiet; a `Detail` only with --verbose."""
        self.tell_notes()
        if self.verbose or not isinstance(text, Detail):
            self.console.say(text)

    def answer(self, text: str) -> None:
        """Print to stderr what the command was run for, such as an estimate, even with --quiet."""
        self.tell_notes()
        self.console.say(text, asked=True)

    def say_dry(self) -> None:
        """Say what a dry run writes."""
        to_file = self.json not in (None, "-")
        self.say(
            f"dry run: only {self.json} is written" if to_file else "dry run: nothing is written"
        )

    def result(self, data: Named) -> None:
        """Write the result and the resolved options to --json."""
        if self.json is None:
            return
        state = devices.state() if self.device in ("auto", "gpu") else None
        if state is not None and state.served:
            used = {
                "adapter": state.adapter,
                "kernels": state.served,
                "uploaded_bytes": state.uploaded_bytes,
            }
            data = {**data, "device": used}
        with self.finishing("--json"):
            text = json.dumps({**data, "config": self.config}, indent=2, default=plain)
            if self.json == "-":
                self.console.print(text)
                return

            with atomic_output(Path(self.json), overwrite=self.overwrite) as temporary:
                temporary.write_text(text + "\n", encoding="utf-8", newline="\n")

    def results(self, reports: list[Named]) -> None:
        """Write the result of one budget, or of several under `runs`."""
        self.result(reports[0] if len(reports) == 1 else {"runs": reports})

    def load(self, path: Path | Source) -> Splats:
        """Read a scene with --render-model, and report its notes."""
        from g2ard.jobs.inputs import load_scene

        self.begin("read")
        return load_scene(path, self.say, self.render_model)

    def write(
        self,
        path: Path,
        splats: Splats | SceneStream,
        *,
        overwrite: bool = False,
        compare: bool = False,
        **options: Any,
    ) -> None:
        """Write a scene, and report what its format cannot hold and, with `compare`, a large loss.

        Tiles are written to .ply one after the other; other formats need them all in memory.
        """
        from g2ard.io.ply import write as write_ply
        from g2ard.scene.splats import Splats

        self.begin("write")
        replaced = self.overwrite or overwrite
        if not isinstance(splats, Splats):
            if scene_format(path).suffix == ".ply":
                write_ply(path, splats, overwrite=replaced)
                self.note_written(path)
                return
            splats = splats.whole()
        notes = write_scene(path, splats, overwrite=replaced, progress=self.progress, **options)
        self.note_written(path)
        tell(path, notes, self.say)
        if about_axes := axes_note(path, options):
            self.say(f"note: {path}: {about_axes}")
        if compare:
            from g2ard.jobs.format_loss import describe_format_loss

            with self.finishing("comparing the file with the scene"):
                warning = describe_format_loss(path, splats, options)
            if warning:
                self.say(warning)

    def write_views(
        self,
        path: Path,
        cameras: Cameras,
        format: ViewFormat | None = None,
        splits: Sequence[str | None] = (),
        weights: Any = None,
        *,
        overwrite: bool = False,
    ) -> None:
        """Write views, and report what their format cannot hold."""
        from g2ard.io.views import lost_views, view_format

        overwrite = self.overwrite or overwrite
        write_views(
            path, cameras, splits=splits, weights=weights, format=format, overwrite=overwrite
        )
        self.note_written(path)
        if lost := lost_views(cameras, view_format(path, format), splits, weights is not None):
            self.say(
                f"note: {path} leaves out {' and '.join([', '.join(lost[:-1]), lost[-1]][len(lost) == 1 :])}"
            )

    def reads(self, scenes: list[Path], output: Path) -> None:
        """Record that the last positional path is the output."""
        self.config |= {"scenes": scenes, "output": output}
        self._inputs = [path for path in self._inputs if path is not output]

    def exit_unmet(self, requirement: str) -> NoReturn:
        """Exit with status 3: outputs are written, but a requirement is not met."""
        self.console.error(requirement)
        raise typer.Exit(3)


def _flat(value: Any) -> Any:
    """Flatten the budgets of a repeated option with several values each."""
    if isinstance(value, list) and value and all(isinstance(one, Counts | Ratios) for one in value):
        return list(chain.from_iterable(value))
    return value
