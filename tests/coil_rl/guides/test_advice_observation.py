"""Advice in the observation of any Gymnasium env."""

import warnings

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from plants import Plant

from coil_rl import AdviceObservation
from coil_rl.foreign.faults import ForeignError

VECTOR = spaces.Box(-1.0, 1.0, (3,), np.float64)
OBSERVATIONS = {
    "vector": VECTOR,
    "image": spaces.Box(0, 255, (4, 4, 3), np.uint8),
    "discrete": spaces.Discrete(4),
    "dict": spaces.Dict({"a": VECTOR, "b": spaces.Discrete(2)}),
    "tuple": spaces.Tuple((VECTOR, spaces.Discrete(2))),
}
ACTIONS = {
    "box": spaces.Box(np.array([0.0, -np.inf], np.float32), np.array([4.0, np.inf], np.float32)),
    "matrix": spaces.Box(-2.0, 2.0, (2, 2)),
    "scalar": spaces.Box(-2.0, 2.0, ()),
    "discrete": spaces.Discrete(3, start=5),
    "several": spaces.MultiDiscrete([2, 3]),
    "binary": spaces.MultiBinary(3),
}


class Spaces(Plant):
    """Any spaces; an episode terminates in its fourth step."""

    def step(self, action):
        observation, reward, _, _, info = super().step(action)
        return observation, reward, self.time == 4, False, info


class Count:
    """A controller with a memory: it takes the action 0, 1, 2 ... of an episode."""

    def __init__(self, env):
        self.env, self.resets = env, 0

    def reset(self):
        self.step, self.resets = -1, self.resets + 1

    def act(self, observation):
        self.step += 1
        return self.step


def wrapped(observation="vector", action="box", controller=None):
    env = Spaces(OBSERVATIONS[observation], ACTIONS[action])
    always = env.action_space.sample()
    return AdviceObservation(env, controller or (lambda env, observation: always))


@pytest.mark.parametrize("action", ACTIONS)
@pytest.mark.parametrize("observation", OBSERVATIONS)
def test_wrapped_env_is_an_env_of_gymnasium(observation, action):
    env = wrapped(observation, action)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it is no registered env, and is wrapped
        check_env(env, skip_render_check=True)
    given, _ = env.reset(seed=0)
    for _ in range(4):
        assert env.observation_space.contains(given), given
        given, *_ = env.step(env.action_space.sample())


@pytest.mark.parametrize(
    ("action", "given", "observed"),
    [
        ("box", [1.0, 7.0], [-0.5, 7.0]),
        ("box", [9.0, 0.0], [1.0, 0.0]),
        ("matrix", [[1.0, 2.0], [-2.0, 0.0]], [0.5, 1.0, -1.0, 0.0]),
        ("scalar", 1.0, [0.5]),
        ("discrete", 6, [0.0, 1.0, 0.0]),
        ("several", [1, 2], [0.0, 1.0, 0.0, 0.0, 1.0]),
    ],
)
def test_advice_is_normalised_as_networks_here_read_it(action, given, observed):
    env = wrapped(action=action, controller=lambda env, observation: np.asarray(given))
    observation, _ = env.reset(seed=0)
    assert observation[3:].tolist() == observed
    assert env.advice.tolist() == observed


def test_controller_with_a_memory_begins_each_episode_anew():
    env = AdviceObservation(Spaces(VECTOR, spaces.Discrete(6)), Count)
    for _ in range(2):
        env.reset(seed=0)
        seen = [int(env.advice.argmax())]
        for _ in range(4):
            env.step(0)
            seen.append(int(env.advice.argmax()))
        # The env terminates in its fourth step, after which nobody asks.
        assert seen == [0, 1, 2, 3, 3]


@pytest.mark.parametrize("given", [float("nan"), None, [1.0], "left", [[1.0, 2.0]]])
def test_what_is_no_action_is_refused(given):
    env = wrapped(controller=lambda env, observation: given)
    with pytest.raises(ForeignError, match=r"^the controller advice \(row 0, step 0\): "):
        env.reset()


def test_entry_of_the_same_name_is_refused():
    env = Spaces(spaces.Dict({"guide_action": VECTOR}), ACTIONS["box"])
    with pytest.raises(ValueError, match="has an entry 'guide_action' already"):
        AdviceObservation(env, lambda env, observation: 0)
