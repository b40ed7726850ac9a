"""A loss that draws the policy to a guide's action while it learns: kickstarting (Schmitt et al. 2018)."""

from __future__ import annotations

from typing import Literal, Protocol

from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from tensordict.utils import NestedKey
from torch import Tensor
from torch.distributions import Categorical, Normal, kl_divergence
from torchrl.modules import TanhNormal

from coil_rl.schedules import Schedule, schedule

EDGE = 1e-3  # how near the bounds of an action a guide's is taken to be at most, as a share of half its range


class AuxiliaryLoss(Protocol):
    """One more loss of a policy, weighted by a schedule over the run."""

    name: str
    keys: list[NestedKey]
    coefficient: Schedule

    def __call__(self, policy: ProbabilisticTensorDictSequential, minibatch: TensorDictBase) -> Tensor:
        """The loss of a minibatch [N] with `keys` and what the policy observes, a scalar."""


class GuideLoss:
    """How far the policy is from the guide's action g.

    Args:
        coefficient: weight of the loss, a number or a schedule over the run.
        kind: "likelihood", behavioural cloning: - log pi(g | s); "divergence": KL(N(g, scale) || pi), which also tells
            the policy how sure to be. Both squash the normal distributions where actions are bounded.
        scale: standard deviation of the guide, before squashing, for the divergence.
        guide: which row of the advice.
        advice_key: of the advice, [N, n_guides, A].

    Raises:
        ValueError: for a kind that is none, or a scale that is not positive.
    """

    name = "guide"

    def __init__(
        self,
        coefficient: float | Schedule = 1.0,
        kind: Literal["likelihood", "divergence"] = "likelihood",
        scale: float = 0.2,
        guide: int = 0,
        advice_key: NestedKey = "guide_action",
    ) -> None:
        if kind not in ("likelihood", "divergence"):
            raise ValueError(f"kind={kind!r} must be likelihood or divergence")
        if not scale > 0:
            raise ValueError(f"scale={scale} must be more than 0")
        self.coefficient, self.kind, self.scale, self.guide = schedule(coefficient), kind, scale, guide
        self.advice_key, self.keys = advice_key, [advice_key]

    def __call__(self, policy: ProbabilisticTensorDictSequential, minibatch: TensorDictBase) -> Tensor:
        """The loss of a minibatch [N], a scalar. Between choices both kinds are the cross-entropy."""
        advice = minibatch[self.advice_key][:, self.guide]
        seen = policy.get_dist(minibatch.select(*policy.in_keys))
        if isinstance(seen, Categorical):
            return -(advice * seen.logits).sum(-1).mean()
        bounded = isinstance(seen, TanhNormal)
        if bounded:
            middle, half = (seen.high + seen.low) / 2, (seen.high - seen.low) / 2
            unit = ((advice - middle) / half).clamp(EDGE - 1, 1 - EDGE)
            advice = middle + half * unit
        if self.kind == "likelihood":
            return -seen.log_prob(advice).mean()
        # Squashing is the same for both, and a divergence does not see it.
        mean, base = (unit.atanh(), seen) if bounded else (advice, seen.base_dist)
        return kl_divergence(Normal(mean, self.scale), Normal(base.loc, base.scale)).sum(-1).mean()
