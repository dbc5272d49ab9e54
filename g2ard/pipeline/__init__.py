"""The whole pipeline: selection, simplification and recovery of a scene, and adaptation of its appearance."""
