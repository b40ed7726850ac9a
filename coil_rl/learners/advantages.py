"""Advantages of actions, from the rewards after them and the critic's values of the states."""

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.objectives.value import GAE

from coil_rl.ranges import Share, checked


@checked
class Advantages:
    """Generalised advantage estimation (Schulman et al. 2016) with one critic evaluation per state.

    The state after a step is the state before the next step, unless the episode ended. So the
    critic evaluates each state once, and in addition the last states of the batch and those of
    truncated episodes.

    Args:
        critic: writes `state_value`.
        gamma: discount, in [0, 1].
        gae_lambda: weight of later steps, in [0, 1]; 0: one step and the value after it; 1: all
            rewards to the end of the episode.
    """

    def __init__(self, critic: TensorDictModuleBase, gamma: Share, gae_lambda: Share) -> None:
        self.critic = critic
        self.estimate = GAE(gamma=gamma, lmbda=gae_lambda, value_network=None, vectorized=False)

    @torch.no_grad()
    def __call__(self, batch: TensorDictBase) -> TensorDictBase:
        """Write `advantage` and `value_target` [B, T, 1] into a batch [B, T] of rollouts."""
        after = batch["next"]
        value, last = self._values(batch), self._values(after[..., -1:])
        next_value = torch.cat([value[..., 1:, :], last], -2)
        truncated = (after["done"] & ~after["terminated"]).squeeze(-1)
        next_value[truncated] = self._values(after.select(*self.critic.in_keys)[truncated])
        batch["state_value"], batch["next", "state_value"] = value, next_value
        self.estimate(batch)
        return batch

    def _values(self, states: TensorDictBase) -> Tensor:
        return self.critic(states.select(*self.critic.in_keys))["state_value"]


def standardise(advantage: Tensor, least: float = 1e-6) -> Tensor:
    """Scale to mean 0 and standard deviation 1 over all entries.

    Args:
        advantage: of any shape.
        least: smaller standard deviations are taken as this one.
    """
    return (advantage - advantage.mean()) / advantage.std().clamp_min(least)
