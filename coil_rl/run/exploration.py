"""Exploration noise that is similar in consecutive steps."""

from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from coil_rl.learners.policy import NOISE
from coil_rl.ranges import Share, checked


class CorrelatedNoise:
    """Exploration noise of a policy, correlated from step to step.

    Each number is `correlation` of the one before and a fresh part, so that each step alone is
    standard normal. Korenkevych et al. 2019; Hollenstein et al. 2024 (for PPO).

    Args:
        env: whose actions are sampled, numbers and not choices.
        correlation: of the numbers of consecutive steps, above 0 and at most 1.
        parts: number of policies that share the rows of the env; the noise is for the rows of one.

    Attributes:
        last: the numbers of the last step, [rows, *action]; None before the first.
    """

    def __init__(self, env: EnvBase, correlation: float, parts: int = 1) -> None:
        spec = env.full_action_spec[env.action_key]
        self.shape = (spec.shape[0] // parts, *spec.shape[1:]) if parts > 1 else spec.shape
        self.dtype, self.device = spec.dtype, spec.device
        self.correlation = correlation
        self.last: Tensor | None = None

    def write(self, entries: Any) -> Any:
        """Draw the noise of the next step, add it to the entries that a policy reads, return them.

        Args:
            entries: a TensorDict or `Entries`, [rows].
        """
        fresh = torch.randn(self.shape, dtype=self.dtype, device=self.device)
        if self.last is None:
            self.last = fresh
        else:
            share = self.correlation
            self.last = share * self.last + (1 - share**2) ** 0.5 * fresh
        return entries.set(NOISE, self.last)


@checked
def noise_of(env: EnvBase, noise_correlation: Share, parts: int = 1) -> CorrelatedNoise | None:
    """Return the correlated noise of an env; None for choices, or without a correlation.

    Args:
        noise_correlation: of consecutive steps.
        parts: see `CorrelatedNoise`.

    Raises:
        ValueError: if the correlation is below 0 or above 1.
    """
    if noise_correlation == 0 or not env.full_action_spec[env.action_key].dtype.is_floating_point:
        return None
    return CorrelatedNoise(env, noise_correlation, parts)


class Exploring(TensorDictModuleBase):
    """A policy that samples its actions with correlated noise, as in a `Rollout`.

    Args:
        policy: writes the action.
        noise: of its actions.
    """

    def __init__(self, policy: TensorDictModuleBase, noise: CorrelatedNoise) -> None:
        self.in_keys, self.out_keys = list(policy.in_keys), list(policy.out_keys)
        super().__init__()
        self.policy, self.noise = policy, noise

    def forward(self, tensordict: Any) -> Any:
        """Write the action, and what the policy remembers."""
        return self.policy(self.noise.write(tensordict))
