"""`AdviceObservation` in Stable-Baselines3."""

import warnings

import gymnasium
import numpy as np
import pytest

from coil_rl import AdviceObservation

stable_baselines3 = pytest.importorskip("stable_baselines3")


def lean(env, observation):
    return int(observation[2] > 0)


def brake(env, observation):
    return -np.clip(observation[2:], -2, 2)


def as_dict(env):
    return gymnasium.wrappers.TransformObservation(
        env,
        lambda observation: {"seen": observation},
        gymnasium.spaces.Dict({"seen": env.observation_space}),
    )


WORLDS = {
    "choices": (lambda: gymnasium.make("CartPole-v1"), lean, "MlpPolicy"),
    "numbers": (lambda: gymnasium.make("Pendulum-v1"), brake, "MlpPolicy"),
    "dict": (
        lambda: as_dict(gymnasium.make("CartPole-v1")),
        lambda env, observation: lean(env, observation["seen"]),
        "MultiInputPolicy",
    ),
}


@pytest.mark.parametrize("name", WORLDS)
def test_env_with_advice_passes_their_checks_and_is_learned_in(name):
    from stable_baselines3.common.env_checker import check_env

    make, guide, policy = WORLDS[name]
    env = AdviceObservation(make(), guide)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # an action that is not from -1 to 1 is advised against
        check_env(env)
    learner = stable_baselines3.PPO(policy, env, n_steps=64, batch_size=32, n_epochs=1, seed=0)
    learner.learn(128)
    observation, _ = env.reset(seed=0)
    action, _ = learner.predict(observation)
    assert env.action_space.contains(action)
