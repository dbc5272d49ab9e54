"""One module per command, in the order `g2ard --help` lists them."""

from g2ard.cli.commands import recover  # isort: skip
from g2ard.cli.commands import render  # isort: skip
from g2ard.cli.commands import evaluate  # isort: skip
from g2ard.cli.commands import synth  # isort: skip

__all__ = ["evaluate", "recover", "render", "synth"]
