"""Several guides as one, each on its own part of the rows."""

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from tensordict import TensorDict
from torchrl.envs import TransformedEnv

from coil_rl import GymnasiumEnv, evaluate_policy
from coil_rl.foreign.controllers import PerRow
from coil_rl.guides.classic import Oscillator
from coil_rl.guides.simple import ConstantGuide, FollowAdvice
from coil_rl.transforms import GuideActions
from coil_rl.transforms.guide_memory import GuideMemory
from coil_rl.tune.candidates import Candidates


class Counter:
    """Controller that pushes harder with each step, by its gain."""

    def __init__(self, gain=1.0):
        self.gain, self.steps = gain, 0

    def act(self, observation):
        self.steps += 1
        return [self.gain * self.steps]


def test_each_guide_acts_in_its_own_part_of_the_rows():
    candidates = Candidates([ConstantGuide(1.0), ConstantGuide(2.0), ConstantGuide(3.0)])
    rows = TensorDict({"observation": torch.zeros(6, 4)}, [6])
    assert candidates(rows)["action"].flatten().tolist() == [1, 1, 2, 2, 3, 3]
    candidates.replace([ConstantGuide(5.0), ConstantGuide(6.0)])
    assert candidates(rows)["action"].flatten().tolist() == [5, 5, 5, 6, 6, 6]


def test_controllers_with_a_state_have_one_object_for_each_row():
    guides = [PerRow(lambda gain=gain: Counter(gain)) for gain in (0.1, 0.2)]
    env = GymnasiumEnv("Pendulum-v1", 4)
    env = TransformedEnv(env, GuideActions({"counter": Candidates(guides)}))
    advice = env.rollout(3)["guide_action"].squeeze()
    expected = torch.tensor([[0.1, 0.2, 0.3]] * 2 + [[0.2, 0.4, 0.6]] * 2)
    assert torch.allclose(advice, expected)


class Room(gymnasium.Env):
    """An episode of 3 to 11 steps, drawn by its seed; the reward is the action."""

    observation_space, action_space = spaces.Box(-1, 1, (1,)), spaces.Box(-99, 99, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.left = int(self.np_random.integers(3, 12))
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.left -= 1
        return np.zeros(1, np.float32), float(action[0]), False, self.left == 0, {}


def test_controllers_are_not_asked_after_the_end_of_an_episode():
    asked = []

    class Asked(Counter):
        def act(self, observation):
            asked.append(self.gain)
            return super().act(observation)

    guides = [PerRow(lambda gain=gain: Asked(gain)) for gain in (0.5, 1.0)]
    env = TransformedEnv(GymnasiumEnv(Room, 8), GuideActions({"it": Candidates(guides)}))
    episodes = evaluate_policy(env, FollowAdvice(env)).episodes
    steps = [episode["steps"] for episode in episodes]
    assert len(set(steps)) > 2
    for gain, part in ((0.5, slice(0, 4)), (1.0, slice(4, 8))):
        assert asked.count(gain) == sum(steps[part])
        for episode in episodes[part]:
            assert episode["reward"] == gain * sum(range(1, episode["steps"] + 1))


def test_memory_of_the_guides_is_declared_once():
    memory = GuideMemory("swim", Candidates([Oscillator(), Oscillator(frequency=0.3)]))
    assert list(memory.specs) == ["swum_steps"]
