"""The stages, one module or package each, over a kernel each; `g2ard.pipeline` joins them."""
