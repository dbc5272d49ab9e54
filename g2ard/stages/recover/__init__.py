"""Recovery: optimisation of a fixed set of Gaussians against photos or a teacher's renders."""
