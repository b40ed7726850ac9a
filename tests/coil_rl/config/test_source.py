"""Objects of users are told apart by their file and their state."""

import importlib
import os
import shutil
import subprocess
import sys
from functools import partial

import numpy as np
import pytest
import torch
from torch import nn

from coil_rl.config.source import identity_of


class Thing:
    """An object with a state."""

    def __init__(self, **state):
        self.__dict__.update(state)

    def act(self, observation):
        return observation


class Gain(nn.Module):
    """A module with a number that is no weight."""

    def __init__(self, gain):
        super().__init__()
        self.gain = gain

    def forward(self, observation):
        return self.gain * observation


def linear(seed):
    torch.manual_seed(seed)
    return nn.Sequential(nn.Linear(2, 1), nn.Tanh())


def scaled(gain):
    return lambda observation: gain * observation


def another(gain):
    return lambda observation: gain - observation


MAKERS = {
    "number": lambda n: Thing(gain=float(n)),
    "nested": lambda n: Thing(inner=[Thing(gains={"p": n})], names=("a", "b")),
    "array": lambda n: Thing(table=np.full(3, n)),
    "scalar": lambda n: Thing(gain=np.float32(n)),
    "tensor": lambda n: Thing(table=torch.full((), n, dtype=torch.bfloat16)),
    "set": lambda n: Thing(names={"a", "b", str(n)}),
    "closure": scaled,
    "partial": lambda n: partial(scaled, n),
    "method": lambda n: Thing(gain=n).act,
    "network": linear,
    "module": Gain,
}


@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)
def test_objects_with_the_same_state_look_the_same_and_others_do_not(make):
    assert identity_of(make(1)) == identity_of(make(1))
    assert identity_of(make(1)) != identity_of(make(2))


def test_functions_differ_by_their_code():
    assert identity_of(scaled(1)) != identity_of(another(1))


CODE = """
GAIN = {k}
class Base:
    def act(self, observation): return GAIN * observation
class Rule(Base): pass
def function(observation): return GAIN * observation
"""


def imported(folder, monkeypatch, number):
    """Return a module of a user with a number in its file."""
    monkeypatch.syspath_prepend(folder)
    sys.modules.pop("mine", None)
    shutil.rmtree(folder / "__pycache__", ignore_errors=True)
    (folder / "mine.py").write_text(CODE.format(k=number))
    importlib.invalidate_caches()
    return importlib.import_module("mine")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["function", "Base", "Rule"])
def test_code_of_a_user_is_told_apart_by_its_file_in_any_process(name, tmp_path, monkeypatch):
    # Each is taken while its file is there.
    takes = [lambda part: identity_of(part)]
    takes += [lambda part: identity_of(part())] if name != "function" else []
    for take in takes:
        one, same, other = (
            take(getattr(imported(tmp_path, monkeypatch, number), name)) for number in (1, 1, 2)
        )
        assert one == same != other
        assert one.startswith(f"mine.{name} (state ")
    call = f"import mine; from coil_rl.config.source import identity_of as i; print(i(mine.{name}))"
    printed = subprocess.run(
        [sys.executable, "-c", call],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])},
        capture_output=True,
        text=True,
        check=True,
    )
    assert printed.stdout.strip() == identity_of(sys.modules["mine"].__dict__[name])
    sys.modules.pop("mine")


def test_network_is_the_same_after_it_was_used():
    network = linear(0)
    before = identity_of(network)
    network.eval()(torch.zeros(2))
    assert identity_of(network) == before


def test_object_that_holds_itself_has_a_state():
    one, other = Thing(gain=1), Thing(gain=1)
    one.own, other.own = [one], [other]
    assert identity_of(one) == identity_of(other) != identity_of(Thing(gain=1))


def test_object_whose_state_cannot_be_read_is_told_apart_by_its_file():
    class Odd:
        def __reduce_ex__(self, protocol):
            raise RuntimeError("no")

    assert identity_of(Odd()) == identity_of(Odd()) != identity_of(Thing())
