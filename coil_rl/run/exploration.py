"""Exploration noise that is similar in consecutive steps."""

from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from coil_rl.learners.policy import NOISE
from coil_rl.ranges import Share, checked


class Exploring(TensorDictModuleBase):
    """A policy that samples its actions with noise that is correlated from step to step.

    Each number is `correlation` of the one before and a fresh part, so that each step alone is
    standard normal. Korenkevych et al. 2019; Hollenstein et al. 2024 (for PPO).

    Args:
        policy: writes the action.
        env: whose actions are sampled, numbers and not choices.
        correlation: of the numbers of consecutive steps, above 0 and at most 1.
        parts: number of policies that share the rows of the env; this one acts on its part.

    Attributes:
        last: the numbers of the last step, [rows, *action]; None before the first.
    """

    def __init__(
        self, policy: TensorDictModuleBase, env: EnvBase, correlation: float, parts: int = 1
    ) -> None:
        self.in_keys, self.out_keys = list(policy.in_keys), list(policy.out_keys)
        super().__init__()
        self.policy, self.correlation = policy, correlation
        spec = env.full_action_spec[env.action_key]
        self.shape = (spec.shape[0] // parts, *spec.shape[1:]) if parts > 1 else spec.shape
        self.dtype, self.device = spec.dtype, spec.device
        self.last: Tensor | None = None

    def forward(self, entries: Any) -> Any:
        """Draw the noise of the step, and write the action and what the policy remembers.

        Args:
            entries: a TensorDict or `Entries`, [rows].
        """
        numbers = torch.randn(self.shape, dtype=self.dtype, device=self.device)
        if self.last is not None:
            share = self.correlation
            numbers = share * self.last + (1 - share**2) ** 0.5 * numbers
        self.last = numbers
        return self.policy(entries.set(NOISE, numbers))


@checked
def exploring(
    policy: TensorDictModuleBase, env: EnvBase, noise_correlation: Share, parts: int = 1
) -> TensorDictModuleBase:
    """Return a policy with correlated noise; itself for choices, or without a correlation.

    Args:
        policy: writes the action.
        noise_correlation: of consecutive steps.
        parts: see `Exploring`.

    Raises:
        ValueError: if the correlation is below 0 or above 1.
    """
    if noise_correlation == 0 or not env.full_action_spec[env.action_key].dtype.is_floating_point:
        return policy
    return Exploring(policy, env, noise_correlation, parts)
