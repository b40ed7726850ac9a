"""The losses of the learners against the equations of the paper, computed step by step."""

import math

import pytest
import torch
import worlds

from coil_rl.learners import A2C, TRPO, Reinforce
from coil_rl.learners.batches import add_advantages
from coil_rl.run.rollout import Rollout

GAMMA, LAMBDA = 0.9, 0.8


def make(kind, **options):
    """A learner and a batch, 3 cars x 6 steps: a crash, a truncation and unfinished episodes."""
    torch.manual_seed(0)
    env = worlds.cones(cars=3)
    learner = kind(env, action_gain=0.5, gamma=GAMMA, **options)
    batch = Rollout(env, learner.policy, 6, learner.keys).collect()
    batch["next", "reward"] = torch.randn(3, 6, 1)
    for key in ("done", "terminated"):
        batch["next", key].zero_()
    batch["next", "done"][0, 2] = batch["next", "terminated"][0, 2] = True
    batch["next", "done"][1, 3] = True
    return learner, batch


def log_probability(learner, rows):
    """Log-probability of a squashed normal distribution, by its formula."""
    with torch.no_grad():
        mean, scale = learner.policy.module[0].module(rows["observation"])
    action = rows["action"]
    normal = (
        -((action.atanh() - mean) ** 2) / (2 * scale**2) - scale.log() - math.log(2 * math.pi) / 2
    )
    return (normal - (1 - action**2).log()).squeeze(-1)


def values(learner, rows):
    with torch.no_grad():
        return learner.critic(rows.select("observation"))["state_value"].squeeze(-1)


def backwards(learner, batch, decay):
    """Recursion x_t = r + gamma V' - V + decay x_(t+1)."""
    before, after = values(learner, batch), values(learner, batch["next"])
    result = torch.zeros(3, 6)
    for car in range(3):
        later = 0.0
        for t in reversed(range(6)):
            ends = batch["next", "terminated"][car, t, 0]
            if batch["next", "done"][car, t, 0]:
                later = 0.0
            bootstrap = 0.0 if ends else GAMMA * after[car, t]
            error = batch["next", "reward"][car, t, 0] + bootstrap - before[car, t]
            later = result[car, t] = error + decay * later
    return result


def losses_of(learner, batch):
    add_advantages(batch, learner.critic, GAMMA, learner.gae_lambda)
    losses = learner.losses(batch.select(*learner.minibatch_keys).reshape(-1))
    return losses["loss_objective"].detach(), losses["loss_critic"].detach()


def close(one, other):
    torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("kind", "decay", "weight", "options"),
    [
        (Reinforce, 1.0, 1.0, {"standardise": False}),
        (Reinforce, 1.0, 0.0, {"standardise": False, "baseline": "none"}),
        (A2C, LAMBDA, 0.5, {"standardise": False, "gae_lambda": LAMBDA, "critic": 0.5}),
        (A2C, LAMBDA, 0.5, {"standardise": True, "gae_lambda": LAMBDA, "critic": 0.5}),
    ],
)
def test_equations_67_and_76(kind, decay, weight, options):
    """The advantage of Reinforce is the bootstrapped return minus the baseline: lambda is 1."""
    learner, batch = make(kind, **options)
    loss_objective, loss_critic = losses_of(learner, batch)
    advantage = backwards(learner, batch, GAMMA * decay)
    close(loss_critic, weight * (advantage**2).mean())
    if options["standardise"]:
        advantage = (advantage - advantage.mean()) / advantage.std()
    close(loss_objective, -(log_probability(learner, batch) * advantage).mean())


def test_equations_89_and_90():
    """The metrics of a step: mean of ratio times advantage, and divergence of the distributions."""
    learner, batch = make(TRPO, gae_lambda=LAMBDA, max_kl=0.05)
    add_advantages(batch, learner.critic, GAMMA, learner.gae_lambda)
    rows = batch.select(*learner.minibatch_keys).reshape(-1)
    with torch.no_grad():
        mean, scale = learner.policy.module[0].module(rows["observation"])
    old = log_probability(learner, batch).flatten()
    report = learner.improve(rows)
    advantage = backwards(learner, batch, GAMMA * LAMBDA)
    advantage = ((advantage - advantage.mean()) / advantage.std()).flatten()
    with torch.no_grad():
        new_mean, new_scale = learner.policy.module[0].module(rows["observation"])
    ratio = (log_probability(learner, batch).flatten() - old).exp()
    torch.testing.assert_close(
        report["loss_objective"], -(ratio * advantage).mean(), rtol=1e-3, atol=1e-4
    )
    divergence = (
        (new_scale / scale).log() + (scale**2 + (mean - new_mean) ** 2) / (2 * new_scale**2) - 0.5
    )
    torch.testing.assert_close(report["kl"], divergence.mean(), rtol=1e-3, atol=1e-5)
    assert 0 < report["kl"] <= 0.05
