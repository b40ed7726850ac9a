import doctest
import importlib
import importlib.util
import pkgutil

import pytest

import coil_paper
import coil_rl

MODULES = [
    module.name
    for package in (coil_rl, coil_paper)
    for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
    if ">>>" in (importlib.util.find_spec(module.name).loader.get_source(module.name) or "")
]


@pytest.mark.parametrize("name", MODULES)
def test_examples_in_docstrings_run(name):
    failures, examples = doctest.testmod(importlib.import_module(name))
    assert examples
    assert not failures
