"""One convention for a controller: it means the same wherever one is taken."""

from functools import partial

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from plants import UNIT, Plant
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import nn
from torchrl.envs import TransformedEnv

from coil_rl import AdviceObservation, ControllerGuide, EntryGuide, GuideActions, GymnasiumEnv

GAINS = np.array([0.3, -0.2, 0.1], np.float32)
STEPS = 4


def brake(observation):
    """Return the torque [1] for an observation, or [B, 1] for those of all rows."""
    x, y, speed = (observation[..., entry] for entry in range(3))
    return (0.3 * x - 0.2 * y + 0.1 * speed)[..., None]


def of_tensors(observation):
    """Take tensors only."""
    return torch.einsum("...i,i->...", observation, torch.from_numpy(GAINS)).unsqueeze(-1)


class Brake:
    """A controller of one row, which counts its steps."""

    def __init__(self, offset=0.0):
        self.offset = offset

    def reset(self):
        self.steps = 0

    def act(self, observation):
        self.steps += 1
        return brake(observation) + self.offset * self.steps


class Network(nn.Module):
    """A network, whose numbers are the gains."""

    def __init__(self):
        super().__init__()
        self.gains = nn.Parameter(torch.from_numpy(GAINS))

    def forward(self, observation):
        return (observation * self.gains).sum(-1, keepdim=True)


class Acting(Network):
    """A network with `act`."""

    def act(self, observation):
        with torch.no_grad():
            return self(torch.as_tensor(observation)).numpy()


class Remembers(TensorDictModuleBase):
    """A module that adds up what it advised, in an entry."""

    in_keys = ["observation", "sum"]  # noqa: RUF012
    out_keys = ["action", ("next", "sum")]  # noqa: RUF012

    def make_tensordict_primer(self):
        from torchrl.data import Unbounded
        from torchrl.envs import TensorDictPrimer

        return TensorDictPrimer(sum=Unbounded(1))

    def forward(self, data):
        action = 0.5 * data["sum"] + of_tensors(data["observation"])
        return data.update(TensorDict({"action": action, "next": {"sum": action}}))


class Model:
    """A trained model of another library."""

    def predict(self, observation, deterministic=False):
        return brake(np.asarray(observation)), None


def module():
    return TensorDictModule(of_tensors, ["observation"], ["action"])


CONTROLLERS = {
    "a function": lambda: brake,
    "a function of tensors": lambda: of_tensors,
    "a class": lambda: Brake,
    "an object": lambda: Brake(0.1),
    "a network": Network,
    "a class of networks": lambda: Network,
    "a network with act": Acting,
    "a model": Model,
    "a module": module,
    "a module with a memory": Remembers,
    "a name": lambda: f"{__name__}:Brake",
}


def in_a_transform(controller):
    env = GymnasiumEnv("Pendulum-v1", first_seed=3)
    env = TransformedEnv(env, GuideActions({"it": controller}))
    return advice(env, "guide_action")


def advice(env, key):
    still = env.rollout(STEPS, lambda td: td.set("action", torch.zeros(1, 1)))
    return still[key][0].flatten(1)


def in_the_env(controller):
    env = GymnasiumEnv("Pendulum-v1", first_seed=3, controllers={"it": controller})
    return advice(env, ("controller", "it"))


def in_the_observation(controller):
    env = AdviceObservation(gymnasium.make("Pendulum-v1"), controller)
    observation, seen = env.reset(seed=3)[0], []
    for _ in range(STEPS):
        seen.append(torch.as_tensor(2 * observation[3:]))  # advice is in units of the bound
        observation, *_ = env.step(np.zeros(1, np.float32))
    return torch.stack(seen)


@pytest.mark.fast(2)
@pytest.mark.parametrize("kind", CONTROLLERS)
def test_controller_means_the_same_everywhere(kind):
    make = CONTROLLERS[kind]
    expected = in_a_transform(make())
    assert expected.abs().max() > 0.1
    for found in (in_the_env(make()), in_the_observation(make())):
        torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)


def of_env(env, observation):
    return brake(observation) * (env.unwrapped.g > 0)


class OfEnv(Brake):
    def __init__(self, env):
        super().__init__(0.0 * env.unwrapped.g)


@pytest.mark.parametrize("controller", [of_env, OfEnv])
def test_controller_with_a_parameter_env_gets_it_beside_the_env_only(controller):
    expected = in_a_transform(brake)
    torch.testing.assert_close(in_the_env(controller), expected)
    torch.testing.assert_close(in_the_observation(controller), expected)
    with pytest.raises(ValueError, match=r"asks for its env: let it act beside that, by guide=ent"):
        ControllerGuide(controller)


def test_what_cannot_act_is_refused_everywhere():
    for take in (in_a_transform, in_the_env, in_the_observation):
        with pytest.raises(ValueError, match="act"):
            take(object())


def linear(inputs):
    network = nn.Linear(inputs, 1)
    nn.init.constant_(network.weight, 0.1)
    return network


def square(observation):
    return [[observation[0], 0.25], [-0.5, 0.5 * observation[1]]]


def one_hot(observation):
    return [0, 1, 0, 0, 1]


PAIR = spaces.Box(-1, 1, (2,))


@pytest.mark.parametrize(
    ("space", "actions", "controller"),
    [
        (spaces.Discrete(3, start=4), UNIT, linear(3)),
        (spaces.MultiDiscrete([2, 3]), UNIT, linear(5)),
        (spaces.Box(-3, 3, (2,), np.int64), UNIT, linear(2)),
        (PAIR, spaces.Box(-1, 1, (2, 2)), square),
        (PAIR, spaces.Discrete(5, start=-2), lambda observation: [0, 0, 0, 1, 0]),
        (PAIR, spaces.MultiDiscrete([2, 3], start=[1, -1]), one_hot),
    ],
)
def test_controller_reads_and_gives_the_same_numbers_everywhere(space, actions, controller):
    make = partial(GymnasiumEnv, lambda: Plant(space, actions, STEPS), first_seed=1)
    transformed = TransformedEnv(make(), GuideActions({"it": controller}))
    expected = transformed.reset()["guide_action"].flatten()
    beside = make(controllers={"it": controller})
    found = TransformedEnv(beside, GuideActions({"it": EntryGuide(("controller", "it"))}))
    torch.testing.assert_close(found.reset()["guide_action"].flatten(), expected)
    wrapped = AdviceObservation(Plant(space, actions), controller)
    wrapped.reset(seed=1)
    torch.testing.assert_close(torch.from_numpy(wrapped.advice), expected)
