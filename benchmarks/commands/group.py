"""The group that the benchmarks' commands belong to."""

import typer

bench = typer.Typer(
    help="Measure speed against the machine's limit, and quality against other methods.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
