"""The losses of SAC and its relatives, written out."""

import math

import pytest
import torch
import worlds
from torch.nn import functional as F
from torchrl.envs import GymEnv, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from coil_rl.learners import SAC, TQC, CrossQ, Mlp
from coil_rl.learners.policy import Entries
from coil_rl.run.policy_batch import policy_batch
from coil_rl.run.rollout import Rollout

SMALL = {"hidden": [16], "starts": 0, "batch_size": 16, "updates_per_step": 0.0625}


def make(kind=SAC, **options):
    torch.manual_seed(0)
    env = worlds.pendulum()
    sac = kind(env, ["th", "thdot"], **SMALL | options)
    return sac, Rollout(env, sac.policy, 32, sac.keys)


def minibatch_of(sac, rollout):
    steps = rollout.collect().select(*sac.keys).reshape(-1)
    steps["next", "terminated"][::3] = True
    return Entries(steps.items(True, True))


def spread(sac):
    """Make the critics and their target networks differ."""
    with torch.no_grad():
        for vector in (sac.of_critics.vector, sac.of_target.vector):
            vector.add_(torch.randn_like(vector), alpha=0.5)


def value_of(critics, number, states, action):
    """The outputs of one critic, layer by layer, [N, n]."""
    x = torch.cat([states["th"].unsqueeze(-1), states["thdot"].unsqueeze(-1), action], -1)
    for place, layer in enumerate(critics.layers):
        if place and critics.norm == "layer":
            norm = critics.norms[place - 1]
            x = F.layer_norm(x, x.shape[-1:], norm.gain[number, 0], norm.shift[number, 0])
        if place:
            x = F.relu(x)
        if critics.norm == "batch":
            norm = critics.norms[place]
            weights = norm.gain[number, 0], norm.shift[number, 0]
            x = F.batch_norm(x, None, None, *weights, training=True, eps=1e-3)
        x = x @ layer.weight[number] + layer.bias[number, 0]
    return x * critics.gain


def values_of(critics, states, action):
    """The outputs of all critics, [critics, N, n]."""
    return torch.stack([value_of(critics, n, states, action) for n in range(critics.count)])


def after(minibatch):
    return {key[1]: value for key, value in minibatch.items() if key[0] == "next"}


def sample(sac, states):
    """A random action of the policy, and its log-probability."""
    density = sac.actor.density(Entries({key: states[key] for key in ("th", "thdot")}))
    action, _ = density.draw()
    return action, density.log_prob(action)


def soft_target(sac, data, action, log_prob, value):
    soft = value - float(sac.alpha) * log_prob
    live = ~data["next", "terminated"].squeeze(-1)
    return data["next", "reward"].squeeze(-1) + 0.9 * live * soft


@pytest.mark.parametrize(
    "options",
    [{"critic_layer_norm": norm} for norm in (True, False)] + [{"critics": 5, "target_critics": 2}],
    ids=["normalised", "plain", "drawn"],
)
def test_losses_of_critics_policy_and_temperature(options):
    """y = r + gamma (min Q'(s', b) - alpha log pi(b | s')); y = r where an episode terminated.

    The loss of the policy is alpha log pi(a | s) - min Q(s, a), that by log alpha -(log pi +
    target). Of many critics some are drawn for the target, and the policy maximises their mean.
    """
    sac, rollout = make(gamma=0.9, temperature=0.5, target_entropy=-2.0, **options)
    spread(sac)
    data, many = minibatch_of(sac, rollout), "critics" in options
    torch.manual_seed(1)
    with torch.no_grad():
        action, log_prob = sample(sac, after(data))
        following = values_of(sac.target, after(data), action)
        if many:
            following = following[torch.randperm(5)[:2]]
        target = soft_target(sac, data, action, log_prob, following.amin(0).squeeze(-1))
        values = values_of(sac.critics, data, data["action"]).squeeze(-1)
        expected = (values - target).square().sum(0).mean()
        action, log_prob = sample(sac, data)
        own = values_of(sac.critics, data, action).squeeze(-1)
        value = own.mean(0) if many else own.amin(0)
    torch.manual_seed(1)
    losses = sac.losses(data)
    torch.testing.assert_close(losses["loss_qvalue"].detach(), expected)
    torch.testing.assert_close(losses["loss_actor"].detach(), (0.5 * log_prob - value).mean())
    slope = torch.autograd.grad(losses["loss_alpha"], sac.temperature["log_alpha"])[0]
    torch.testing.assert_close(slope, 2.0 - log_prob.mean())


def test_each_loss_has_gradients_for_its_own_networks_only():
    sac, rollout = make()
    data = minibatch_of(sac, rollout)
    vectors = {"loss_actor": sac.of_actor.vector, "loss_qvalue": sac.of_critics.vector}
    for name, own in vectors.items():
        for vector in vectors.values():
            gradient = torch.autograd.grad(sac.losses(data)[name], vector, allow_unused=True)[0]
            assert (gradient is None) == (vector is not own)
    assert sac.of_target.vector.grad is None


def test_gradient_of_the_policy_is_that_of_a_written_out_step():
    """The same minibatch and noise with functions of `torch.nn` alone."""
    sac, rollout = make(critic_layer_norm=False)
    data = minibatch_of(sac, rollout)
    actor = [p.detach().clone().requires_grad_() for p in sac.actor.parameters()]
    x = torch.stack([data["th"], data["thdot"]], -1)
    for place in range(0, len(actor), 2):
        x = F.linear(x.relu() if place else x, *actor[place : place + 2])
    loc, scale = x.chunk(2, -1)
    scale = F.softplus(scale + math.log(math.expm1(0.99))) + 0.01  # 1 where the network gives 0
    torch.manual_seed(1)
    sample(sac, after(data))
    number = loc + torch.empty(32, 1).normal_() * scale
    log_prob = torch.distributions.Normal(loc, scale).log_prob(number)
    # The logarithm of the slope of 2 tanh.
    slope = math.log(2) + 2 * (math.log(2) - number - F.softplus(-2 * number))
    log_prob = (log_prob - slope).sum(-1)
    value = values_of(sac.critics, data, 2 * number.tanh()).amin(0).squeeze(-1)
    written = torch.autograd.grad((float(sac.alpha) * log_prob - value).mean(), actor)
    torch.manual_seed(1)
    found = torch.autograd.grad(sac.losses(data)["loss_actor"], sac.of_actor.vector)[0]
    expected = torch.cat([each.flatten() for each in written])
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6)


def test_target_networks_follow_by_tau():
    sac, rollout = make(tau=0.25)
    before = sac.of_target.vector.clone()
    sac.update(rollout.collect())
    learned = sac.of_critics.vector.detach()
    assert not torch.equal(learned, before)
    sac.of_target.vector.data.copy_(before)
    sac.after_update()
    torch.testing.assert_close(sac.of_target.vector, 0.75 * before + 0.25 * learned)
    views = sac.of_target._views(sac.of_target.vector)
    pairs = zip(views, sac.target.parameters(), strict=True)
    assert all(torch.equal(view, parameter) for view, parameter in pairs)


def test_standard_deviation_is_initially_the_scale_in_every_state():
    sac, rollout = make(action_gain=0.0, action_scale=0.3, learning_rate=1e-2, updates_per_step=0.5)
    batch = rollout.collect()
    before = sac.policy.get_dist(batch.select("th", "thdot"))
    torch.testing.assert_close(before.scale, torch.full((32, 1), 0.3))
    assert (before.mode == 0).all()
    sac.update(batch)
    assert sac.policy.get_dist(batch.select("th", "thdot")).scale.std() > 1e-4


def test_first_actions_are_almost_uniform():
    sac, _ = make()
    states = {"th": torch.zeros(100_000), "thdot": torch.zeros(100_000)}
    with torch.no_grad():
        action = sample(sac, states)[0]
    shares = torch.histc(action, 8, -2, 2) / len(action)
    assert 0.09 < shares.min() < shares.max() < 0.17  # 0.125 each


@pytest.mark.slow
@pytest.mark.parametrize("kind", [SAC, TQC])
def test_swings_the_pendulum_up(kind):
    torch.manual_seed(0)
    env = TransformedEnv(GymEnv("Pendulum-v1"))
    env.set_seed(0)
    sac = kind(env, scale_rewards=True)
    rollout = Rollout(env, sac.policy, 32, sac.keys)
    for _ in range(220):
        sac.update(rollout.collect())
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        returns = [float(env.rollout(200, sac.policy)["next", "reward"].sum()) for _ in range(20)]
    # A random policy gets -1200, a good one -150. Single starts differ by 100, so the standard
    # error is 25.
    assert sum(returns) / 20 > -250


def test_crossq_normalises_both_states_together_and_has_no_target_networks():
    sac, rollout = make(CrossQ, gamma=0.9, temperature=0.5)
    data, norm = minibatch_of(sac, rollout), sac.critics.norms[0]
    torch.manual_seed(1)
    with torch.no_grad():
        action, log_prob = sample(sac, after(data))
        entries = {
            key: torch.cat([data[key], {"action": action, **after(data)}[key]])
            for key in ("th", "thdot", "action")
        }
        values, following = values_of(sac.critics, entries, entries["action"]).chunk(2, 1)
        value = following.amin(0).squeeze(-1)
        target = soft_target(sac, data, action, log_prob, value)
        expected = (values.squeeze(-1) - target).square().sum(0).mean()
    torch.manual_seed(1)
    torch.testing.assert_close(sac.losses(data)["loss_qvalue"].detach(), expected)
    read = torch.stack([entries["th"], entries["thdot"], entries["action"][:, 0]], -1)
    mean = read.mean(0)
    torch.testing.assert_close(norm.mean[0, 0], mean * 0.01)
    before = norm.mean.clone()
    sac.critics.values(data)  # as in the loss of the policy
    assert torch.equal(norm.mean, before)
    assert sac.target is None


def test_critics_of_crossq_normalise_batches_also_with_layers_that_are_normalised():
    network = Mlp([16], "relu", layer_norm=True)
    assert make(CrossQ, network=network)[0].critics.norm == "batch"
    assert make(SAC, network=network)[0].critics.norm == "layer"


def test_tqc_leaves_out_the_largest_quantiles_of_all_critics():
    sac, rollout = make(TQC, quantiles=4, dropped=1, gamma=0.9, temperature=0.5)
    spread(sac)
    data = minibatch_of(sac, rollout)
    torch.manual_seed(1)
    with torch.no_grad():
        action, log_prob = sample(sac, after(data))
        every = values_of(sac.target, after(data), action)
        kept = torch.cat([every[0], every[1]], -1).sort(-1).values[:, :6]
        targets = torch.stack(
            [soft_target(sac, data, action, log_prob, kept[:, n]) for n in range(6)], -1
        )
        expected, levels = 0.0, (0.125, 0.375, 0.625, 0.875)
        for quantiles in values_of(sac.critics, data, data["action"]):
            for level, quantile in zip(levels, quantiles.unbind(-1), strict=True):
                error = targets - quantile.unsqueeze(-1)
                huber = torch.where(error.abs() < 1, error.square() / 2, error.abs() - 0.5)
                expected += ((level - (error < 0).float()).abs() * huber).mean() / 4
        action, log_prob = sample(sac, data)
        mean = values_of(sac.critics, data, action).mean((0, 2))
    torch.manual_seed(1)
    losses = sac.losses(data)
    torch.testing.assert_close(losses["loss_qvalue"].detach(), expected)
    torch.testing.assert_close(losses["loss_actor"].detach(), (0.5 * log_prob - mean).mean())


def test_dropout_acts_in_learning_only():
    sac, rollout = make(dropout=0.5)
    data = minibatch_of(sac, rollout)
    with torch.no_grad():
        fixed = [sac.critics.outputs(data) for _ in range(2)]
        drawn = [sac.critics.outputs(data, train=True) for _ in range(2)]
    assert torch.equal(*fixed)
    assert not torch.equal(*drawn)


@pytest.mark.parametrize(
    "many", [{}, {"critics": 4, "target_critics": 2}], ids=["two critics", "drawn critics"]
)
def test_uncertainty_is_the_standard_deviation_of_the_critics(many):
    sac, rollout = make(uncertainty=True, **many)
    spread(sac)
    assert sac.update(rollout.collect())["uncertainty"] > 0
    data = minibatch_of(sac, rollout)
    measured = sac.describe(data)["uncertainty"]
    states = rollout.collect().select("th", "thdot")
    with torch.no_grad():
        values = values_of(sac.critics, data, data["action"])
        assert measured == pytest.approx(float(values.std(0).mean()), rel=1e-4)
        acted = sac.policy(states.copy())
        values = values_of(sac.critics, states, acted["action"])
    torch.testing.assert_close(acted["next", "uncertainty"], values.std(0))
    policies = policy_batch(sac.policy, [sac.policy.state_dict()])
    assert policies(states)["next", "uncertainty"].shape == (32, 1)
