//! The tiled differentiable rasteriser: one room per pass.
