"""Drives of the cone world with one guide, in which episodes end."""

import torch
from torchrl.envs import Compose, TransformedEnv

from coil_rl.envs import ConeTrackEnv, shipped_tracks
from coil_rl.transforms import GuideActions


def cones(guides, *transforms, cars=6, seed=0):
    """Return cars with the advice of one guide, or of several by their names."""
    env = ConeTrackEnv(shipped_tracks("test"), cars, rate=6, seed=seed)
    guides = guides if isinstance(guides, dict) else {"theirs": guides}
    return TransformedEnv(env, Compose(GuideActions(guides), *transforms)).train()


def driven(env, steps=80):
    torch.manual_seed(1)
    rollout = env.rollout(steps, break_when_any_done=False)
    assert rollout["next", "done"].sum() > 3, (
        "random driving should have crashed, so that resets are covered"
    )
    return rollout, rollout["guide_action"][:, :, 0]


def steps_of_episode(rollout):
    """Number of each step in its episode, from 1, [B, T]."""
    done, number = rollout["next", "done"].squeeze(-1), torch.zeros(len(rollout), dtype=torch.long)
    numbers = []
    for step in range(rollout.shape[1]):
        number = number + 1
        numbers.append(number)
        number = torch.where(done[:, step], 0, number)
    return torch.stack(numbers, 1)
