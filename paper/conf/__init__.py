"""Hydra configuration of `coil-reproduce`: results, experiments, budgets, words of the pages."""
