import doctest
import importlib
import importlib.util
import pkgutil

import pytest

import coil_rl

MODULES = [
    module.name
    for module in pkgutil.walk_packages(coil_rl.__path__, "coil_rl.")
    if ">>>" in (importlib.util.find_spec(module.name).loader.get_source(module.name) or "")
]


@pytest.mark.parametrize("name", MODULES)
def test_examples_in_docstrings_run(name):
    failures, examples = doctest.testmod(importlib.import_module(name))
    assert examples
    assert not failures
