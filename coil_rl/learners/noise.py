"""A schedule of the exploration noise that begins when the failures of training have stopped."""

import math
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from typing import ClassVar

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor, nn

from coil_rl.envs.limits import check_range
from coil_rl.learners.networks import GlobalScaleHead
from coil_rl.learners.state import Stateful
from coil_rl.transforms.action_space import nested_key


@dataclass(eq=False)
class NoiseDecay(Stateful):
    """Upper limit of the standard deviation of a policy, which decays exponentially once episodes no longer fail.

    The agent needs the noise until it can do its task. Later it only makes the actions rough. A value out of range is a
    `ValueError`.
    """

    parts: ClassVar[tuple[str, ...]] = ("failures", "begin")

    end: float = 0.05  # limit at the end of the run, before squashing
    _: KW_ONLY
    failure: NestedKey | Sequence[str] = "terminated"  # entry after a step that is true where an episode fails
    tolerance: float = 0.01  # share of failures among the last episodes up to which the failures have stopped
    episodes: int = 200  # number of these episodes

    def __post_init__(self) -> None:
        check_range(0, above=True, end=self.end)
        check_range(0, 1, tolerance=self.tolerance)
        check_range(1, episodes=self.episodes)
        self.key: NestedKey = unravel_key(("next", nested_key(self.failure)))
        self.failures: list[bool] = []  # of the last episodes
        self.begin: tuple[float, ...] = ()  # progress and standard deviation; empty before the decay
        self.scales: list[Tensor] = []  # logarithms of the standard deviations

    def attach(self, policy: nn.Module) -> None:
        """Choose the policy; raises a `ValueError` if it has no standard deviation of its own."""
        self.scales = [module.log_scale for module in policy.modules() if isinstance(module, GlobalScaleHead)]
        if not self.scales:
            raise ValueError("noise: discrete actions have no standard deviation to limit; leave it out")

    @torch.no_grad()
    def apply(self, batch: TensorDictBase, progress: float) -> float:
        """Limit the noise after an update from a batch, and return the mean standard deviation of the policy."""
        self.failures = (self.failures + batch[self.key][batch["next", "done"]].tolist())[-self.episodes :]
        scale = float(torch.cat(self.scales).exp().mean())
        full = len(self.failures) == self.episodes
        if not self.begin and full and sum(self.failures) <= self.tolerance * self.episodes:
            self.begin = progress, scale
        if not self.begin:
            return scale
        since, first = self.begin
        share = (progress - since) / (1 - since) if since < 1 else 1.0
        limit = min(first, self.end) ** share * first ** (1 - share)
        for log_scale in self.scales:
            log_scale.clamp_(max=math.log(limit))
        return min(scale, limit)
