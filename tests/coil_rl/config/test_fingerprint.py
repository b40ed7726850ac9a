"""Objects of users are told apart by their class and their state."""

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
