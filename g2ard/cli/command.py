"""The decorator of commands: common options, one-line errors and exit statuses.

A command is a function `fn(run: Run, ...)`; `@command` adds the common options to its signature.
Exit status: 0 success · 1 failure · 2 usage error · 3 requirement not met · 130 interrupted · 143 SIGTERM.
"""

from __future__ import annotations

import inspect
import os
import traceback
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import copy
from itertools import combinations
from pathlib import Path
from pkgutil import resolve_name
from typing import Annotated, Any, NoReturn

import typer

from g2ard.cli.app import app
from g2ard.cli.budget_options import BUDGETS, SEVERAL, TILES, Options
from g2ard.cli.config_file import load_config, write_config
from g2ard.cli.fields import FIELDS
from g2ard.cli.panels import Command, in_panel, ordered
from g2ard.cli.run import Run
from g2ard.cli.usage import is_typed, map_flags, spell_in_flags
from g2ard.config.choices import Named, PointColor, RenderModel
from g2ard.errors import G2ardError
from g2ard.progress import plural
from g2ard.system import devices, interrupt

__all__ = ["app", "command", "describe_error"]


_EXCLUSIVE_OPTIONS = (
    *combinations(("count", "ratio", "fit", "min_psnr"), 2),
    *combinations(("count", "ratio", "fit", "min_ssim"), 2),
    *combinations(("steps", "time", "recovery_time"), 2),
    ("views", "no_views"),
)
"""Options that exclude each other."""


def _prefer_flags(ctx: typer.Context, values: Named, defaults: Named) -> None:
    """Let typed flags override options of the config file that they exclude."""
    for pair in _EXCLUSIVE_OPTIONS:
        for flag, other in (pair, pair[::-1]):
            if is_typed(ctx, flag) and not is_typed(ctx, other) and other in defaults:
                values[other] = defaults[other]


_COMMON_OPTIONS: Options = {
    "quiet": (bool, typer.Option("-q", "--quiet", help="Print errors only."), False),
    "verbose": (bool, typer.Option("-v", "--verbose", help="Print more details."), False),
    "overwrite": (bool, typer.Option("-w", "--overwrite", help="Replace existing outputs."), False),
    "json": (str, typer.Option(metavar="FILE|-", help="Write the result as JSON; - is stdout.")),
    "seed": (int, typer.Option(min=0, help="Random seed."), 0),
    "threads": (int, typer.Option(min=0, max=256, help="CPU threads; 0 uses all cores."), 0),
    "device": (str, typer.Option(metavar="auto|cpu|gpu", help="Where to compute."), "auto"),
    "print_config": (
        bool,
        typer.Option("--print-config", help="Print the options as a --config file, then exit."),
        False,
    ),
    "config": (
        Path,
        typer.Option(
            metavar="FILE.toml", callback=load_config, is_eager=True, help="Read default options."
        ),
    ),
}
"""Options of all commands."""

_SETTINGS: Options = {
    "set": (
        list[str],
        typer.Option(
            metavar="PATH=VALUE",
            help="Change any setting by its path; repeatable. See docs/options.md.",
        ),
    )
}
_SCENE_OPTIONS: Options = {
    "render_model": (
        RenderModel,
        typer.Option(
            help="How the scenes are drawn, if their files do not say it or say it wrongly."
        ),
    )
}


_POINT_OPTIONS: Options = {
    "box": (
        str,
        typer.Option(
            metavar="X,Y,Z,X,Y,Z",
            help="Of a point cloud, keep points between two corners, in its units.",
        ),
    ),
    "where": (
        str,
        typer.Option(
            metavar="CONDITION",
            help="Of a point cloud, keep points for which this holds, such as 'classification == 2'. Names "
            "are x, y, z, red, green, blue (0 to 1), and the columns of the file.",
        ),
    ),
    "color": (
        PointColor,
        typer.Option(help="Colour points by their intensity, or by their class."),
    ),
}


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
    points: bool = False,
    outputs: Collection[str] = ("output",),
    without: Collection[str] = (),
) -> Callable[[Any], Any]:
    """Register `fn(run, **options)` as a command.

    Args:
        parent: group it belongs to.
        settings: config of --set as MODULE:CLASS, see `Run.settle`, or "" if the command checks it; None
            takes no --set.
        fields: paths of its settings that flags set: those of `FIELDS`, or options named like them.
        scenes: whether it reads scenes and takes --render-model, see `Run.load`.
        budgets: whether it takes a budget, see `g2ard.cli.outputs.read_budget`.
        several: whether it takes several, see `g2ard.cli.outputs.read_budgets`.
        tiles: whether it works on scenes in tiles, see `g2ard.cli.work_folder.read_tiling`.
        points: whether it takes point clouds, of which `g2ard.cli.options.choose_points` chooses points.
        outputs: parameters that are paths to write, all of which it passes to `Run.claim`.
        without: shared options that have no effect on it.
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
            path.rpartition(".")[2]: option for path, option in FIELDS.items() if path in fields
        }
        shared_options |= _COMMON_OPTIONS
        shared_options |= {} if settings is None else _SETTINGS
        shared_options |= _SCENE_OPTIONS if scenes else {}
        shared_options |= _POINT_OPTIONS if points else {}
        unused = {key: default for key in without for default in shared_options.pop(key)[2:]}
        all_parameters = [
            *own,
            *(_create_parameter(key, *options) for key, options in shared_options.items()),
        ]
        if parent is app:
            all_parameters = [in_panel(name, p) for p in ordered(name, all_parameters)]

        def call(ctx: typer.Context, **values: Any) -> None:
            _prefer_flags(ctx, values, {p.name: p.default for p in all_parameters})
            shared_values = {key: values.pop(key) for key in shared_options}
            shared_values |= unused
            if is_typed(ctx, "set"):  # after the config file's, since the last value wins
                typed_last = [*(ctx.default_map or {}).get("set", []), *shared_values["set"]]
                shared_values["set"] = typed_last
            printing = shared_values.pop("print_config")
            run = Run(name, shared_values, dict(values), map_flags(ctx.command), outputs, fields)
            run.typed = frozenset(name for name in run.config if is_typed(ctx, name))
            if printing:
                if settings and run.config["set"]:
                    run.settle(resolve_name(settings)(), run.config.get("preset"))
                typer.echo(write_config(ctx, {**values, **shared_values, **run.config}), nl=False)
                return
            with interrupt.RaisesInterrupt():
                _execute(run, fn, values)

        # Typer reads options from the signature: the context, the command's own, and the shared ones.
        context = inspect.Parameter("ctx", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context)
        parameters = [
            p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in (context, *all_parameters)
        ]
        call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        call.__annotations__ = {p.name: p.annotation for p in parameters}
        call.__doc__ = fn.__doc__
        parent.command(name, cls=Command, epilog=f"Example: {example}")(call)
        return fn

    return register


def _create_parameter(name: str, kind: Any, option: Any, default: Any = None) -> inspect.Parameter:
    """Return the parameter of an option. Without a default its type also allows None."""
    if default is None:
        kind = kind | None
    annotation = Annotated[kind, option]
    return inspect.Parameter(
        name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation
    )


def _execute(run: Run, fn: Callable[..., None], options: Named) -> None:
    if run.device not in ("auto", "cpu", "gpu"):
        raise typer.BadParameter(f"--device: expected auto, cpu or gpu, got {run.device!r}")
    try:
        if run.json not in (None, "-"):
            run.claim_file("--json", Path(str(run.json)))
        if run.threads:
            import g2ard._core as _core

            _core.set_num_threads(run.threads)
            os.environ["RAYON_NUM_THREADS"] = str(run.threads)  # for child processes
        with run.console, _use_device(run):
            fn(run, **options)
        run.end()
    except KeyboardInterrupt:
        _exit_interrupted(run)
    except (G2ardError, OSError, MemoryError) as e:
        run.console.error(run.failure(describe_error(e, run.flags)))
        raise typer.Exit(1) from None
    except (typer.Exit, typer.BadParameter):
        raise
    except Exception as e:
        if isinstance(e.__cause__, KeyboardInterrupt):  # before Python 3.12, in `__set_name__`
            _exit_interrupted(run)
        if run.verbose:
            traceback.print_exc()
        reason = run.failure(f"{type(e).__name__}: {' '.join(str(e).split())}")
        run.console.error(f"internal error, please report it: {reason} (-v shows the traceback)")
        raise typer.Exit(1) from None


def _exit_interrupted(run: Run) -> NoReturn:
    run.console.error(f"interrupted; {'; '.join(run.kept) or 'nothing was written'}")
    raise typer.Exit(interrupt.status()) from None


@contextmanager
def _use_device(run: Run) -> Iterator[None]:
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


def describe_error(error: BaseException, flags: Mapping[str, str]) -> str:
    """Return the line that the command line prints for an error."""
    if isinstance(error, G2ardError):
        return " ".join(spell_in_flags(error, flags).split())
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror}"
    if isinstance(error, MemoryError):
        return f"out of memory{f': {error}' if str(error) else ''}"
    return " ".join(str(error).split())
