import math

import pytest
import torch
import worlds
from torchrl.envs import GymEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from coil_rl.learners import SAC
from coil_rl.train.rollout import Rollout


def make(**options):
    torch.manual_seed(0)
    env = options.pop("env", None) or worlds.pendulum()
    sac = SAC(env, **{"in_keys": ["th", "thdot"], "hidden": [16], "starts": 0, "batch_size": 16, "ratio": 1} | options)
    return sac, Rollout(env, sac.policy, 32, sac.keys)


def minibatch_of(sac, rollout):
    minibatch = rollout.collect().select(*sac.keys).reshape(-1)
    minibatch["next", "terminated"][::3] = True
    return minibatch


def action_values(sac, parameters, states, action):
    """Values of both critics with these parameters, [2, N]."""
    data = states.select("th", "thdot").set("action", action)
    values = []
    for one in parameters.unbind(0):
        with one.to_module(sac.loss.qvalue_network):
            values.append(sac.loss.qvalue_network(data.copy())["state_action_value"].squeeze(-1))
    return torch.stack(values)


def sample(sac, states):
    """A random action of the policy, and its log-probability."""
    distribution = sac.policy.get_dist(states.select("th", "thdot"))
    action = distribution.rsample()
    return action, distribution.log_prob(action)


def test_critics_learn_the_soft_value_of_the_next_state():
    """y = r + gamma (min Q'(s', b) - alpha log pi(b | s')), and y = r where an episode terminated."""
    sac, rollout = make(gamma=0.9, temperature=0.5)
    data, params = minibatch_of(sac, rollout), sac.loss.qvalue_network_params
    assert not torch.equal(*params["module", "layers", "0", "weight"])
    with torch.no_grad():
        for value in params.values(True, True):  # critics and target networks must differ
            value.add_(torch.randn_like(value), alpha=0.5)
        torch.manual_seed(1)
        action, log_prob = sample(sac, data["next"])
        soft = (
            action_values(sac, sac.loss.target_qvalue_network_params, data["next"], action).min(0).values
            - 0.5 * log_prob
        )
        target = (data["next", "reward"] + 0.9 * ~data["next", "terminated"] * soft.unsqueeze(-1)).squeeze(-1)
        expected = (action_values(sac, params, data, data["action"]) - target).square().sum(0).mean()
        torch.manual_seed(1)
        torch.testing.assert_close(sac.loss(data)["loss_qvalue"], expected)


def test_policy_and_temperature_learn_from_actions_of_the_policy():
    """The policy's loss is alpha log pi(a | s) - min Q(s, a); the gradient for log alpha is -(log pi + target)."""
    sac, rollout = make(temperature=0.5, target_entropy=-2.0)
    data = minibatch_of(sac, rollout)
    torch.manual_seed(1)
    sample(sac, data["next"])  # the target of the critics is sampled first
    action, log_prob = sample(sac, data)
    params = sac.loss.qvalue_network_params
    expected = (0.5 * log_prob - action_values(sac, params, data, action).min(0).values).mean()
    torch.manual_seed(1)
    losses = sac.loss(data)
    torch.testing.assert_close(losses["loss_actor"], expected)
    torch.testing.assert_close(losses["loss_alpha"], -math.log(0.5) * (log_prob.mean() - 2.0))
    (slope,) = torch.autograd.grad(losses["loss_alpha"], sac.loss.log_alpha)
    torch.testing.assert_close(slope, 2.0 - log_prob.mean())


def test_standard_deviation_is_initially_the_scale_in_every_state():
    sac, rollout = make(action_gain=0.0, action_scale=0.3, learning_rate=1e-2, ratio=8)
    batch = rollout.collect()
    before = sac.policy.get_dist(batch.select("th", "thdot"))
    torch.testing.assert_close(before.scale, torch.full((32, 1), 0.3))
    assert (before.deterministic_sample == 0).all()
    sac.update(batch)
    assert sac.policy.get_dist(batch.select("th", "thdot")).scale.std() > 1e-4


@pytest.mark.slow
def test_swings_the_pendulum_up():
    torch.manual_seed(0)
    env = GymEnv("Pendulum-v1")
    env.set_seed(0)
    # With returns in the hundreds, a small norm of all gradients would scale the gradients of the policy to nearly 0.
    sac = SAC(env, temperature=0.2, tau=0.02, ratio=128, starts=500, max_grad_norm=1e9)
    rollout = Rollout(env, sac.policy, 8, sac.keys)
    for _ in range(1_000):
        sac.update(rollout.collect())
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        returns = [float(env.rollout(200, sac.policy)["next", "reward"].sum()) for _ in range(20)]
    # A random policy gets -1200, a good one -160. Single starts differ by 100, so the standard error is 25.
    assert sum(returns) / 20 > -230
