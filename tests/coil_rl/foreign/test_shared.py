"""A controller that all rows share must not remember anything, nor mix the rows."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from coil_rl.foreign.faults import ForeignError
from coil_rl.guides import ControllerGuide

REMEMBERS = r"for the same observation: .* must not remember or draw .*; write a class with act"


def advice(guide, *calls):
    """Return the actions in consecutive calls, for the numbers that the rows observe."""
    data = [TensorDict({"observation": torch.tensor(rows)[:, None]}, [len(rows)]) for rows in calls]
    return [guide(each)["action"].flatten().tolist() for each in data]


def integral_of_a_row():
    total = [0.0]

    def act(observation):
        total[0] += 0.1 * float(observation[0])
        return [-float(observation[0]) - total[0]]

    return act


def integral_of_a_batch():
    total = [0.0]

    def act(observation):
        total[0] = total[0] + 0.1 * observation.sum(-2, keepdim=True)
        return -observation - total[0]

    return act


class Filter(nn.Module):
    """Remembers in an attribute."""

    last = 0.0

    def forward(self, observation):
        self.last = 0.9 * self.last + 0.1 * observation
        return self.last


class Draws(nn.Module):
    def forward(self, observation):
        return observation + torch.rand_like(observation)


class Gain(nn.Module):
    """Remembers a factor: an observation of 0 does not show it."""

    gain = 1.0

    def forward(self, observation):
        self.gain += 0.1 * float(observation.abs().max())
        return self.gain * observation


@pytest.mark.parametrize(
    "make", [integral_of_a_row, integral_of_a_batch, Filter, Draws, Gain], ids=lambda m: m.__name__
)
@pytest.mark.parametrize("rows", [1, 3])
def test_memory_is_found_where_the_plant_begins_at_rest(make, rows):
    with pytest.raises(ForeignError, match=REMEMBERS):
        advice(ControllerGuide(make()), *([float(step)] * rows for step in range(4)))


class Mean(nn.Module):
    def forward(self, observation):
        return observation - observation.mean(0)


class Normalised(nn.Module):
    def forward(self, observation):
        return nn.functional.batch_norm(observation, None, None, training=True)


class Ranks(nn.Module):
    def forward(self, observation):
        return observation.argsort(0)


@pytest.mark.parametrize("kind", [Mean, Ranks])
@pytest.mark.parametrize("rows", [[1.0], [0.0, 0.0], [3.0, -1.0, 2.0]])
def test_network_that_mixes_the_rows_is_refused(kind, rows):
    message = r"for an observation alone, but \[.*\] for it in a batch of 3: it mixes the rows"
    with pytest.raises(ForeignError, match=message):
        advice(ControllerGuide(kind()), rows)


def test_network_that_normalises_by_the_batch_is_refused():
    with pytest.raises(
        ForeignError, match="Normalised: it raised ValueError: Expected more than 1"
    ):
        advice(ControllerGuide(Normalised()), [1.0, 2.0])


def test_network_that_rounds_differently_in_a_batch_is_none_of_these():
    torch.manual_seed(0)
    network = nn.Sequential(nn.Linear(1, 300), nn.Tanh(), nn.Linear(300, 1)).half().float()
    guide, rows = ControllerGuide(network), torch.randn(9, 50)
    with torch.no_grad():
        expected = [network(each[:, None]).flatten().tolist() for each in rows]
        found = advice(guide, *(each.tolist() for each in rows))
    assert found == expected


class Beside(nn.Module):
    """Gives a row another number in a batch than alone."""

    def __init__(self, share):
        super().__init__()
        self.share = share

    def forward(self, observation):
        return observation * (1 + self.share * (len(observation) > 1))


def test_a_percent_of_the_largest_number_is_rounding_and_more_is_a_mixture_of_rows():
    advice(ControllerGuide(Beside(0.009)), [1.0, -0.5])
    with pytest.raises(ForeignError, match="mixes the rows"):
        advice(ControllerGuide(Beside(0.012)), [1.0, -0.5])


@pytest.mark.parametrize("network", [False, True])
def test_check_asks_in_the_first_call_only(network):
    asked = []

    def act(observation):
        asked.append(observation)
        return 2.0 * observation

    class Network(nn.Module):
        def forward(self, observation):
            return act(observation)

    guide = ControllerGuide(Network() if network else act)
    advice(guide, [1.0])
    asked.clear()
    assert advice(guide, *([float(step)] for step in range(100))) == [[2.0 * n] for n in range(100)]
    assert len(asked) == 100
