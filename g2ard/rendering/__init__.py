"""Images of a scene: the renderer, metrics, LPIPS and each Gaussian's visibility."""
