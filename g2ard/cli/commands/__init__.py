"""One module per command, in the order `g2ard --help` lists them."""

from g2ard.cli.commands import lift as lift
from g2ard.cli.commands import simplify as simplify
