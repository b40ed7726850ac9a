"""Every way to learn from a guide with replay, in envs with any numbers as actions."""

import pytest
import torch
from any_env import AnyEnv
from tensordict.nn import TensorDictModule
from torchrl.data import Bounded
from torchrl.envs import Compose, TransformedEnv

from coil_rl.learners import SAC, FilteredKickstartLoss
from coil_rl.run.rollout import Rollout
from coil_rl.testing import check_env
from coil_rl.transforms import AdaptiveMixedAction, GradualResidual, GuideActions, Takeover
from coil_studies import IBRL

SMALL = {"starts": 8, "batch_size": 8, "updates_per_step": 0.25, "hidden": [8]}
WAYS = {
    "warm start": (
        [lambda: Takeover(1.0, 16)],
        SAC,
        {"critics": 4, "target_critics": 2, "critic_layer_norm": True},
    ),
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
    transforms, learner, options = WAYS[way]
    halves = TensorDictModule(
        lambda seen: (
            seen[..., :1]
            .clamp(-1, 1)
            .unflatten(-1, (1,) * len(shape))
            .expand(*seen.shape[:-1], *shape)
        ),
        in_keys=["observation"],
        out_keys=["action"],
    )
    world = AnyEnv(8, Bounded(-1, 1, shape, dtype=dtype), dtype=dtype)
    env = TransformedEnv(
        world, Compose(GuideActions({"halves": halves}), *(make() for make in transforms))
    ).train()
    check_env(env, steps=3)
    observed = ["observation", "agent_weight"] if way == "adaptive" else ["observation"]
    built = learner(env, observed, **SMALL | options)
    rollout = Rollout(env, built.policy, 4, built.keys)
    metrics = [built.update(batch := rollout.collect()) for _ in range(3)][-1]
    assert batch["action"].dtype == dtype
    assert batch["action"].shape == (8, 4, *shape)
    assert metrics["loss_qvalue"] > 0
    assert built.kept == 3 * 8 * 4
