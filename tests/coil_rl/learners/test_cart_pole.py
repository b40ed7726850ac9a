"""Learners solve CartPole-v1: a mean of 475 steps over 100 episodes; DQN without random actions."""

import pytest
import torch
from cart_poles import CartPoles
from torchrl.envs import RewardSum, TransformedEnv

from coil_rl.learners import A2C, DQN, PPO, TRPO, Reinforce
from coil_rl.run.evaluation import evaluate_policy
from coil_rl.run.rollout import Rollout
from coil_rl.schedules import Linear


@pytest.mark.slow
@pytest.mark.parametrize(
    ("learner", "carts", "steps", "frames", "options"),
    [
        (PPO, 16, 64, 200_000, {"minibatches": 8}),
        (TRPO, 32, 64, 200_000, {"learning_rate": 1e-3, "max_kl": 0.01}),
        (
            A2C,
            16,
            16,
            300_000,
            {"learning_rate": Linear(3e-3, 0.0), "gae_lambda": 0.8, "minibatches": 1},
        ),
        (Reinforce, 32, 128, 500_000, {"learning_rate": Linear(1e-2, 0.0), "minibatches": 1}),
    ],
)
def test_on_policy_learner_solves_cart_pole(learner, carts, steps, frames, options):
    torch.manual_seed(0)
    env = TransformedEnv(CartPoles(carts), RewardSum())
    agent = learner(env, gamma=0.98, **options)
    rollout = Rollout(env, agent.policy, steps, [*agent.keys, ("next", "episode_reward")])
    lengths, best = [], 0
    while rollout.taken * carts < frames and best < 475:
        batch = rollout.collect()
        agent.update(batch, rollout.taken * carts / frames)
        # Time first, so that the last hundred are the latest.
        ended, length = (batch["next", key].transpose(0, 1) for key in ("done", "episode_reward"))
        lengths = [*lengths, *length[ended].tolist()][-100:]
        best = max(best, sum(lengths) / 100)
    assert best >= 475


@pytest.mark.slow
def test_dqn_solves_cart_pole():
    torch.manual_seed(0)
    env = TransformedEnv(CartPoles(16), RewardSum())
    dqn = DQN(
        env,
        epsilon=Linear(1.0, 0.04, until=0.16),
        batch_size=64,
        updates_per_step=0.5,
        starts=1_000,
    )
    rollout = Rollout(env, dqn.policy, 16, dqn.keys)
    for update in range(195):  # 50,000 steps
        dqn.update(rollout.collect(update / 195), update / 195)
    assert evaluate_policy(CartPoles(100, seed=1), dqn.policy).mean_reward >= 475
