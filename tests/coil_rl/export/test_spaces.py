"""Observations and actions of every kind go through an exported policy as the env has them."""

import numpy as np
import pytest
from gymnasium import spaces
from learned_runs import TINY
from plants import Plant

import coil_rl

ACTIONS = {
    "from_1": spaces.Discrete(3, start=1),
    "several": spaces.MultiDiscrete([3, 2]),
    "binary": spaces.MultiBinary(2),
    "whole": spaces.Box(-2, 2, (1,), np.int64),
    "large": spaces.Box(200, 1000, (2,), np.float64),
    "scalar": spaces.Box(0, 1, (), np.float32),
}
OBSERVATIONS = spaces.Dict(
    {"gear": spaces.Discrete(3, start=1), "motion": spaces.Dict({"speed": spaces.Box(-1, 1, (2,))})}
)


class Gears(Plant):
    """Shows random observations for ten steps."""

    def __init__(self, kind="several"):
        super().__init__(OBSERVATIONS, ACTIONS[kind], end=10)


class First:
    """Guide that chooses the lowest number of every choice."""

    def act(self, gear):
        """Return the action for the entry `gear`."""
        return np.zeros(2, int)


def trained(folder, method="ppo", guide=None, **options):
    """Return a run in the env that has learned from one batch."""
    words = [word for word in TINY if not word.startswith("env.max_steps")]
    words += ["learner.minibatches=2", "learner.epochs=1", "learner.action_gain=1"]
    words += ["observes=[gear,[motion,speed]]"]
    words += [f"+env.options.{name}={value}" for name, value in options.items()]
    words += [] if guide is None else ["guide.controller.in_keys=[gear]"]
    run = coil_rl.prepare(
        Gears, guide=guide, method=method, frames=32, folder=folder, overrides=words
    )
    run.begin()
    run.learn()
    return run


@pytest.mark.slow
@pytest.mark.parametrize("kind", ACTIONS)
def test_action_is_what_the_env_takes(kind, tmp_path):
    run = trained(tmp_path / "run", kind=kind)
    policy = coil_rl.export_policy(run, tmp_path / "exported", observations=20)
    controller, space = run.controller(), ACTIONS[kind]
    OBSERVATIONS.seed(0)
    for _ in range(10):
        observation = OBSERVATIONS.sample()
        action = policy.act(observation)
        assert np.shape(action) == space.shape
        assert space.contains(action) or space.contains(np.int64(action))
        np.testing.assert_allclose(action, controller.act(observation), rtol=1e-5)
    speed = next(entry for entry in policy.contract["inputs"] if entry["name"] == "motion.speed")
    assert speed["from"]["path"] == ["motion", "speed"]


@pytest.mark.slow
def test_advice_of_choices_is_given_in_the_numbers_of_the_env(tmp_path):
    run = trained(tmp_path / "run", "coil", First, kind="several")
    policy = coil_rl.export_policy(run, tmp_path / "exported", observations=20)
    advice = policy.contract["inputs"][-1]
    assert (advice["name"], advice["shape"], advice["choices"]) == ("guide_action", [1, 2], [3, 2])
    controller = run.controller()
    for _ in range(5):
        observation = OBSERVATIONS.sample()
        own = controller.act(observation)
        np.testing.assert_array_equal(policy.act(observation, [[0, 0]]), own)
