"""Every way to learn from a guide with replay, in envs with any numbers as actions."""

import pytest
import torch
from any_env import AnyEnv, learning
from tensordict.nn import TensorDictModule
from torchrl.data import Bounded
from torchrl.envs import Compose, TransformedEnv

from coil_rl.learners import SAC, FilteredKickstartLoss
from coil_rl.testing import check_env
from coil_rl.transforms import AdaptiveMixedAction, GradualResidual, GuideActions, Takeover
from coil_studies import IBRL

MANY = {"critics": 4, "target_critics": 2, "critic_layer_norm": True}
WAYS = {
    "warm start": ([lambda: Takeover(1.0, 16)], SAC, MANY),
    "prior steps": ([lambda: Takeover(0.5)], SAC, {"prior": 0.5, "normalise": True}),
    "adaptive": ([lambda: AdaptiveMixedAction(warm_up=16)], SAC, {"uncertainty": True}),
    "gradual residual": ([lambda: GradualResidual(0.5, probability=0.5)], SAC, {}),
    "proposals": ([], IBRL, {"edit": 0.2, "sharpness": 3.0}),
    "filter": ([], SAC, {"auxiliary": [FilteredKickstartLoss(soft=True)]}),
}


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", [(2,), (2, 3)], ids=["vector", "matrix"])
@pytest.mark.parametrize("way", WAYS)
def test_it_learns_from_any_numbers(way, shape, dtype):
    transforms, kind, options = WAYS[way]
    halves = TensorDictModule(
        lambda seen: seen.new_full((*seen.shape[:-1], *shape), 0.5), ["observation"], ["action"]
    )
    world = AnyEnv(8, Bounded(-1, 1, shape, dtype=dtype), dtype=dtype)
    guides = GuideActions({"halves": halves})
    env = TransformedEnv(world, Compose(guides, *(make() for make in transforms))).train()
    check_env(env, steps=3)
    observed = ["observation", "agent_weight"] if way == "adaptive" else ["observation"]
    learner, rollout = learning(kind, env, observed, hidden=[8], **options)
    metrics = [learner.update(batch := rollout.collect()) for _ in range(3)][-1]
    assert batch["action"].dtype == dtype
    assert batch["action"].shape == (8, 8, *shape)
    assert metrics["loss_qvalue"] > 0
    assert learner.kept == 3 * 8 * 8
