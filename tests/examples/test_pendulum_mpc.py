import gymnasium
import numpy as np
import pytest

pytest.importorskip("casadi")

from examples.pendulum_mpc import MPC


def test_plan_swings_the_pendulum_up_and_holds_it() -> None:
    env, controller = gymnasium.make("Pendulum-v1"), MPC()
    observation, _ = env.reset(seed=1)
    rewards = []
    for _ in range(60):
        observation, reward, *_ = env.step(controller.act(observation))
        rewards.append(reward)
    assert min(rewards[-10:]) > -0.05


def test_a_plan_depends_on_its_own_episode_only() -> None:
    one, other = MPC(), MPC()
    observation = np.array([-1.0, 0.0, 0.5])
    first = one.act(observation)
    one.act(observation)
    one.reset()
    np.testing.assert_array_equal(one.act(observation), first)
    np.testing.assert_array_equal(other.act(observation), first)
