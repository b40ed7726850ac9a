"""Networks as guides: what acts is their `act`, if their class has one, else `forward`."""

from functools import partial
from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from coil_rl.guides import ControllerGuide
from coil_rl.transforms import GuideActions


class Actor(nn.Module):
    """As published ones: `forward` gives raw numbers, and `act` the action."""

    def __init__(self):
        super().__init__()
        self.layer, self.drop = nn.Linear(1, 1), nn.Dropout(0.9)
        nn.init.constant_(self.layer.weight, 1.0)
        nn.init.constant_(self.layer.bias, 0.0)
        self.count = 0

    def forward(self, observation):
        return 100.0 * self.drop(self.layer(observation))

    def act(self, observation):
        assert observation.shape == (1,)
        self.count += 1
        return torch.tanh(self.forward(torch.as_tensor(observation)) / 100.0) + self.count


def asked(guide, values, *, first):
    rows = len(values)
    entries = {
        "observation": torch.tensor(values)[:, None],
        "row": torch.arange(rows)[:, None],
        "is_init": torch.full((rows, 1), first),
    }
    return guide(TensorDict(entries, [rows]))["action"]


@pytest.mark.parametrize("given", [Actor, Actor()], ids=["class", "object"])
def test_network_with_act_is_asked_by_it_row_by_row(given):
    guide = ControllerGuide(given)
    for episode in range(2):
        for step in range(3):
            values = [0.3 + step, -0.5 * episode]
            expected = torch.tanh(torch.tensor(values))[:, None] + step + 1
            found = asked(guide, values, first=step == 0)
            torch.testing.assert_close(found, expected)  # each episode has a copy of its own
    if not isinstance(given, type):
        assert given.count == 0
        assert given.training


def test_rows_share_the_weights_of_a_network():
    guide = ControllerGuide(Actor)
    asked(guide, [0.0, 0.0], first=True)
    one, other = (host.thing for host in guide.guide.hosts.values())
    assert one is not other
    assert one.layer.weight is other.layer.weight


def test_activation_that_is_called_act_is_no_controller():
    class Net(nn.Module):
        def __init__(self):
            super().__init__()
            self.act, self.layer = nn.ReLU(), nn.Linear(1, 1)

        def forward(self, observation):
            return -self.act(observation)

    class Shared(nn.Module):
        act = nn.ReLU()

        def forward(self, observation):
            return -self.act(observation)

    for given in (Net, Net(), Shared, Shared()):
        found = ControllerGuide(given)(TensorDict({"observation": torch.tensor([[2.0]])}, [1]))
        assert found["action"].item() == -2.0


def test_act_that_needs_more_is_refused_at_construction():
    class Needs(nn.Module):
        def act(self, observation, state):
            return observation

    for given in (Needs, Needs()):
        with pytest.raises(
            ValueError, match=r"Needs.act takes \(observation, state\), but is call"
        ):
            ControllerGuide(given)


def test_guides_are_in_evaluation_mode_from_the_start():
    network = nn.Sequential(nn.BatchNorm1d(1), nn.Dropout())
    assert not GuideActions({"theirs": ControllerGuide(network)}).guides.training


class Remembering(nn.Module):
    """Remembers in a part of its own, in ways that torch does not save."""

    def __init__(self, memory):
        super().__init__()
        self.layer, self.part = nn.Linear(1, 1), nn.Identity()
        self.part.memory, self.settings = memory, SimpleNamespace(gain=2.0)
        self.register_buffer("sum", torch.zeros(1), persistent=False)

    def act(self, observation):
        self.sum += torch.as_tensor(observation)
        self.part.memory = self.part.memory + type(self.part.memory)([float(self.sum)])
        return self.layer(self.sum) + self.settings.gain * sum(self.part.memory)

    def reset(self):
        self.sum.zero_()
        self.part.memory = type(self.part.memory)()


@pytest.mark.parametrize("begun", [False, True])
def test_network_that_remembers_what_torch_does_not_save_begins_new_episodes(begun):
    guide = ControllerGuide(Remembering([]))
    asked(guide, [0.5, -1.0], first=True)
    if not begun:
        for host in guide.guide.hosts.values():
            host.thing.reset()
        guide.load_state_dict(guide.state_dict())
        assert guide.guide.continues
        return
    with pytest.warns(UserWarning, match="for all that it remembers, so new episodes begin"):
        guide.load_state_dict(guide.state_dict())
    assert not guide.guide.continues


class Recurrent(nn.Module):
    """Its memory is a buffer, and its layer holds its weights a second time, in plain lists."""

    def __init__(self, kind):
        super().__init__()
        self.layer, self.constants = kind(1, 1), [torch.full((1,), torch.nan)]
        self.register_buffer("memory", torch.zeros(1, 1))

    def act(self, observation):
        self.memory = self.layer(torch.as_tensor(observation)[None], self.memory)[1]
        return self.memory[0]


@pytest.mark.parametrize("kind", [nn.GRU, nn.RNN])
@pytest.mark.parametrize("of_class", [False, True])
def test_recurrent_network_goes_on_with_its_episodes(kind, of_class):
    make = partial(Recurrent, kind)
    guide = ControllerGuide(make if of_class else make())
    asked(guide, [0.5, -1.0], first=True)
    state = guide.state_dict()
    expected = asked(guide, [0.1, 0.2], first=False)
    guide.load_state_dict(state)
    assert guide.guide.continues
    assert torch.equal(asked(guide, [0.1, 0.2], first=False), expected)
