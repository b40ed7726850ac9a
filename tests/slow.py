"""What is left out by `make test`, and run by `make test-all`; most of it by `.ci/run`, too."""

import pytest


def some_fast(cases, fast):
    """Return the parameters of a test of which only some cases are fast; the others are slow."""
    params = []
    for case in cases:
        values = case if isinstance(case, tuple) else (case,)
        params.append(pytest.param(*values, marks=[] if case in fast else pytest.mark.slow))
    return params
