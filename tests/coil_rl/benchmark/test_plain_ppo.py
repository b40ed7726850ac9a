"""The hand-written loop is a yardstick only if it computes what ours computes."""

import copy

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.envs import TransformedEnv

from coil_rl.benchmark.plain_ppo import Batch, PlainPPO
from coil_rl.envs import ConeTrackEnv, shipped_tracks
from coil_rl.guides import SplineGuide
from coil_rl.learners import PPO
from coil_rl.transforms import GuideActions

OPTIONS = {"epochs": 2, "minibatches": 4, "learning_rate": 1e-3, "gamma": 0.98, "gae_lambda": 0.9}
CARS, STEPS = 12, 60


def linears(module):
    return [layer for layer in module.modules() if isinstance(layer, nn.Linear)]


@pytest.fixture(scope="module", params=["ppo", "coil"])
def made(request, ring):
    """Both learners with the same weights, and a batch that the plain one collected, in the language of each."""
    torch.manual_seed(0)
    guide = SplineGuide() if request.param == "coil" else None
    # Crashes on the narrow ring and a short time limit elsewhere, so that the batch holds both ends of an episode.
    env = ConeTrackEnv([ring, *shipped_tracks("test")], CARS, assignment="cyclic", time_limit=2.0)
    plain = PlainPPO(env, guide, STEPS, **OPTIONS)
    bare = ConeTrackEnv(shipped_tracks("train"), CARS)
    seen = bare if guide is None else TransformedEnv(bare, GuideActions({"guide": guide}))
    ours = PPO(seen, ["observation"] if guide is None else ["observation", "guide_action"], **OPTIONS)
    for mine, theirs in [(plain.actor, ours.policy), (plain.critic, ours.critic)]:
        for one, other in zip(linears(mine), linears(theirs), strict=True):
            one.load_state_dict(other.state_dict())
    plain.log_scale.data.copy_(ours.policy.module[0].module.log_scale)
    batch = plain.collect()
    return plain, ours, batch


@pytest.fixture
def pair(made):
    return copy.deepcopy(made)


def in_torchrl(batch: Batch, ours: PPO) -> TensorDict:
    """[B, T]."""

    def observed(both):
        parts = {"observation": both[..., :20]}
        return parts | ({"guide_action": both[..., 20:].unsqueeze(-1)} if both.shape[-1] > 20 else {})

    after = {"reward": batch.reward, "terminated": batch.terminated, "done": batch.done}
    rows = observed(batch.observation) | {"action": batch.raw.tanh(), "action_log_prob": batch.log_prob}
    rows["next"] = observed(batch.after) | {key: value.unsqueeze(-1) for key, value in after.items()}
    return TensorDict(rows, [STEPS, CARS]).transpose(0, 1).contiguous()


def test_batch_holds_every_kind_of_end(pair):
    _, _, batch = pair
    assert batch.terminated.any()
    assert (batch.done & ~batch.terminated).any()
    assert (~batch.done).any()
    same = torch.isclose(batch.after[:-1], batch.observation[1:]).all(-1)
    assert (same | batch.done[:-1]).all()


def test_log_probability_is_that_of_our_policy(pair):
    _, ours, batch = pair
    data = in_torchrl(batch, ours)
    with torch.no_grad():
        theirs = ours.policy.get_dist(data).log_prob(data["action"])
    torch.testing.assert_close(batch.log_prob.t(), theirs, atol=1e-5, rtol=1e-5)


def test_advantages_are_those_of_torchrl(pair):
    plain, ours, batch = pair
    data = in_torchrl(batch, ours)
    with torch.no_grad():
        ours.advantage(data)
    advantage, target = plain.advantages(batch)
    torch.testing.assert_close(advantage.t(), data["advantage"].squeeze(-1), atol=1e-4, rtol=1e-5)
    torch.testing.assert_close(target.t(), data["value_target"].squeeze(-1), atol=1e-4, rtol=1e-5)


def test_loss_is_that_of_torchrl_also_where_ratios_are_clipped(pair):
    plain, ours, batch = pair
    data = in_torchrl(batch, ours)
    shift = 0.5 * torch.randn_like(batch.log_prob)
    data["action_log_prob"] += shift.t()
    with torch.no_grad():
        ours.advantage(data)
        theirs = ours.loss(data.reshape(-1))
        advantage, target = plain.advantages(batch)
        columns = (batch.observation, batch.raw, batch.log_prob + shift, advantage, target)
        objective, critic = plain.losses(*(column.flatten(0, 1) for column in columns))
    assert theirs["clip_fraction"] > 0.1
    torch.testing.assert_close(objective, theirs["loss_objective"], atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(critic, theirs["loss_critic"], atol=1e-5, rtol=1e-5)


def test_an_update_leads_to_the_same_weights(pair):
    plain, ours, batch = pair
    # One order of samples for both, although the one counts by car first and the other by step.
    turned = Batch(*(column.transpose(0, 1).reshape(1, CARS * STEPS, *column.shape[2:]) for column in batch))
    advantage, target = (column.t().reshape(1, -1) for column in plain.advantages(batch))
    plain.advantages = lambda _: (advantage, target)  # type: ignore[method-assign]
    before = copy.deepcopy(plain.actor.state_dict())
    ours.update(in_torchrl(batch, ours))
    plain.update(turned)
    for mine, theirs in [(plain.actor, ours.policy), (plain.critic, ours.critic)]:
        for one, other in zip(linears(mine), linears(theirs), strict=True):
            torch.testing.assert_close(one.weight, other.weight, atol=2e-5, rtol=1e-4)
    torch.testing.assert_close(plain.log_scale, ours.policy.module[0].module.log_scale, atol=1e-5, rtol=1e-4)
    assert not torch.equal(before["0.weight"], plain.actor[0].weight)


def test_an_entropy_bonus_is_refused():
    with pytest.raises(ValueError, match=r"entropy=0.1 must be 0"):
        PlainPPO(ConeTrackEnv(shipped_tracks("train"), 2), None, 4, entropy=0.1)
