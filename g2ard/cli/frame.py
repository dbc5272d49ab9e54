"""What every command shares: common options, one-line errors, exit statuses, the JSON result.

A command is a function `fn(run: Run, ...)`; `@command` adds the common options to its signature.
Exit status: 0 done · 1 failed · 2 usage · 3 a stated requirement was not met · 130 interrupted,
143 by SIGTERM.
"""

from __future__ import annotations

import contextlib
import inspect
import os
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from itertools import combinations
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, NoReturn

import typer

from g2ard.cli.app import app
from g2ard.cli.budget_options import Counts, Ratios
from g2ard.cli.config import load_config, printed
from g2ard.cli.console import Console
from g2ard.cli.panels import COMMON, GROUPED, into_panels
from g2ard.cli.usage import flags_of, in_flags, typed
from g2ard.errors import G2ardError
from g2ard.progress import plural
from g2ard.system import interrupt

__all__ = ["Run", "app", "command", "group", "one_line"]


_RIVALS = (
    *combinations(("count", "ratio", "fit", "min_psnr"), 2),
    *combinations(("count", "ratio", "fit", "min_ssim"), 2),
    ("steps", "recovery_time"),
    ("views", "no_views"),
)
"""Options that exclude each other."""


def _flags_win(ctx: typer.Context, values: dict[str, Any], defaults: dict[str, Any]) -> None:
    """Forget what the config file says where a flag that excludes it was typed."""
    for pair in _RIVALS:
        for flag, other in (pair, pair[::-1]):
            if typed(ctx, flag) and not typed(ctx, other) and other in defaults:
                values[other] = defaults[other]


_COMMON: dict[str, tuple[Any, Any, Any]] = {
    "quiet": (bool, False, typer.Option("-q", "--quiet", help="Print errors only.")),
    "verbose": (bool, False, typer.Option("-v", "--verbose", help="Say more.")),
    "overwrite": (bool, False, typer.Option("-w", "--overwrite", help="Replace existing outputs.")),
    "json": (str | None, None, typer.Option("--json", metavar="FILE|-", help="Write the result as JSON.")),
    "seed": (int, 0, typer.Option(min=0, help="Seed of everything random.")),
    "threads": (int, 0, typer.Option(min=0, max=256, help="Threads; 0 means every core.")),
    "device": (str, "auto", typer.Option(metavar="auto|cpu|gpu|cuda", help="Where to compute.")),
    "print_config": (
        bool,
        False,
        typer.Option("--print-config", help="Print the options as a file for --config, and do nothing."),
    ),
    "config": (
        Path | None,
        None,
        typer.Option(metavar="FILE.toml", callback=load_config, is_eager=True, help="Defaults; flags win."),
    ),
}
"""Name → type, default and option."""

_SET = typer.Option(
    "--set",
    metavar="PATH=VALUE",
    help="A setting, such as recover.schedule.steps=300 (docs/options.md); reports list all. Repeatable.",
)


class Run:
    """One invocation of a command: its common options, its console and its result."""

    def __init__(
        self,
        name: str,
        common: dict[str, Any],
        options: dict[str, Any],
        flags: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        self.name = name
        self.flags = flags  # parameter → flag
        self.overwrite: bool = common["overwrite"]
        self.seed: int = common["seed"]
        self.threads: int = common["threads"]
        self.device: str = common["device"]
        self.verbose: bool = common["verbose"]
        self.json: str | None = common["json"]
        self.console = Console(quiet=common["quiet"])
        self.only_checks = False  # whether the call ends once its settings are checked
        self.noted = False  # whether a GPU failed
        self._adapter: str | None = None  # the last that was in use
        self.kept: list[str] = []  # what a Ctrl-C leaves, in words
        given = (*options.values(), common["config"])
        paths = [p for value in given for p in (value if isinstance(value, list) else [value])]
        written = (options.get("output"), options.get("work"))
        self._inputs = [p for p in paths if isinstance(p, Path) and all(p is not w for w in written)]
        own = {name: _flat(value) for name, value in options.items()}
        self.config = {**own, "seed": self.seed, "threads": self.threads, "device": self.device}
        if "set" in common:
            self.config["set"] = common["set"]

    def settings(self, config: Any, *names: str, preset: str | None = None) -> dict[str, Any]:
        """Collect values of a config by path, as a usage check: --set, and under it the options `names`.

        Args:
            config: the defaults.
            names: options called like a field, or like the tail of its path; those not given are left out.
            preset: under which the values of --set are checked as far as they can be alone.
        """
        from g2ard.config.paths import full_paths, parsed
        from g2ard.config.presets import configured
        from g2ard.errors import InputError

        given = {name: self.config[name] for name in names if self.config[name] not in (None, [], ())}
        try:
            typed = parsed(self.config["set"] or [], config)
            configured(config, preset or "auto", typed)
        except InputError as e:
            raise typer.BadParameter(f"--set: {e}") from None
        values = full_paths(given, config) | typed
        for other in ("recover.recovery_time", "recover.schedule.steps"):
            if "recover.steps" in values and other in values:
                flag = "--recovery-time" if "time" in other else f"--set {other}"
                raise typer.BadParameter(f"--steps and {flag} exclude each other; give one")
        if self.only_checks:
            raise _Checked
        return values

    def progress(self, stage: str, done: int, total: int, info: Mapping[str, Any] | None = None) -> None:
        """The callback that stages report to; what befell the GPU in the meantime is told first."""
        self.tell_notes()
        self.console(stage, done, total, info)

    def tell_notes(self) -> None:
        """Why the CPU took over from a GPU, if it has since last told, and that a GPU is none."""
        if self.device in ("auto", "gpu"):
            from g2ard.system import devices

            for note in devices.notes():
                self.noted = True
                self.console.say(note)
            adapter = devices.state().adapter
            if adapter not in (None, self._adapter) and devices.is_software():
                told = f"{adapter} is software on this CPU, as a rule slower than --device cpu"
                self.console.say(f"--device {self.device}: {told}")
            self._adapter = adapter

    def say(self, text: str) -> None:
        """A line of status on stderr, unless --quiet."""
        self.tell_notes()
        self.console.say(text)

    def result(self, data: dict[str, Any]) -> None:
        """Write the machine-readable result to where --json says; the resolved options go with it."""
        if self.json is None:
            return
        import json

        text = json.dumps({**data, **self._used(), "config": self.config}, indent=2, default=_plain)
        if self.json == "-":
            print(text, flush=True)
            return
        from g2ard.io.atomic import atomic_output

        with atomic_output(Path(self.json), overwrite=self.overwrite) as temporary:
            temporary.write_text(text + "\n", encoding="utf-8", newline="\n")

    def _used(self) -> dict[str, Any]:
        """What ran on a GPU, if anything did."""
        if self.device not in ("auto", "gpu"):
            return {}
        from g2ard.system import devices

        state = devices.state()
        if not state.served:
            return {}
        used = {"adapter": state.adapter, "kernels": state.served, "uploaded_bytes": state.uploaded_bytes}
        return {"device": used}

    def spare_inputs(self, *outputs: Path) -> None:
        """Usage check: nothing is written over what is read, not even under --overwrite."""
        from g2ard.io.detect import run_scene
        from g2ard.io.paths import real_path

        taken = {real_path(place) for path in self._inputs for place in (path, run_scene(path))}
        for output in outputs:
            if real_path(output) in taken:
                raise typer.BadParameter(
                    f"{output} would be written over, and is an input; name another output"
                )

    def reads(self, scenes: list[Path], output: Path) -> None:
        """Of the paths given as `scenes` the last one was `output`; as a usage check, see `spare_inputs`."""
        self.config |= {"scenes": scenes, "output": output}
        self._inputs = [path for path in self._inputs if path is not output]
        self.spare_inputs(output)

    def unmet(self, requirement: str) -> NoReturn:
        """End with status 3: all is written, but a stated requirement was not met."""
        self.console.error(requirement)
        raise typer.Exit(3)


def _flat(value: Any) -> Any:
    """Budgets of an option that takes several at once, and more than once, as one list."""
    if isinstance(value, list) and value and all(isinstance(one, Counts | Ratios) for one in value):
        return [budget for several in value for budget in several]
    return value


def _plain(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else str(value)


def group(name: str, text: str) -> typer.Typer:
    """A command with subcommands, such as `python -m benchmarks synth`."""
    sub = typer.Typer(help=text, no_args_is_help=True)
    app.add_typer(sub, name=name)
    return sub


def command(
    name: str, *, example: str, parent: typer.Typer = app, cuda: bool = False, settings: bool = False
) -> Callable[[Any], Any]:
    """Register `fn(run, **options)` as a command; `example` ends its help.

    Args:
        name: of the command.
        example: a line.
        parent: the group it belongs to.
        cuda: it knows --device cuda.
        settings: it takes --set, see `Run.settings`.
    """

    def register(fn: Callable[..., None]) -> Callable[..., None]:
        own = list(inspect.signature(fn, eval_str=True).parameters.values())[1:]
        shared_options = {**_COMMON, "set": (list[str] | None, None, _SET)} if settings else _COMMON
        common = [
            inspect.Parameter(
                key, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, option]
            )
            for key, (kind, default, option) in shared_options.items()
        ]
        for p in common:
            into_panels(p.name, p.annotation, COMMON)
        for p in own if name in GROUPED else ():
            into_panels(p.name, p.annotation)

        def call(ctx: typer.Context, **values: Any) -> None:
            _flags_win(ctx, values, {p.name: p.default for p in own})
            shared = {key: values.pop(key) for key in shared_options}
            if typed(ctx, "set"):  # after those of the config file, for the last counts
                shared["set"] = [*(ctx.default_map or {}).get("set", []), *shared["set"]]
            printing = shared.pop("print_config")
            run = Run(name, shared, dict(values), flags_of(ctx.command))
            if printing:
                if shared.get("set"):
                    _check_settings(run, fn, values)
                typer.echo(printed(ctx, {**values, **shared}), nl=False)
                return
            ours = interrupt.raises()
            try:
                _execute(run, fn, values, cuda)
            finally:
                if ours:
                    interrupt.ends_the_program()

        context = inspect.Parameter("ctx", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context)
        parameters = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in (context, *own, *common)]
        call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        call.__annotations__ = {p.name: p.annotation for p in parameters}
        call.__doc__ = fn.__doc__
        parent.command(name, epilog=f"Example: {example}")(call)
        return fn

    return register


class _Checked(Exception):
    """The settings are known and in range."""


def _check_settings(run: Run, fn: Callable[..., None], options: dict[str, Any]) -> None:
    """Check the values of --set, and do nothing else."""
    run.only_checks = True
    with contextlib.suppress(_Checked):
        fn(run, **options)


def _execute(run: Run, fn: Callable[..., None], options: dict[str, Any], cuda: bool) -> None:
    if run.device not in ("auto", "cpu", "gpu", "cuda"):
        raise typer.BadParameter(f"--device: auto, cpu, gpu or cuda, not {run.device!r}")
    from g2ard.io.paths import real_path

    outputs = [Path(o) for o in (options.get("output"), run.json) if o not in (None, "-")]
    if len({real_path(output) for output in outputs}) < len(outputs):
        raise typer.BadParameter(f"--json and --output are both {run.json}; name another file for one")
    work = options.get("work")
    if work is not None and real_path(work) in {real_path(output) for output in outputs}:
        raise typer.BadParameter(f"--work: {work} is an output; name another folder")
    run.spare_inputs(*outputs)
    if run.device == "cuda" and not cuda:
        run.say("--device cuda: this command computes on the CPU only, and does")
    try:
        if run.json not in (None, "-"):
            from g2ard.io.atomic import check_output

            check_output(str(run.json), run.overwrite)
        if run.threads:
            from g2ard import _core

            _core.set_num_threads(run.threads)
            os.environ["RAYON_NUM_THREADS"] = str(run.threads)  # for the processes that benchmarks start
        with run.console, _device(run):
            fn(run, **options)
    except KeyboardInterrupt:
        run.console.error(f"interrupted; {'; '.join(run.kept) or 'nothing was written'}")
        raise typer.Exit(interrupt.status()) from None
    except (G2ardError, OSError, MemoryError) as e:
        run.console.error(one_line(e, run.flags))
        raise typer.Exit(1) from None
    except (typer.Exit, typer.BadParameter):
        raise
    except Exception as e:
        if run.verbose:
            traceback.print_exc()
        run.console.error(f"internal error, please report it: {type(e).__name__}: {e} (-v shows where)")
        raise typer.Exit(1) from None


@contextmanager
def _device(run: Run) -> Iterator[None]:
    """Kernels run where --device says."""
    if run.device not in ("auto", "gpu"):
        yield
        return
    from g2ard.system import devices

    devices.use(run.device, timed=run.verbose)
    ended = False
    try:
        yield
        ended = True
    finally:
        run.tell_notes()
        state = devices.state()
        if ended and run.device == "gpu" and not (state.served or run.noted):
            run.say("--device gpu: only `simplify --method paper` and `select` use one; all ran on the CPU")
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
