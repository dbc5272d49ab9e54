"""Decisions of whole commands, for the shell and Python alike: views, targets, budgets and regularisers."""
