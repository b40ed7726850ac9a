"""Learners solve CartPole-v1: a mean of 475 steps over 100 episodes; DQN with deterministic actions."""

import pytest
import torch
from cart_poles import CartPoles
from torchrl.envs import RewardSum, TransformedEnv

from coil_rl.learners import A2C, DQN, PPO, TRPO, Reinforce
from coil_rl.schedules import Linear
from coil_rl.train.evaluation import evaluate_policy
from coil_rl.train.rollout import Rollout


def frames_to_solve(learner, carts, steps, frames, seed=0, **options):
    """Number of frames until the env is solved; None if more than `frames`, the length of the schedules."""
    torch.manual_seed(seed)
    env = TransformedEnv(CartPoles(carts, seed), RewardSum())
    agent = learner(env, gamma=0.98, seed=seed, **options)
    rollout = Rollout(env, agent.policy, steps, [*agent.keys, ("next", "episode_reward")])
    lengths = []
    while rollout.taken * carts < frames:
        batch = rollout.collect()
        agent.update(batch, rollout.taken * carts / frames)
        # Time first, so that the last hundred are the latest.
        ended, length = (batch["next", key].transpose(0, 1) for key in ("done", "episode_reward"))
        lengths = [*lengths, *length[ended].tolist()][-100:]
        if len(lengths) == 100 and sum(lengths) >= 475 * 100:
            return rollout.taken * carts
    return None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("learner", "options"),
    [
        (PPO, {"carts": 16, "steps": 64, "frames": 200_000, "minibatches": 8}),
        (TRPO, {"carts": 32, "steps": 64, "frames": 200_000, "learning_rate": 1e-3, "max_kl": 0.01}),
        (A2C, {"carts": 16, "steps": 16, "frames": 300_000, "learning_rate": Linear(3e-3, 0.0), "gae_lambda": 0.8,
               "minibatches": 1}),
        (Reinforce, {"carts": 32, "steps": 128, "frames": 500_000, "learning_rate": Linear(1e-2, 0.0),
                     "minibatches": 1}),
    ],
)  # fmt: skip
def test_on_policy_learner_solves_cart_pole(learner, options):
    assert frames_to_solve(learner, **options) is not None


@pytest.mark.slow
def test_dqn_solves_cart_pole():
    torch.manual_seed(0)
    env = TransformedEnv(CartPoles(16), RewardSum())
    dqn = DQN(env, epsilon=Linear(1.0, 0.04, until=0.16), batch_size=64, ratio=32, starts=1_000)
    rollout = Rollout(env, dqn.policy, 16, dqn.keys)
    for update in range(195):  # 50,000 steps
        dqn.update(rollout.collect(update / 195), update / 195)
    assert evaluate_policy(CartPoles(100, seed=1), dqn.policy).mean_reward >= 475
