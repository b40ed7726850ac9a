import pytest
import torch
import worlds
from any_env import AnyEnv, learning
from torch.distributions import AffineTransform, Normal, TanhTransform, TransformedDistribution
from torch.nn import functional as F
from torchrl.data import MultiCategorical

from coil_rl.learners import PPO, SAC, FilteredKickstartLoss, KickstartLoss
from coil_rl.learners.kickstart import EDGE
from coil_rl.learners.policy import Entries
from coil_rl.run.rollout import Rollout
from coil_rl.schedules import Linear


def make(env, in_keys=("observation",), steps=16):
    """A policy for the env, and a minibatch of its steps."""
    torch.manual_seed(0)
    ppo = PPO(env, in_keys)
    batch = Rollout(env, ppo.policy, steps, [*ppo.keys, "guide_action"]).collect()
    return ppo.policy, batch.reshape(-1)


def test_likelihood_is_that_of_the_action_of_the_guide():
    policy, minibatch = make(worlds.cones())
    minibatch["guide_action"].clamp_(EDGE - 1, 1 - EDGE)
    imitated = minibatch.select("observation").set("action", minibatch["guide_action"][:, 0])
    expected = -policy.log_prob(imitated).mean()
    torch.testing.assert_close(KickstartLoss().each(policy, minibatch).mean(), expected)


@pytest.mark.parametrize("kind", ["likelihood", "divergence"])
def test_loss_is_finite_for_actions_at_their_bounds(kind):
    policy, minibatch = make(worlds.cones())
    minibatch["guide_action"].fill_(1.0)
    loss = KickstartLoss(kind=kind).each(policy, minibatch).mean()
    loss.backward()
    assert loss.isfinite()
    assert all(p.grad.isfinite().all() for p in policy.parameters())


def test_divergence_equals_its_estimate_from_samples():
    policy, minibatch = make(worlds.pendulum(), ["th", "thdot"])
    with torch.no_grad():
        next(p for name, p in policy.named_parameters() if name.endswith("log_scale")).fill_(-1.0)
        loss = KickstartLoss(kind="divergence", scale=0.3).each(policy, minibatch).mean()
        distribution = policy.get_dist(minibatch.select(*policy.in_keys))
        base = Normal((minibatch["guide_action"][:, 0] / 2).clamp(EDGE - 1, 1 - EDGE).atanh(), 0.3)
        guide = TransformedDistribution(base, [TanhTransform(), AffineTransform(0.0, 2.0)])
        drawn = guide.sample((40_000,))
        sampled = (guide.log_prob(drawn).sum(-1) - distribution.log_prob(drawn)).mean()
    assert loss.item() == pytest.approx(sampled.item(), rel=0.02)


@pytest.mark.parametrize("categorical", [True, False])
def test_loss_of_discrete_actions_is_the_cross_entropy(categorical):
    policy, minibatch = make(worlds.carts(categorical=categorical))
    chosen = minibatch["guide_action"][:, 0].argmax(-1)
    logits = policy.get_dist(minibatch.select("observation")).logits
    expected = torch.nn.functional.cross_entropy(logits, chosen)
    for kind in ("likelihood", "divergence"):
        torch.testing.assert_close(
            KickstartLoss(kind=kind).each(policy, minibatch).mean(), expected
        )


def test_loss_of_several_choices_is_their_cross_entropy():
    torch.manual_seed(0)
    env = AnyEnv(8, MultiCategorical([2, 4]))
    policy = PPO(env, action_gain=2.0).policy
    data = env.reset()
    advised = torch.stack([torch.randint(n, (8,)) for n in (2, 4)], -1)
    one_hot = torch.cat(
        [F.one_hot(advised[:, index], n) for index, n in enumerate((2, 4))], -1
    ).float()
    loss = KickstartLoss().each(policy, data.set("guide_action", one_hot.unsqueeze(1))).mean()
    torch.testing.assert_close(loss, -policy.get_dist(data).log_prob(advised).mean())


def replay(auxiliary):
    """SAC with critics that differ, and a minibatch of its steps."""
    torch.manual_seed(0)
    options = {"critics": 3, "auxiliary": [auxiliary], "action_gain": 1.0}
    sac, rollout = learning(SAC, worlds.cones(), **options)
    with torch.no_grad():
        vector = sac.of_critics.vector
        vector.add_(torch.randn_like(vector), alpha=0.3)
    return sac, rollout, rollout.collect().reshape(-1)


@pytest.mark.parametrize("soft", [False, True])
def test_imitation_is_weighted_by_the_opinion_of_the_critics(soft):
    filtered = FilteredKickstartLoss(soft=soft)
    sac, _, data = replay(filtered)
    own = sac.actor.get_dist(data.select("observation")).mode
    both = [
        filtered.critics.values(data.copy().set("action", a))
        for a in (data["guide_action"][:, 0], own)
    ]
    gain, spread = both[0].mean(0) - both[1].mean(0), (both[0].var(0) + both[1].var(0)).sqrt()
    weight = Normal(0.0, 1.0).cdf(gain / spread) if soft else (gain > 0).float()
    assert 0.05 < weight.mean() < 0.95
    torch.testing.assert_close(
        filtered.each(sac.actor, data).mean(),
        (weight * KickstartLoss().each(sac.actor, data)).mean(),
    )


def test_loss_is_added_to_that_of_the_policy_of_sac_by_its_schedule():
    sac, rollout, data = replay(KickstartLoss(Linear(3.0, 0.0)))
    assert {"guide_action", ("next", "guide_action")} <= set(sac.stored_keys)
    for progress, coefficient in ((0.0, 3.0), (1.0, 0.0)):
        weights = sac.loss_weights(progress)
        assert weights == dict.fromkeys(sac.minimised, 1.0) | {"loss_guide": coefficient}
        torch.testing.assert_close(
            sac.losses(Entries(data.items(True, True)))["loss_guide"],
            KickstartLoss().each(sac.actor, data).mean(),
        )
    assert sac.update(rollout.collect())["loss_guide"] != 0
