"""Reproduction of the paper's tables, figures and claims, on the public API of coil-rl.

It is imported as `coil_paper`; README.md beside this file says what it contains.
"""
