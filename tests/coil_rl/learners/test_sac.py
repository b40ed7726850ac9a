import math

import pytest
import torch
import worlds
from torchrl.envs import GymEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from coil_rl.learners import SAC
from coil_rl.run.policy_batch import policy_batch
from coil_rl.run.rollout import Rollout


def make(**options):
    torch.manual_seed(0)
    env = options.pop("env", None) or worlds.pendulum()
    sac = SAC(
        env,
        **{"in_keys": ["th", "thdot"], "hidden": [16], "starts": 0, "batch_size": 16, "ratio": 1}
        | options,
    )
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
    action, _ = distribution.draw()
    return action, distribution.log_prob(action)


def test_critics_learn_the_soft_value_of_the_next_state():
    """y = r + gamma (min Q'(s', b) - alpha log pi(b | s')); y = r where an episode terminated."""
    sac, rollout = make(gamma=0.9, temperature=0.5)
    data, params = minibatch_of(sac, rollout), sac.loss.qvalue_network_params
    assert not torch.equal(*params["module", "layers", "0", "weight"])
    with torch.no_grad():
        for value in params.values(True, True):  # critics and target networks must differ
            value.add_(torch.randn_like(value), alpha=0.5)
        torch.manual_seed(1)
        action, log_prob = sample(sac, data["next"])
        soft = (
            action_values(sac, sac.loss.target_qvalue_network_params, data["next"], action)
            .min(0)
            .values
            - 0.5 * log_prob
        )
        target = (
            data["next", "reward"] + 0.9 * ~data["next", "terminated"] * soft.unsqueeze(-1)
        ).squeeze(-1)
        expected = (
            (action_values(sac, params, data, data["action"]) - target).square().sum(0).mean()
        )
        torch.manual_seed(1)
        torch.testing.assert_close(sac.loss(data)["loss_qvalue"], expected)


def test_policy_and_temperature_learn_from_actions_of_the_policy():
    """The loss is alpha log pi(a | s) - min Q(s, a), that by log alpha -(log pi + target)."""
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
    # With returns in the hundreds, a small norm of all gradients would scale the gradients of the
    # policy to nearly 0.
    sac = SAC(env, temperature=0.2, tau=0.02, ratio=128, starts=500, max_grad_norm=1e9)
    rollout = Rollout(env, sac.policy, 8, sac.keys)
    for _ in range(1_000):
        sac.update(rollout.collect())
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        returns = [float(env.rollout(200, sac.policy)["next", "reward"].sum()) for _ in range(20)]
    # A random policy gets -1200, a good one -160. Single starts differ by 100, so the standard
    # error is 25.
    assert sum(returns) / 20 > -230


def spread(sac):
    """Make the critics and their target networks differ."""
    with torch.no_grad():
        for value in sac.loss.qvalue_network_params.values(True, True):
            value.add_(torch.randn_like(value), alpha=0.5)


def test_some_of_many_critics_are_drawn_for_the_target_and_the_policy_maximises_their_mean():
    sac, rollout = make(critics=5, target_critics=2, gamma=0.9, temperature=0.5)
    spread(sac)
    data, params = minibatch_of(sac, rollout), sac.loss.qvalue_network_params
    torch.manual_seed(1)
    drawn = torch.randperm(5)[:2].sort().values
    both = torch.stack([data.select("th", "thdot"), data["next"].select("th", "thdot")])
    action, log_prob = sample(sac, both)
    with torch.no_grad():
        after = action_values(sac, sac.loss.target_qvalue_network_params, data["next"], action[1])[
            drawn
        ].amin(0)
        soft = (after - 0.5 * log_prob[1]).unsqueeze(-1)
        target = (data["next", "reward"] + 0.9 * ~data["next", "terminated"] * soft).squeeze(-1)
        error = (action_values(sac, params, data, data["action"]) - target).square().mean()
        mean = action_values(sac, params, data, action[0]).mean(0)
    torch.manual_seed(1)
    losses = sac.loss(data)
    torch.testing.assert_close(losses["loss_qvalue"], error)
    torch.testing.assert_close(losses["loss_actor"], (0.5 * log_prob[0] - mean).mean())


def test_layers_of_the_critics_alone_are_normalised():
    sac, _ = make(critic_layer_norm=True, hidden=[16, 8], critics=3)
    weights = sac.loss.qvalue_network_params
    assert weights["module", "layers", "1", "weight"].shape == (3, 16)
    assert weights["module", "layers", "4", "weight"].shape == (3, 8)
    assert not any(isinstance(module, torch.nn.LayerNorm) for module in sac.policy.modules())


@pytest.mark.parametrize(
    "many", [{}, {"critics": 4, "target_critics": 2}], ids=["two critics", "drawn critics"]
)
def test_uncertainty_is_the_standard_deviation_of_the_critics(many):
    sac, rollout = make(uncertainty=True, **many)
    spread(sac)
    assert sac.update(rollout.collect())["uncertainty"] > 0
    data = minibatch_of(sac, rollout)
    measured = sac.describe(data)["uncertainty"]
    with torch.no_grad():
        values = action_values(sac, sac.loss.qvalue_network_params, data, data["action"])
        assert measured == pytest.approx(float(values.std(0).mean()), rel=1e-4)
        acted = sac.policy(data.select("th", "thdot"))
        values = action_values(sac, sac.loss.qvalue_network_params, data, acted["action"])
    torch.testing.assert_close(acted["next", "uncertainty"], values.std(0).unsqueeze(-1))
    policies = policy_batch(sac.policy, [sac.policy.state_dict()])
    assert policies(data.select("th", "thdot"))["next", "uncertainty"].shape == (32, 1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"critics": 1}, "critics=1 must be"),
        (
            {"critics": 4, "target_critics": 4},
            "target_critics=4 must be at least 1 and less than critics=4",
        ),
        ({"prior": 0.5}, r"prior=0\.5 needs steps in which a guide acts"),
        ({"prior": 1.5}, r"prior=1\.5 must be"),
    ],
)
def test_invalid_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        make(**options)
