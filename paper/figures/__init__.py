"""Illustrations of the README: `python -m coil_paper.figures.world`, also `spline` and `lines`."""
