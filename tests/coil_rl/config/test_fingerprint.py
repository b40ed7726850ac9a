"""Objects of users are told apart by their class and their state."""

import os
import subprocess
import sys
import types
from collections import deque
from functools import partial

import numpy as np
import pytest
import torch
from torch import nn

from coil_rl.config.fingerprint import fingerprint


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
    assert fingerprint(make(1)) == fingerprint(make(1))
    assert fingerprint(make(1)) != fingerprint(make(2))


def test_functions_differ_by_their_code():
    assert fingerprint(scaled(1)) != fingerprint(another(1))


CODE = """
from functools import cached_property
import numpy as np
ARRAY, NUMBERS, NAMES, NUMBER = np.array([{k}, 2.0]), [{k}], {{"a", "b", "c", "{k}"}}, {k}
def by_array(observation): return -ARRAY @ observation
def by_list(observation): return NUMBERS[0] * observation
def by_set(observation): return observation if "a" in NAMES else 0
def within(observation): return [(lambda each: NUMBER * each)(each) for each in observation]
def made(observation): return Attribute().act(observation)
class Attribute:
    gain = {k}
    def act(self, observation): return self.gain * observation
class Method:
    def act(self, observation): return 1 if observation[0] in {{"a", "b", {k}}} else 0
class Base(Method): pass
class Static:
    @staticmethod
    def act(observation): return {k} * observation
class Property:
    @property
    def gain(self): return {k}
    @cached_property
    def act(self): return lambda observation: self.gain * observation
class Slots:
    __slots__ = ()
    def act(self, observation): return {k} * observation
"""
FUNCTIONS = ("by_array", "by_list", "by_set", "within", "made")
CLASSES = ("Attribute", "Method", "Base", "Static", "Property", "Slots")


def module(number):
    """Return a module of a user with a number in its code."""
    found = types.ModuleType("mine")
    exec(CODE.format(k=number), found.__dict__)
    return found


@pytest.mark.parametrize("name", [*FUNCTIONS, *CLASSES])
def test_code_of_a_user_is_told_apart_by_what_it_uses(name):
    one, same, other = (getattr(module(number), name) for number in (1.0, 1.0, -9.0))
    assert fingerprint(one) == fingerprint(same) != fingerprint(other)
    assert fingerprint(one).startswith(f"mine.{name} (state ")
    if name in CLASSES:
        assert fingerprint(one()) == fingerprint(same()) != fingerprint(other())


def test_code_looks_the_same_in_another_process(tmp_path):
    (tmp_path / "mine.py").write_text(CODE.format(k=1.0))
    call = f"""
import mine
from coil_rl.config.fingerprint import fingerprint
print(*(fingerprint(getattr(mine, name)) for name in {(*FUNCTIONS, *CLASSES)}), sep=chr(10))
"""
    printed = subprocess.run(
        [sys.executable, "-c", call],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])},
        capture_output=True,
        text=True,
        check=True,
    )
    own = module(1.0)
    assert printed.stdout.splitlines() == [
        fingerprint(getattr(own, name)) for name in (*FUNCTIONS, *CLASSES)
    ]


def test_network_is_the_same_after_it_was_used():
    network = linear(0)
    before = fingerprint(network)
    network.eval()(torch.zeros(2))
    assert fingerprint(network) == before


def test_object_that_holds_itself_has_a_state():
    one, other = Thing(gain=1), Thing(gain=1)
    one.own, other.own = [one], [other]
    assert fingerprint(one) == fingerprint(other)
    assert fingerprint(one).startswith(f"{__name__}.Thing (state ")


def test_object_whose_state_cannot_be_read_is_its_class():
    class Odd:
        @property
        def __dict__(self):
            raise RuntimeError("no")

    assert fingerprint(Odd()).endswith("Odd")
    assert fingerprint(deque([1])) == fingerprint(deque([2]))  # Python shows no state of it
