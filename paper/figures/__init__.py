"""Illustration of the docs: `python -m coil_paper.figures.world`."""
