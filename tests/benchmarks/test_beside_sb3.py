"""The comparison with Stable-Baselines3."""

import pytest
import torch

from benchmarks.beside_sb3 import VALUES, main, mean_return, ours

SHORT = {
    "ppo": {"steps": 32},
    "sac": {"starts": 20, "minibatch": 16},
    "dqn": {"starts": 20, "minibatch": 16},
}
ENVS = {"ppo": "CartPole-v1", "sac": "Pendulum-v1", "dqn": "CartPole-v1"}


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", VALUES)
def test_our_learner_trains_with_the_shared_values(algorithm):
    frames = 512 if algorithm == "ppo" else 40
    env, values = ENVS[algorithm], VALUES[algorithm] | SHORT[algorithm]
    act, rate = ours(algorithm, env, values, frames, seed=0)
    assert rate > 0
    assert mean_return(env, act) == mean_return(env, act)  # fixed seeds, no random numbers


def test_mean_return_is_that_of_complete_episodes():
    # Pushing to one side only, a cart falls after 8 to 10 steps.
    def push(observation):
        return torch.zeros(len(observation), dtype=torch.long)

    assert 8 <= mean_return("CartPole-v1", push) <= 10


def test_both_are_trained_and_printed(capsys):
    pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed")
    main(["dqn", "CartPole-v1", "--frames", "40", "--seeds", "2"])
    printed = capsys.readouterr().out
    assert "ours" in printed
    assert "Stable-Baselines3" in printed
