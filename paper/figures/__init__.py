"""Illustrations of the docs: `python -m coil_paper.figures.world`, and `lines`."""
