"""MultiBinary(n) is MultiDiscrete([2] * n): the same digits, and actions in the env's numbers."""

import numpy as np
import pytest
from gymnasium import spaces
from odd_parts import Plain

import coil_rl

TINY = ["budget.num_envs=2", "budget.steps=32", "evaluation.cases=2", "logger=none"]
TINY += ["evaluation.curve.num_envs=2", "evaluation.curve.points=1"]
SPACES = (spaces.MultiBinary(3), spaces.MultiDiscrete([2, 2, 2]))


class Switches(Plain):
    """Two switches follow the signs of two numbers, the third one should be on."""

    def step(self, action):
        if not self.action_space.contains(action):
            raise ValueError(f"{action!r} is no action")
        reward = float((np.asarray(action) == [*(self.seen > 0), True]).mean())
        seen, _, *ends = super().step(0.0)
        return seen, reward, *ends


class Flags(Switches):
    action_space = SPACES[0]


class Numbers(Switches):
    action_space = SPACES[1]


def signs(observation):
    """The two signs, and the third switch off: two thirds of the reward."""
    return np.array([*(observation > 0), False]).astype(int)


def trained(env, folder, method, *overrides):
    guide = None if method == "ppo" else signs
    words = [*TINY, *overrides]
    return coil_rl.train(
        env, guide=guide, method=method, frames=192, folder=folder, overrides=words
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "learner"),
    [("ppo", "ppo"), ("coil", "ppo"), ("ppo", "a2c"), ("ppo", "trpo"), ("rfc", "ppo")],
)
def test_policy_learns_the_same_with_flags_as_with_numbers(method, learner, tmp_path):
    words = ["learner.minibatches=2"] if learner == "ppo" else [f"learner={learner}", *TINY]
    logs, actions = [], []
    observation = np.array([0.5, -0.5], np.float32)
    for env in (Flags, Numbers):
        run = trained(env, tmp_path / env.__name__, method, *words)
        files = ("metrics.csv", "evaluation.csv")
        logs.append([(run.folder / file).read_text() for file in files])
        actions.append(run.controller().act(observation))
    assert logs[0] == logs[1]
    for action, space in zip(actions, SPACES, strict=True):
        assert space.contains(action)
    assert actions[0].tolist() == actions[1].tolist()


@pytest.mark.slow
def test_imitation_does_what_the_guide_does(tmp_path):
    run = trained(Flags, tmp_path / "run", "oil", "learner.regressor.n_estimators=3")
    for observation in ([0.5, -0.5], [-0.5, -0.5], [0.5, 0.5]):
        observation = np.array(observation, np.float32)
        action = run.controller().act(observation)
        assert SPACES[0].contains(action)
        assert action.tolist() == signs(observation).tolist()
