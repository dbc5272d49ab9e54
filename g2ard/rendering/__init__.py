"""Images of a scene: the renderer, metrics, LPIPS and what each Gaussian adds to views."""
