"""What a whole command decides: which views a run looks at, what their targets are, which regularisers hold.

`simplify` and `distill` are `g2ard.simplify` and `g2ard.distill`; the commands of those names call them too,
so that a shell and a program get the same bits. Stages know nothing of it.
"""
