"""Stages: one module or package each; `g2ard.pipeline` joins them."""
