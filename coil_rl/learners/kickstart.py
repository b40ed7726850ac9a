"""Kickstarting (Schmitt et al. 2018): an auxiliary loss for the distance of the policy from the action of a guide."""

from __future__ import annotations

from typing import Literal

from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from tensordict.utils import NestedKey
from torch import Tensor
from torch.distributions import Categorical, Normal, kl_divergence
from torchrl.modules import TanhNormal

from coil_rl.envs.limits import check_choice, check_range
from coil_rl.learners.networks import Choices
from coil_rl.schedules import Linear, Schedule, schedule

EDGE = 1e-3  # minimum distance of a guide's action from the bounds, as a fraction of half the range


class KickstartLoss:
    """Auxiliary loss of a policy: its distance from the action g of a guide.

    Args:
        coefficient: of the loss, a number or a schedule.
        kind: "likelihood", behavioural cloning: -log pi(g | s); or "divergence": KL(N(g, scale) || pi), which also
            trains the standard deviation of the policy. For bounded actions both normal distributions are squashed.
        scale: standard deviation of the guide for the divergence, before squashing.
        guide: index of the guide in the advice.
        advice_key: entry with the advice, [N, n_guides, A].

    Attributes:
        name: the metric is `loss_NAME`.
        keys: entries that it reads, besides those that the policy observes.

    Raises:
        ValueError: for an unknown kind, or a scale that is not positive.
    """

    name = "guide"

    def __init__(
        self,
        coefficient: float | Schedule = Linear(1.0, 0.0, until=0.5),
        kind: Literal["likelihood", "divergence"] = "likelihood",
        scale: float = 0.2,
        guide: int = 0,
        advice_key: NestedKey = "guide_action",
    ) -> None:
        check_choice(("likelihood", "divergence"), kind=kind)
        check_range(0, above=True, scale=scale)
        self.coefficient, self.kind, self.scale, self.guide = schedule(coefficient), kind, scale, guide
        self.advice_key, self.keys = advice_key, [advice_key]

    def __call__(self, policy: ProbabilisticTensorDictSequential, minibatch: TensorDictBase) -> Tensor:
        """Return the loss of a minibatch [N], a scalar. For discrete actions both kinds are the cross-entropy."""
        advice = minibatch[self.advice_key][:, self.guide]
        distribution = policy.get_dist(minibatch.select(*policy.in_keys))
        if isinstance(distribution, Categorical):
            return -(advice * distribution.logits).sum(-1).mean()
        if isinstance(distribution, Choices):  # the advice is one-hot for each choice, one beside the other
            logits = distribution.base_dist.logits
            return -(advice * logits[:, logits[0].isfinite()]).sum(-1).mean()
        bounded = isinstance(distribution, TanhNormal)
        if bounded:
            low, high = distribution.low, distribution.high
            middle, half = (high + low) / 2, (high - low) / 2
            unit = ((advice - middle) / half).clamp(EDGE - 1, 1 - EDGE)
            advice = middle + half * unit
        if self.kind == "likelihood":
            return -distribution.log_prob(advice).mean()
        # The divergence between squashed distributions is that of the normal distributions before squashing.
        mean, base = (unit.atanh(), distribution) if bounded else (advice, distribution.base_dist)
        return kl_divergence(Normal(mean, self.scale), Normal(base.loc, base.scale)).flatten(1).sum(-1).mean()
