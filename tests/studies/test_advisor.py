import copy

import pytest
import torch
import worlds
from tensordict import TensorDict

from coil_rl.learners import PPO, KickstartLoss
from coil_rl.learners.batches import standardise
from coil_rl.run.rollout import Rollout
from coil_studies import Advisor


def make(env=None, in_keys=("observation",), **options):
    torch.manual_seed(0)
    env = env or worlds.cones()
    advisor = Advisor(env, in_keys, **{"epochs": 1, "minibatches": 2} | options)
    return advisor, Rollout(env, advisor.policy, 16, advisor.keys)


def minibatch_of(advisor, rollout):
    """Steps with advantages of a policy that has changed since it collected them."""
    batch = rollout.collect()
    with torch.no_grad():
        for parameter in [*advisor.policy.parameters(), *advisor.imitator.parameters()]:
            parameter.add_(torch.randn_like(parameter), alpha=0.1)
    return steps_of(advisor, batch)


def steps_of(advisor, batch):
    rows = advisor.prepare(batch, 0.0)
    return TensorDict(dict(rows), len(rows["action"]))


def distance(advisor, minibatch, categorical):
    distribution = advisor.imitator.get_dist(minibatch.select("observation"))
    if categorical:
        return -distribution.log_prob(minibatch["guide_action"][:, 0].argmax(-1))
    # In the bounds -1 and 1.
    return (minibatch["guide_action"][:, 0] - distribution.mode).abs().squeeze(-1)


@pytest.mark.parametrize("world", ["cones", "carts"])
def test_each_step_is_weighted_by_how_well_the_guide_can_be_imitated(world):
    advisor, rollout = make(getattr(worlds, world)(), alpha=2.0)
    data = minibatch_of(advisor, rollout)
    with torch.no_grad():
        losses = advisor.losses(data.clone())
        weight = (-2.0 * distance(advisor, data, world == "carts")).exp()
        assert weight.std() > 0.01
        imitation = KickstartLoss()
        now = advisor.policy.get_dist(data.select("observation")).log_prob(data["action"])
        ratio = (now - data["action_log_prob"]).exp()
        advantage = standardise(data["advantage"]).squeeze(-1)
        gain = torch.minimum(ratio * advantage, ratio.clamp(0.8, 1.2) * advantage)
        expected = (weight * imitation.each(advisor.policy, data) - (1 - weight) * gain).mean()
        torch.testing.assert_close(losses["weight"], weight.mean())
        imitated = imitation.each(advisor.imitator, data).mean()
        torch.testing.assert_close(losses["loss_imitation"], imitated)
    torch.testing.assert_close(losses["loss_objective"] - losses["loss_imitation"], expected)


def test_steps_that_nobody_can_imitate_are_learned_as_ppo_does():
    advisor, rollout = make(alpha=1e9)
    data = minibatch_of(advisor, rollout)
    with torch.no_grad():
        losses = advisor.losses(data.clone())
        log_prob = advisor.head.density(data.clone()).log_prob(data["action"])
        plain = PPO.objective(advisor, log_prob, data).mean()
    torch.testing.assert_close(losses["loss_objective"] - losses["loss_imitation"], plain)
    assert losses["weight"] < 1e-3


@pytest.mark.slow
def test_imitator_learns_from_the_guide_alone_and_tells_what_it_can_predict():
    advisor, rollout = make(learning_rate=1e-2)
    data = torch.cat([steps_of(advisor, rollout.collect()) for _ in range(4)])
    known = data["observation"][:, 0] > data["observation"][:, 0].median()
    coin = torch.randint(2, known.shape).float() * 1.6 - 0.8
    data["guide_action"][:, 0, 0] = torch.where(known, 0.5, coin)
    before = copy.deepcopy(advisor.critic.state_dict())
    for _ in range(150):
        advisor.gradient.minimise(advisor.losses(data.clone())["loss_imitation"])
    close = distance(advisor, data, categorical=False)
    assert close[known].mean() < 0.2 < 0.5 < close[~known].mean()
    assert all(
        torch.equal(value, before[key]) for key, value in advisor.critic.state_dict().items()
    )


def test_negative_alpha_is_refused():
    with pytest.raises(ValueError, match="alpha=-1 must be"):
        make(alpha=-1)
