"""The program: its arguments, its streams and its exit status."""

import gc
import io
import os
import sys
from typing import TextIO

import typer

from g2ard.cli.app import app, create_listing, register_commands
from g2ard.cli.console import wrap
from g2ard.system import interrupt

_COMPLETION = ("--show-completion", "--install-completion")


def main() -> None:
    """Run the `g2ard` program."""
    _name_shell(sys.argv[1:])
    if sys.argv[1:] in ([], ["-h"], ["--help"]) and "_G2ARD_COMPLETE" not in os.environ:
        run_program(create_listing(), "g2ard")  # importing the commands takes time
    register_commands(next(iter(sys.argv[1:]), None))
    run_program(app, "g2ard")


def run_program(app: typer.Typer, name: str) -> None:
    """Run the command line and exit; usage errors print one line and exit with status 2.

    The streams outlive a closed pipe, as in `g2ard info scene.ply | head`.
    """
    # BLAS threads would only spin (3 % of a short command), since kernels use their own threads.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    _open_streams()
    sys.stdout, sys.stderr = _Outliving(sys.stdout), _Outliving(sys.stderr)
    # imports create no garbage; looking for it takes 5 % of a short command
    gc.set_threshold(50_000)
    try:
        status = app(prog_name=name, standalone_mode=False)
    except typer.Abort:
        status = interrupt.status()
    except typer.TyperException as e:
        from g2ard.cli.usage import describe_usage_error

        message = describe_usage_error(e)
        where = getattr(getattr(e, "ctx", None), "command_path", name)
        if message:  # empty when a group without arguments has already shown its help
            print(wrap(f"{where}: {message} (see {where} --help)"), file=sys.stderr)
        status = e.exit_code
    gc.freeze()  # skip the final collection
    sys.stdout.flush()
    sys.exit(status)


def _open_streams() -> None:
    """Send to nowhere what goes to a closed stream, as after `>&-`, and keep files off its number.

    Characters that a stream's character set lacks are replaced.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest free number, which is this one
            os.set_inheritable(number, True)
        if getattr(sys, name) is None:
            stream = os.fdopen(number, "w" if number else "r", encoding="utf-8", closefd=False)
            setattr(sys, name, stream)
        stream = getattr(sys, name)
        if number and isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def _name_shell(words: list[str]) -> None:
    """Let `--show-completion zsh` name the shell; otherwise typer detects it from the environment."""
    if len(words) > 1 and words[0] in _COMPLETION and not words[1].startswith("-"):
        os.environ["_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION"] = "1"


class _Outliving:
    """Text stream that discards its output once the reader has closed the pipe, as in `| head`."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> object:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        try:
            return self._stream.write(text)
        except BrokenPipeError:
            self._to_nowhere()
            return len(text)

    def flush(self) -> None:
        try:
            self._stream.flush()
        except BrokenPipeError:
            self._to_nowhere()

    def _to_nowhere(self) -> None:
        """Redirect the file descriptor, so that buffered text is discarded too."""
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, self._stream.fileno())
        os.close(nowhere)
