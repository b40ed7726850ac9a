"""PPO by hand is a yardstick only if its numbers are those of `coil_rl.learners.PPO`."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.envs import TransformedEnv

from benchmarks.ppo import Batch, PlainPPO
from coil_rl.envs import ConeTrackEnv, shipped_tracks
from coil_rl.guides import SplineGuide
from coil_rl.learners import PPO
from coil_rl.transforms import GuideActions

OPTIONS = {
    "epochs": 2,
    "minibatches": 4,
    "learning_rate": 1e-3,
    "gamma": 0.98,
    "gae_lambda": 0.9,
    "clip": 0.2,
    "hidden": [64, 64],
    "action_scale": 0.5,
    "action_gain": 0.01,
    "entropy": 0.0,
    "critic": 0.5,
    "max_grad_norm": 0.5,
    "seed": 0,
}
CARS, STEPS = 12, 60


def linears(module):
    return [layer for layer in module.modules() if isinstance(layer, nn.Linear)]


def layers_of(plain, ours):
    """Pairs of corresponding layers."""
    return zip(
        linears(plain.actor) + linears(plain.critic),
        linears(ours.policy) + linears(ours.critic),
        strict=True,
    )


def log_scale(policy):
    """The parameter of the policy that belongs to no linear layer."""
    layers = {id(parameter) for layer in linears(policy) for parameter in layer.parameters()}
    (scale,) = (parameter for parameter in policy.parameters() if id(parameter) not in layers)
    return scale


@pytest.fixture(params=["ppo", "coil"])
def made(request, ring):
    """Both learners with the same weights, and a batch with crashes and truncated episodes."""
    torch.manual_seed(0)
    guide = SplineGuide() if request.param == "coil" else None
    env = ConeTrackEnv([ring, *shipped_tracks("test")], CARS, assignment="cyclic", time_limit=2.0)
    plain = PlainPPO(env, guide, STEPS, **OPTIONS)
    bare = ConeTrackEnv(shipped_tracks("train"), CARS)
    advised = bare if guide is None else TransformedEnv(bare, GuideActions({"guide": guide}))
    ours = PPO(
        advised, ["observation"] if guide is None else ["observation", "guide_action"], **OPTIONS
    )
    for one, other in layers_of(plain, ours):
        one.load_state_dict(other.state_dict())
    plain.log_scale.data.copy_(log_scale(ours.policy))
    return plain, ours, plain.collect()


def as_tensordict(batch: Batch) -> TensorDict:
    """The batch of `PPO`, [B, T]."""

    def observed(both):
        parts = {"observation": both[..., :20]}
        return parts | (
            {"guide_action": both[..., 20:].unsqueeze(-1)} if both.shape[-1] > 20 else {}
        )

    after = {"reward": batch.reward, "terminated": batch.terminated, "done": batch.done}
    rows = observed(batch.observation) | {
        "action": batch.raw.tanh(),
        "action_log_prob": batch.log_prob,
    }
    rows["next"] = observed(batch.after) | {
        key: value.unsqueeze(-1) for key, value in after.items()
    }
    return TensorDict(rows, [STEPS, CARS]).transpose(0, 1).contiguous()


@pytest.mark.slow
@pytest.mark.parametrize("shift", [0.0, 0.5], ids=["near ratios", "clipped ratios"])
def test_update_gives_the_same_weights(made, shift):
    plain, ours, batch = made
    assert batch.terminated.any()
    assert (batch.done & ~batch.terminated).any()
    data = as_tensordict(batch)
    with torch.no_grad():
        expected = ours.policy.get_dist(data).log_prob(data["action"])
    torch.testing.assert_close(batch.log_prob.t(), expected, atol=1e-5, rtol=1e-5)
    batch = batch._replace(log_prob=batch.log_prob + shift * torch.randn_like(batch.log_prob))
    before = plain.actor[0].weight.detach().clone()
    metrics = ours.update(as_tensordict(batch))
    plain.update(batch)
    assert (metrics["clip_fraction"] > 0.1) == (shift > 0)
    for one, other in layers_of(plain, ours):
        torch.testing.assert_close(one.weight, other.weight, atol=2e-5, rtol=1e-4)
    torch.testing.assert_close(plain.log_scale, log_scale(ours.policy), atol=1e-5, rtol=1e-4)
    assert not torch.equal(before, plain.actor[0].weight)
