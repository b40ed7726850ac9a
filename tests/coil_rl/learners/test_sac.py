import math

import pytest
import torch
import worlds
from torchrl.envs import GymEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from coil_rl.learners import SAC
from coil_rl.train.rollout import Rollout
from coil_rl.transforms import DiscreteActions


def learner(**options):
    torch.manual_seed(0)
    env = options.pop("env", None) or worlds.pendulum()
    sac = SAC(env, **{"in_keys": ["th", "thdot"], "hidden": [16], "starts": 0, "batch_size": 16, "ratio": 1} | options)
    return sac, Rollout(env, sac.policy, 32, sac.keys)


def minibatch_of(sac, rollout):
    minibatch = rollout.collect().select(*sac.keys).reshape(-1)
    minibatch["next", "terminated"][::3] = True
    return minibatch


def judge(sac, parameters, states, action):
    """What each of the critics with these parameters says, [2, N]."""
    data = states.select("th", "thdot").set("action", action)
    said = []
    for one in parameters.unbind(0):
        with one.to_module(sac.loss.qvalue_network):
            said.append(sac.loss.qvalue_network(data.copy())["state_action_value"].squeeze(-1))
    return torch.stack(said)


def drawn(sac, states):
    """An action of the policy with its log-probability."""
    distribution = sac.policy.get_dist(states.select("th", "thdot"))
    action = distribution.rsample()
    return action, distribution.log_prob(action)


def test_critics_learn_the_soft_value_of_the_next_state():
    """y = r + gamma (min Q'(s', b) - alpha log pi(b | s')), and y = r where an episode terminated."""
    sac, rollout = learner(gamma=0.9, temperature=0.5)
    data, params = minibatch_of(sac, rollout), sac.loss.qvalue_network_params
    with torch.no_grad():
        for value in params.values(True, True):  # so that the critics are not their copies any more
            value.add_(torch.randn_like(value), alpha=0.5)
        torch.manual_seed(1)
        action, log_prob = drawn(sac, data["next"])
        soft = judge(sac, sac.loss.target_qvalue_network_params, data["next"], action).min(0).values - 0.5 * log_prob
        target = (data["next", "reward"] + 0.9 * ~data["next", "terminated"] * soft.unsqueeze(-1)).squeeze(-1)
        wanted = (judge(sac, params, data, data["action"]) - target).square().sum(0).mean()
        torch.manual_seed(1)
        torch.testing.assert_close(sac.loss(data)["loss_qvalue"], wanted)


def test_the_policy_and_the_temperature_learn_from_its_own_actions():
    """The policy's loss is alpha log pi(a | s) - min Q(s, a), and log alpha's slope is minus (log pi + the target)."""
    sac, rollout = learner(temperature=0.5, target_entropy=-2.0)
    data = minibatch_of(sac, rollout)
    torch.manual_seed(1)
    drawn(sac, data["next"])  # of the critics' target, drawn first
    action, log_prob = drawn(sac, data)
    params = sac.loss.qvalue_network_params
    wanted = (0.5 * log_prob - judge(sac, params, data, action).min(0).values).mean()
    torch.manual_seed(1)
    losses = sac.loss(data)
    torch.testing.assert_close(losses["loss_actor"], wanted)
    torch.testing.assert_close(losses["loss_alpha"], -math.log(0.5) * (log_prob.mean() - 2.0))
    (slope,) = torch.autograd.grad(losses["loss_alpha"], sac.loss.log_alpha)
    torch.testing.assert_close(slope, 2.0 - log_prob.mean())


def test_no_loss_reaches_the_others_networks():
    sac, rollout = learner()
    data = minibatch_of(sac, rollout)
    actor, critics = list(sac.policy.parameters()), list(sac.loss.qvalue_network_params.values(True, True))
    losses = sac.loss(data)
    for name, own, others in (("actor", actor, critics), ("qvalue", critics, actor)):
        found = torch.autograd.grad(losses[f"loss_{name}"], [*own, *others], retain_graph=True, allow_unused=True)
        assert all(gradient is not None for gradient in found[: len(own)])
        assert all(gradient is None for gradient in found[len(own) :])


def test_both_critics_begin_differently_and_their_copies_follow_by_tau():
    sac, rollout = learner(tau=0.25, ratio=0.5)
    params, copies = sac.loss.qvalue_network_params, sac.loss.target_qvalue_network_params
    weights = params["module", "layers", "0", "weight"]
    assert not torch.equal(weights[0], weights[1])
    before = copies.clone()
    assert sac.update(rollout.collect())["minibatches"] == 1
    for key, value in copies.items(True, True):
        torch.testing.assert_close(value, 0.75 * before[key] + 0.25 * params[key].detach())


def test_the_spread_begins_at_its_scale_everywhere_and_then_depends_on_the_state():
    sac, rollout = learner(action_gain=0.0, action_scale=0.3, learning_rate=1e-2, ratio=8)
    batch = rollout.collect()
    before = sac.policy.get_dist(batch.select("th", "thdot"))
    torch.testing.assert_close(before.scale, torch.full((32, 1), 0.3))
    assert (before.deterministic_sample == 0).all()
    sac.update(batch)
    assert sac.policy.get_dist(batch.select("th", "thdot")).scale.std() > 1e-4


def test_the_temperature_falls_while_the_policy_is_wider_than_asked_for():
    for target, lower in ((-5.0, True), (5.0, False)):
        sac, rollout = learner(target_entropy=target, temperature=0.5, ratio=8)
        sac.update(rollout.collect())
        assert bool(sac.loss.log_alpha.exp() < 0.5) == lower


@pytest.mark.slow
def test_swings_the_pendulum_up():
    torch.manual_seed(0)
    env = GymEnv("Pendulum-v1")
    env.set_seed(0)
    # Critics of returns in the hundreds are steep: with them, the policy's gradients would be scaled down as well.
    sac = SAC(env, temperature=0.2, tau=0.02, ratio=128, starts=500, max_grad_norm=1e9)
    rollout = Rollout(env, sac.policy, 8, sac.keys)
    for _ in range(1_000):
        sac.update(rollout.collect())
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        returns = [float(env.rollout(200, sac.policy)["next", "reward"].sum()) for _ in range(20)]
    # A random policy gets -1200, a good one -160; single starts differ by 100, so that the mean is known to 25.
    assert sum(returns) / 20 > -230


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"gamma": 1.5}, "gamma=1.5 must be"), ({"tau": -1}, "tau=-1 must be"), ({"temperature": 0}, "temperature=0"),
        ({"learning_rate": -1}, "learning_rate=-1 must be"), ({"action_gain": -1}, "action_gain=-1"),
        ({"action_scale": 0}, "action_scale=0"), ({"hidden": [0]}, "hidden=0"), ({"ratio": -1}, "ratio=-1"),
        ({"max_grad_norm": 0}, "max_grad_norm=0"),
    ],
)  # fmt: skip
def test_numbers_outside_their_range_are_refused(options, words):
    with pytest.raises(ValueError, match=words):
        learner(**options)


def test_an_env_with_choices_is_refused():
    with pytest.raises(ValueError, match=r"SAC acts by numbers, but .* action=continuous, or take .* such as DQN"):
        SAC(worlds.pendulum(DiscreteActions(5)), ["th"])
