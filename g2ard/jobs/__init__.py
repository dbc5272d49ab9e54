"""Decisions of whole commands: views, their targets, budgets and regularisers.

`simplify` and `distill` are `g2ard.simplify` and `g2ard.distill`. The commands of the same names call them,
so the shell and Python give the same bits. Stages do not depend on this package.
"""
