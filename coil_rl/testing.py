"""Contract checks of envs, guides and transforms, for tests of your own parts."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torchrl.envs import EnvBase, Transform, TransformedEnv, check_env_specs


def check_env(env: EnvBase, steps: int = 10) -> None:
    """Check that data fits the specs, numbers are finite, and a partial reset does not change other rows.

    Raises:
        AssertionError: by TorchRL's `check_env_specs`.
        ValueError: for the other two, with the entry.
    """
    check_env_specs(env)
    rollout = env.rollout(steps, break_when_any_done=False)
    for key, value in rollout.items(True, True):
        if value.is_floating_point() and not value.isfinite().all():
            raise ValueError(f"{key} holds a number that is not finite")
    if not env.batch_size or env.batch_size[0] < 2:
        return
    before = env.rollout(2, auto_reset=True, break_when_any_done=False)[..., -1]["next"]
    mask = torch.zeros_like(before["done"])
    mask[0] = True
    after = env.reset(before.clone().set("_reset", mask))
    for key in env.observation_spec.keys(True, True):
        if not torch.equal(before[key][1:], after[key][1:]):
            raise ValueError(f"resetting row 0 changed {key} of other rows")


def check_guide(
    guide: TensorDictModuleBase, data: TensorDictBase, action_key: NestedKey = "action", tolerance: float = 0.0
) -> None:
    """Check that a guide writes finite actions, does not change its input, and treats each row independently.

    Args:
        guide: without random numbers.
        data: [B], written by an env.
        action_key: of the action.
        tolerance: allowed effect of other rows; a network rounds differently in another batch.

    Raises:
        ValueError: for the first property that does not hold.
    """
    if action_key not in guide.out_keys:
        raise ValueError(f"the guide writes {guide.out_keys}, not {action_key!r}")
    inputs = data.select(*guide.in_keys)
    copy = inputs.clone()
    with torch.no_grad():
        together = guide(inputs.copy())[action_key]
        alone = torch.cat([guide(inputs[row : row + 1].copy())[action_key] for row in range(len(inputs))])
    if not together.isfinite().all():
        raise ValueError("the guide's action is not finite")
    if not (inputs == copy).all():
        raise ValueError("the guide changed its input")
    if not torch.allclose(together, alone, rtol=0, atol=tolerance):
        raise ValueError("the guide's action for a row depends on the other rows")


def check_transform(env: EnvBase, transform: Transform) -> None:
    """Check an env with a transform; see `check_env`."""
    check_env(TransformedEnv(env, transform))
