"""How much better an action was than what a critic expected of its state."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.objectives.value import GAE

from coil_rl.learners.limits import check_numbers


class Advantages:
    """Generalised advantage estimation (Schulman et al. 2016) with as few looks at states as will do.

    The state after a step is the state before the next one, unless an episode ended in between. So the critic looks at
    each state once, then at the last ones and at those where an episode was cut short: those go on as far as it knows.

    Args:
        critic: writes `state_value` [..., 1].
        gamma: discount.
        gae_lambda: lambda, how far rewards are trusted over the critic.

    Raises:
        ValueError: for a number that is not between 0 and 1.
    """

    def __init__(self, critic: TensorDictModuleBase, gamma: float, gae_lambda: float) -> None:
        check_numbers(0, 1, gamma=gamma, gae_lambda=gae_lambda)
        self.critic = critic
        self.estimate = GAE(gamma=gamma, lmbda=gae_lambda, value_network=None, vectorized=False)

    @torch.no_grad()
    def __call__(self, batch: TensorDictBase) -> TensorDictBase:
        """Write `advantage` and `value_target`, [B, T, 1] each.

        Args:
            batch: [B, T] consecutive steps with what the critic reads and, under `next`, the same, `reward`, `done` and
                `terminated`. `state_value` is written too; under `next` it means nothing after a terminated episode.
        """
        after = batch["next"]
        value, last = self._values(batch), self._values(after[..., -1:])
        later = torch.cat([value[..., 1:, :], last], -2)
        cut = (after["done"] & ~after["terminated"]).squeeze(-1)
        later[cut] = self._values(after.select(*self.critic.in_keys)[cut])
        batch["state_value"], batch["next", "state_value"] = value, later
        self.estimate(batch)
        return batch

    def _values(self, states: TensorDictBase) -> torch.Tensor:
        value: torch.Tensor = self.critic(states.select(*self.critic.in_keys))["state_value"]
        return value


def standardised(advantage: torch.Tensor) -> torch.Tensor:
    """Shifted and scaled to a mean of 0 and a standard deviation of 1, over all entries."""
    return (advantage - advantage.mean()) / advantage.std().clamp_min(1e-6)
