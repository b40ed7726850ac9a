"""Illustrations of the docs: `python -m coil_paper.figures.world`, also `spline` and `lines`."""
