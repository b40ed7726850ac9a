"""The contracts of guides, transforms and envs as checks, for our own tests and for those of other people's parts."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torchrl.envs import EnvBase, Transform, TransformedEnv, check_env_specs


def check_env(env: EnvBase, steps: int = 10) -> None:
    """Specs hold in rollouts, numbers are finite, and a partial reset leaves the other rows as they were.

    Raises:
        AssertionError: by `check_env_specs`, where specs and data differ.
        ValueError: for the other two, naming the entry.
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
    """The guide writes a finite action for each row, leaves its input alone, and answers each row by itself.

    Args:
        guide: one that does not draw random numbers.
        data: [B], what an env wrote.
        action_key: where the action is expected.
        tolerance: how much other rows may change an action; a network rounds differently in a larger batch.

    Raises:
        ValueError: naming what does not hold.
    """
    if action_key not in guide.out_keys:
        raise ValueError(f"the guide writes {guide.out_keys}, not {action_key!r}")
    given = data.select(*guide.in_keys)
    kept = given.clone()
    with torch.no_grad():
        together = guide(given.copy())[action_key]
        alone = torch.cat([guide(given[row : row + 1].copy())[action_key] for row in range(len(given))])
    if not together.isfinite().all():
        raise ValueError("the guide's action is not finite")
    if not (given == kept).all():
        raise ValueError("the guide changed what it was given")
    if not torch.allclose(together, alone, rtol=0, atol=tolerance):
        raise ValueError("the guide's action for a row depends on the other rows")


def check_transform(env: EnvBase, transform: Transform) -> None:
    """An env with the transform around it is still an env: see `check_env`."""
    check_env(TransformedEnv(env, transform))
