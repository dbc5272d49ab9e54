"""The frame of all commands: common options, one-line errors, exit statuses, the JSON result.

A command is a function `fn(run: Run, ...)`; `@command` adds the common options to its signature.
Exit status: 0 success · 1 failure · 2 usage error · 3 requirement not met · 130 interrupted · 143 SIGTERM.
"""

from __future__ import annotations

import inspect
import json
import os
import re
import traceback
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from copy import copy
from itertools import combinations
from pathlib import Path
from pkgutil import resolve_name
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from g2ard.cli.app import app
from g2ard.cli.budget_options import BUDGETS, SEVERAL, TILES, Counts, Ratios
from g2ard.cli.config_file import load_config, printed
from g2ard.cli.console import Console
from g2ard.cli.fields import FIELDS
from g2ard.cli.panels import Command, in_panel, ordered
from g2ard.cli.usage import flags_of, in_flags, typed
from g2ard.config.choices import RenderModel, ViewFormat
from g2ard.config.schema import Config, full_paths, parse_settings
from g2ard.errors import G2ardError, InputError
from g2ard.io import check_scene_output, check_views_output, find_views, kind, read_view_set, write_views
from g2ard.io.atomic import atomic_output, check_output
from g2ard.io.detect import run_scene
from g2ard.io.finding import is_photo
from g2ard.io.paths import real_path
from g2ard.io.reports import plain
from g2ard.io.scene_formats import axes_note, files_of, scene_format
from g2ard.io.scenes import tell, write_scene
from g2ard.pipeline.presets import configured
from g2ard.progress import Detail, plural
from g2ard.system import devices, interrupt
from g2ard.system.cached import cached_property

if TYPE_CHECKING:
    from g2ard.scene.cameras import Cameras
    from g2ard.scene.splats import Splats
    from g2ard.tiles.merging import TiledScene

__all__ = ["Run", "app", "command", "one_line"]


_EXCLUSIVE_OPTIONS = (
    *combinations(("count", "ratio", "fit", "min_psnr"), 2),
    *combinations(("count", "ratio", "fit", "min_ssim"), 2),
    ("steps", "recovery_time"),
    ("views", "no_views"),
)
"""Options that exclude each other."""


def _flags_win(ctx: typer.Context, values: dict[str, Any], defaults: dict[str, Any]) -> None:
    """Let typed flags override options of the config file that they exclude."""
    for pair in _EXCLUSIVE_OPTIONS:
        for flag, other in (pair, pair[::-1]):
            if typed(ctx, flag) and not typed(ctx, other) and other in defaults:
                values[other] = defaults[other]


_COMMON_OPTIONS: dict[str, tuple[Any, ...]] = {
    "quiet": (bool, typer.Option("-q", "--quiet", help="Print errors only."), False),
    "verbose": (bool, typer.Option("-v", "--verbose", help="Print more details."), False),
    "overwrite": (bool, typer.Option("-w", "--overwrite", help="Replace existing outputs."), False),
    "json": (str | None, typer.Option(metavar="FILE|-", help="Write the result as JSON; - is stdout.")),
    "seed": (int, typer.Option(min=0, help="Random seed."), 0),
    "threads": (int, typer.Option(min=0, max=256, help="CPU threads; 0 uses all cores."), 0),
    "device": (str, typer.Option(metavar="auto|cpu|gpu", help="Where to compute."), "auto"),
    "print_config": (
        bool,
        typer.Option("--print-config", help="Print the options as a --config file, then exit."),
        False,
    ),
    "config": (
        Path | None,
        typer.Option(metavar="FILE.toml", callback=load_config, is_eager=True, help="Read default options."),
    ),
}
"""Name → type, option and default, None if left out."""

_SETTINGS: dict[str, tuple[Any, ...]] = {
    "set": (
        list[str] | None,
        typer.Option(
            metavar="PATH=VALUE",
            help="Change any setting by its path; repeatable. See docs/options.md.",
        ),
    )
}
_SCENE_OPTIONS: dict[str, tuple[Any, ...]] = {
    "render_model": (
        RenderModel | None,
        typer.Option(help="How the scenes are drawn, if their files do not say it or say it wrongly."),
    )
}


class Run:
    """One invocation of a command: its common options, its console and its result."""

    def __init__(
        self,
        name: str,
        common: dict[str, Any],
        options: dict[str, Any],
        flags: Mapping[str, str] = MappingProxyType({}),
        outputs: Collection[str] = ("output",),
        fields: Sequence[str] = (),
    ) -> None:
        self.name = name
        self.flags = flags  # parameter → flag
        self.fields = fields  # paths of settings that have flags
        self.shared = common
        self.overwrite: bool = common["overwrite"]
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
        self.kept: list[str] = []  # outputs and checkpoints that remain, for messages of errors and Ctrl-C
        self._failed: str | None = None  # what an error ended after the scene was written
        given = (*options.values(), common["config"])
        paths = [p for value in given for p in (value if isinstance(value, list) else [value])]
        written = (*map(options.get, outputs), common.get("work"))
        self._inputs = [p for p in paths if isinstance(p, Path) and all(p is not w for w in written)]
        self._outputs: dict[Path, tuple[str, bool]] = {}  # real path → option, whether all below is its own
        unrecorded = _COMMON_OPTIONS.keys() - {"seed", "threads", "device"}
        told = {**options, **{name: value for name, value in common.items() if name not in unrecorded}}
        self.config = {name: _flat(value) for name, value in told.items()}

    @property
    def callbacks(self) -> dict[str, Any]:
        """Arguments of jobs that report progress and messages."""
        return {"progress": self.progress, "say": self.say}

    def settled(self, config: Config, preset: str | None = None) -> tuple[dict[str, Any], Config]:
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
            return values, configured(config, preset or "auto", values)
        except InputError as e:
            name = e.parameter or ""
            if not name or any(f".{path}".endswith(f".{name}") for path in typed):
                raise typer.BadParameter(f"--set: {e}") from None
            option = e.at(parameter=name.rpartition(".")[2])
            raise typer.BadParameter(in_flags(option, self.flags)) from None

    @contextmanager
    def usage(self) -> Iterator[None]:
        """Turn an `InputError` about an option's value into a usage error."""
        try:
            yield
        except InputError as error:
            raise typer.BadParameter(in_flags(error, self.flags)) from None

    def refuse_typed(self, reason: str, *names: str) -> None:
        """Raise a usage error if an option without effect is on the command line; the reason ends it."""
        for name in names:
            if name in self.typed:
                raise typer.BadParameter(f"{self.flags.get(name, name)} has no effect {reason}; remove it")

    @contextmanager
    def finishing(self, what: str) -> Iterator[None]:
        """Begin a stage and name it in the message if it fails; the scene is already written."""
        self.begin(what.removeprefix("--"))
        try:
            yield
        except Exception:
            self._failed = self._failed or what
            raise

    def failure(self, reason: str) -> str:
        """Return the message of an error: what failed, why, and what remains."""
        failed = "" if self._failed is None else f"{self._failed} failed: "
        return "; ".join([failed + reason, *self.kept])

    def progress(self, stage: str, done: int, total: int, info: Mapping[str, Any] | None = None) -> None:
        """Report progress, after GPU messages since the last call."""
        self.tell_notes()
        self.console(stage, done, total, info)

    def begin(self, stage: str) -> None:
        """Report that a stage of unknown length begins; the next stage or message ends it."""
        self.progress(stage, 0, 0)

    def tell_notes(self) -> None:
        """Report GPU fallbacks since the last call, and warn once if the adapter is a software renderer."""
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
        self.say(f"dry run: only {self.json} is written" if to_file else "dry run: nothing is written")

    def result(self, data: dict[str, Any]) -> None:
        """Write the result and the resolved options to --json."""
        if self.json is None:
            return
        state = devices.state() if self.device in ("auto", "gpu") else None
        if state is not None and state.served:
            used = {"adapter": state.adapter, "kernels": state.served, "uploaded_bytes": state.uploaded_bytes}
            data = {**data, "device": used}
        with self.finishing("--json"):
            text = json.dumps({**data, "config": self.config}, indent=2, default=plain)
            if self.json == "-":
                self.console.print(text)
                return

            with atomic_output(Path(self.json), overwrite=self.overwrite) as temporary:
                temporary.write_text(text + "\n", encoding="utf-8", newline="\n")

    def results(self, reports: list[dict[str, Any]]) -> None:
        """Write the result of one budget, or of several under `runs`."""
        self.result(reports[0] if len(reports) == 1 else {"runs": reports})

    def load(self, path: Path) -> Splats:
        """Read a scene with --render-model, and report its notes."""
        from g2ard.jobs.inputs import load_scene

        self.begin("read")
        return load_scene(path, self.say, self.render_model)

    def write(
        self,
        path: Path,
        splats: Splats | TiledScene,
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
                write_ply(path, splats.stream(), overwrite=replaced)
                self.kept.append(f"{path} is written")
                return
            splats = splats.whole()
        notes = write_scene(path, splats, overwrite=replaced, progress=self.progress, **options)
        self.kept.append(f"{path} is written")
        tell(path, notes, self.say)
        if about_axes := axes_note(path, options):
            self.say(f"note: {path}: {about_axes}")
        if compare:
            from g2ard.jobs.measured_budget import loss_warning

            with self.finishing("comparing the file with the scene"):
                warning = loss_warning(path, splats, options)
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
        from g2ard.io.view_sets import lost_views, view_format

        overwrite = self.overwrite or overwrite
        write_views(path, cameras, splits=splits, weights=weights, format=format, overwrite=overwrite)
        self.kept.append(f"{path} is written")
        if lost := lost_views(cameras, view_format(path, format), splits, weights is not None):
            self.say(
                f"note: {path} leaves out {' and '.join([', '.join(lost[:-1]), lost[-1]][len(lost) == 1 :])}"
            )

    def claim(self, flag: str, *outputs: Path, folder: bool = False) -> None:
        """Record what an option writes, before any work.

        Args:
            flag: the option, or the name of what is written beside an output.
            folder: whether the outputs are folders of which every file belongs to the option.

        Raises:
            BadParameter: an output is also an input, even with --overwrite, or another option writes there.
        """
        self.spare_inputs(*outputs, flag=flag)
        for output in outputs:
            place = real_path(output)
            for other, (owner, whole) in self._outputs.items():
                inside = (whole and other in place.parents) or (folder and place in other.parents)
                if owner != flag and (inside or place == other):
                    taken = f"{flag}: {output} is written by {owner} too"
                    raise typer.BadParameter(f"{taken}; name another output")
            self._outputs[place] = flag, folder

    def claim_scene(self, flag: str, path: Path) -> None:
        """Record a scene that an option writes, and check that it can be written."""
        self.claim(flag, *files_of(path))
        check_scene_output(path, self.overwrite)

    def claim_file(self, flag: str, path: Path, *, page: bool = False) -> None:
        """Record a file or a page that an option writes, and check that it can be written."""
        self.claim(flag, path)
        if page:
            from g2ard.viewer.page import check_page_output

            check_page_output(path, self.overwrite)
        else:
            check_output(path, self.overwrite)

    def claim_views(self, path: Path, format: ViewFormat | None) -> None:
        """Record the views that a command writes, and check that they can be written."""
        self.claim("--output", path, folder=path.suffix == "")
        check_views_output(path, self.overwrite, format)

    def spare_inputs(self, *outputs: Path, flag: str = "--output") -> None:
        """Raise a usage error if an output is also an input, even with --overwrite."""
        taken = {real_path(place) for path in self._inputs for place in (path, run_scene(path))}
        folders = {place for place in taken if place.is_dir()}
        for output in outputs:
            place = real_path(output)
            inside = _DATA_FILES.fullmatch(place.name) and not folders.isdisjoint(place.parents)
            if place in taken or (place.exists() and (inside or place in self._read_beside(place))):
                raise typer.BadParameter(
                    f"{flag}: {output} is both an input and the output; name another output"
                )

    def _read_beside(self, place: Path) -> Collection[Path]:
        """Return files that inputs name or that are read beside them, if `place` may be one."""
        if is_photo(place):
            return self._photos
        return self._cameras if place.suffix.lower() in (".json", ".yml") else ()

    @cached_property
    def _photos(self) -> frozenset[Path]:
        """Photos and masks of views among the inputs or beside them, and all in input folders of photos."""
        found: list[Path | None] = []
        for path in [*self._inputs, *self._cameras]:
            try:
                what = kind(path)
            except (G2ardError, OSError):
                found += [p for p in path.rglob("*") if is_photo(p)] if path.is_dir() else []
                continue
            if what == "views":
                with suppress(G2ardError, OSError):  # the command will say it
                    cameras = read_view_set(path, unpictured=True).cameras
                    found += [*cameras.image_paths, *cameras.mask_paths]
        return frozenset(real_path(path) for path in found if path is not None)

    @cached_property
    def _cameras(self) -> frozenset[Path]:
        """Cameras that are read because they are beside an input scene."""
        found = (find_views(path) for path in self._inputs)
        return frozenset(real_path(path) for path in found if path is not None)

    def input_files(self) -> list[Path]:
        """Return all files that the command reads: its inputs, files in input folders, photos and cameras."""
        found = {*map(run_scene, self._inputs), *self._cameras}
        inside = {path for folder in found if folder.is_dir() for path in folder.rglob("*")}
        return sorted(path for path in found | inside | self._photos if path.is_file())

    def reads(self, scenes: list[Path], output: Path) -> None:
        """Record that the last positional path is the output."""
        self.config |= {"scenes": scenes, "output": output}
        self._inputs = [path for path in self._inputs if path is not output]

    def unmet(self, requirement: str) -> NoReturn:
        """Exit with status 3: outputs are written, but a requirement is not met."""
        self.console.error(requirement)
        raise typer.Exit(3)


_DATA_FILES = re.compile(
    r"(cameras|images|points3D|frames|rigs)\.(txt|bin)|(cameras|transforms.*|(lod-)?meta|tiles)\.json|poses_bounds\.npy"
    r"|(tile|halo)-\d+\.f32|(means_[lu]|scales|quats|sh0|shN_(centroids|labels))\.webp"
)
"""Files that commands read in a folder given to them."""


def _flat(value: Any) -> Any:
    """Flatten the budgets of a repeated option with several values each."""
    if isinstance(value, list) and value and all(isinstance(one, Counts | Ratios) for one in value):
        return [budget for several in value for budget in several]
    return value


def command(
    name: str,
    *,
    example: str,
    parent: typer.Typer = app,
    settings: str | None = None,
    fields: Sequence[str] = (),
    scenes: bool = False,
    budgets: bool = False,
    several: bool = False,
    tiles: bool = False,
    outputs: Collection[str] = ("output",),
    without: Collection[str] = (),
) -> Callable[[Any], Any]:
    """Register `fn(run, **options)` as a command.

    Args:
        parent: group it belongs to.
        settings: config of --set as MODULE:CLASS, see `Run.settled`, or "" if the command checks it; None
            takes no --set.
        fields: paths of its settings that flags set: those of `FIELDS`, or options named like them.
        scenes: whether it reads scenes and takes --render-model, see `Run.load`.
        budgets: whether it takes a budget, see `g2ard.cli.outputs.budget_of`.
        several: whether it takes several, see `g2ard.cli.outputs.budgets_of`.
        tiles: whether it works on scenes in tiles, see `g2ard.cli.tiling.tiling_of`.
        outputs: parameters that are paths to write, all of which it passes to `Run.claim`.
        without: common options that have no effect on it.
    """

    def register(fn: Callable[..., None]) -> Callable[..., None]:
        own = list(inspect.signature(fn, eval_str=True).parameters.values())[1:]
        shared_options = {**(BUDGETS if budgets else {}), **(TILES if tiles else {})}
        for key, end in SEVERAL.items() if several else ():
            kind, option = shared_options[key]
            option = copy(option)
            option.help += end
            shared_options[key] = (kind, option)
        shared_options |= {
            path.rpartition(".")[2]: (kind | None, option)
            for path, (kind, option) in FIELDS.items()
            if path in fields
        }
        shared_options |= {key: value for key, value in _COMMON_OPTIONS.items() if key not in without}
        shared_options |= {} if settings is None else _SETTINGS
        shared_options |= _SCENE_OPTIONS if scenes else {}
        all_parameters = [*own, *(_parameter(key, *options) for key, options in shared_options.items())]
        if parent is app:
            all_parameters = [in_panel(name, p) for p in ordered(name, all_parameters)]

        def call(ctx: typer.Context, **values: Any) -> None:
            _flags_win(ctx, values, {p.name: p.default for p in all_parameters})
            shared_values = {key: values.pop(key) for key in shared_options}
            shared_values |= {key: _COMMON_OPTIONS[key][2] for key in without}
            if typed(ctx, "set"):  # after the config file's, since the last value wins
                typed_last = [*(ctx.default_map or {}).get("set", []), *shared_values["set"]]
                shared_values["set"] = typed_last
            printing = shared_values.pop("print_config")
            run = Run(name, shared_values, dict(values), flags_of(ctx.command), outputs, fields)
            run.typed = frozenset(name for name in values if typed(ctx, name))
            if printing:
                if settings and run.config["set"]:
                    run.settled(resolve_name(settings)(), run.config.get("preset"))
                typer.echo(printed(ctx, {**values, **shared_values, **run.config}), nl=False)
                return
            with interrupt.RaisesInterrupt():
                _execute(run, fn, values)

        # Typer reads options from the signature: the context, the command's own, and the shared ones.
        context = inspect.Parameter("ctx", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context)
        parameters = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in (context, *all_parameters)]
        call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        call.__annotations__ = {p.name: p.annotation for p in parameters}
        call.__doc__ = fn.__doc__
        parent.command(name, cls=Command, epilog=f"Example: {example}")(call)
        return fn

    return register


def _parameter(name: str, kind: Any, option: Any, default: Any = None) -> inspect.Parameter:
    annotation = Annotated[kind, option]
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def _execute(run: Run, fn: Callable[..., None], options: dict[str, Any]) -> None:
    if run.device not in ("auto", "cpu", "gpu"):
        raise typer.BadParameter(f"--device: expected auto, cpu or gpu, got {run.device!r}")
    try:
        if run.json not in (None, "-"):
            run.claim_file("--json", Path(str(run.json)))
        if run.threads:
            from g2ard import _core

            _core.set_num_threads(run.threads)
            os.environ["RAYON_NUM_THREADS"] = str(run.threads)  # for child processes
        with run.console, _device(run):
            fn(run, **options)
    except KeyboardInterrupt:
        _stopped(run)
    except (G2ardError, OSError, MemoryError) as e:
        run.console.error(run.failure(one_line(e, run.flags)))
        raise typer.Exit(1) from None
    except (typer.Exit, typer.BadParameter):
        raise
    except Exception as e:
        if isinstance(e.__cause__, KeyboardInterrupt):  # before Python 3.12, in `__set_name__`
            _stopped(run)
        if run.verbose:
            traceback.print_exc()
        reason = run.failure(f"{type(e).__name__}: {' '.join(str(e).split())}")
        run.console.error(f"internal error, please report it: {reason} (-v shows the traceback)")
        raise typer.Exit(1) from None


def _stopped(run: Run) -> NoReturn:
    run.console.error(f"interrupted; {'; '.join(run.kept) or 'nothing was written'}")
    raise typer.Exit(interrupt.status()) from None


@contextmanager
def _device(run: Run) -> Iterator[None]:
    """Run kernels on --device, and report GPU use at the end."""
    if run.device not in ("auto", "gpu"):
        yield
        return

    devices.use(run.device, timed=run.verbose)
    ended = False
    try:
        yield
        ended = True
    finally:
        run.tell_notes()
        state = devices.state()
        if ended and run.device == "gpu" and not (state.served or run.noted):
            run.say("--device gpu: not used, because nothing in this run has a GPU kernel")
        elif state.served and run.verbose:
            longest = sorted(state.seconds.items(), key=lambda item: -item[1])[:6]
            took = "".join(f", {name} {seconds:.3f} s" for name, seconds in longest)
            run.say(f"GPU: {plural(state.served, 'kernel')} on {state.adapter}{took}")


def one_line(error: BaseException, flags: Mapping[str, str]) -> str:
    """Return the line that the command line prints for an error."""
    if isinstance(error, G2ardError):
        return " ".join(in_flags(error, flags).split())
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror}"
    if isinstance(error, MemoryError):
        return f"out of memory{f': {error}' if str(error) else ''}"
    return " ".join(str(error).split())
