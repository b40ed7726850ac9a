"""Kickstarting (Schmitt et al. 2018): an auxiliary loss for the distance of the policy from the action of a guide."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar, Literal

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor
from torch.distributions import Categorical, Normal, kl_divergence
from torchrl.modules import TanhNormal

from coil_rl.envs.limits import check_choice, check_range
from coil_rl.learners.networks import Choices
from coil_rl.schedules import Linear, Schedule, schedule

if TYPE_CHECKING:
    from coil_rl.learners.sac import Critics

EDGE = 1e-3  # minimum distance of a guide's action from the bounds, as a fraction of half the range


@dataclass(eq=False)
class KickstartLoss:
    """Auxiliary loss of a policy: its distance from the action g of a guide. The metric is `loss_NAME`.

    An unknown kind, or a scale that is not positive, is a `ValueError`.
    """

    name: ClassVar[str] = "guide"

    coefficient: float | Schedule = Linear(1.0, 0.0, until=0.5)  # of the loss
    # "likelihood", behavioural cloning: -log pi(g | s); or "divergence": KL(N(g, scale) || pi),
    # which also trains the standard deviation of the policy. For bounded actions both normal
    # distributions are squashed.
    kind: Literal["likelihood", "divergence"] = "likelihood"
    scale: float = 0.2  # standard deviation of the guide for the divergence, before squashing
    guide: int = 0  # index of the guide in the advice
    advice_key: NestedKey = "guide_action"  # entry with the advice, [N, n_guides, A]

    def __post_init__(self) -> None:
        check_choice(("likelihood", "divergence"), kind=self.kind)
        check_range(0, above=True, scale=self.scale)
        self.coefficient_at = schedule(self.coefficient)
        self.critics: Critics | None = None  # of the learner's policy, if the learner has such

    @property
    def keys(self) -> list[NestedKey]:
        """Entries that it reads, besides those that the policy observes."""
        return [self.advice_key]

    def __call__(
        self, policy: ProbabilisticTensorDictSequential, minibatch: TensorDictBase
    ) -> Tensor:
        """Return the loss of a minibatch [N], a scalar."""
        return self.each(policy, minibatch).mean()

    def each(self, policy: ProbabilisticTensorDictSequential, minibatch: TensorDictBase) -> Tensor:
        """Return the loss of each row of a minibatch, [N]. For discrete actions both kinds are the cross-entropy."""
        advice = minibatch[self.advice_key][..., self.guide, :]
        distribution = policy.get_dist(minibatch.select(*policy.in_keys))
        if isinstance(distribution, Categorical):
            return -(advice * distribution.logits).sum(-1)
        if isinstance(
            distribution, Choices
        ):  # the advice is one-hot for each choice, one beside the other
            logits = distribution.base_dist.logits
            return -(advice * logits[:, logits[0].isfinite()]).sum(-1)
        bounded = isinstance(distribution, TanhNormal)
        if bounded:
            low, high = distribution.low, distribution.high
            middle, half = (high + low) / 2, (high - low) / 2
            unit = ((advice - middle) / half).clamp(EDGE - 1, 1 - EDGE)
            advice = middle + half * unit
        if self.kind == "likelihood":
            return -distribution.log_prob(advice)
        # The divergence between squashed distributions is that of the normal distributions before
        # squashing.
        mean, base = (unit.atanh(), distribution) if bounded else (advice, distribution.base_dist)
        return (
            kl_divergence(Normal(mean, self.scale), Normal(base.loc, base.scale)).flatten(1).sum(-1)
        )


@dataclass(eq=False)
class FilteredKickstartLoss(KickstartLoss):
    """As `KickstartLoss`, weighted by the critics' opinion of g, for learners with action values, such as SAC.

    The weight of a state is 1 where the critics' mean value of g is larger than that of the
    policy's action, else 0 (Q-filter, Nair et al. 2018); or `soft`, the probability of this by the
    spread of the critics (SPReD, 2025): Phi((mean Q_g - mean Q_pi) / sqrt(var Q_g + var Q_pi)).
    Other arguments are those of `KickstartLoss`.
    """

    soft: bool = field(default=False, kw_only=True)

    @property
    def keys(self) -> list[NestedKey]:
        """Entries that it reads; raises a `ValueError` for a learner without action values."""
        if self.critics is None:
            raise ValueError(
                "FilteredKickstartLoss compares values of actions; take learner=sac, or KickstartLoss"
            )
        return super().keys

    def each(self, policy: ProbabilisticTensorDictSequential, minibatch: TensorDictBase) -> Tensor:
        """Return the weighted loss of each row of a minibatch, [N]."""
        with torch.no_grad():
            own = policy.get_dist(minibatch.select(*policy.in_keys)).deterministic_sample
            advice = minibatch[self.advice_key][..., self.guide, :]
            actions = (minibatch.copy().set("action", action) for action in (advice, own))
            values = torch.stack([self.critics.values(data) for data in actions])  # type: ignore[union-attr]
            gain = values[0].mean(0) - values[1].mean(0)
            spread = values.var(1).sum(0).sqrt().clamp_min(1e-8)
            weight = torch.special.ndtr(gain / spread) if self.soft else (gain > 0).to(gain.dtype)
        return weight * super().each(policy, minibatch)
