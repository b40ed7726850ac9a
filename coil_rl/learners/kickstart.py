"""Kickstarting (Schmitt et al. 2018): a loss for the distance of a policy from a guide's action."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Literal

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor
from torchrl.envs import EnvBase

from coil_rl.learners.anchor import AnchoredSample
from coil_rl.learners.critics import Critics
from coil_rl.learners.density import Choices, Normal, SquashedNormal
from coil_rl.learners.extension import Extension
from coil_rl.ranges import Index, Positive, checked
from coil_rl.schedules import Linear, Schedule, schedule
from coil_rl.transforms.guide_transform import check_advised

# Minimum distance of a guide's action from the bounds, as a fraction of half the range. To imitate
# a bound saturates the squashing: noise then has no effect, and gradients are almost zero.
EDGE = 0.2


@checked
@dataclass(eq=False)
class KickstartLoss(Extension):
    """A further loss of a policy: its distance from the action g of a guide.

    The metrics are `loss_guide` and its coefficient, `guide_weight`. An unknown kind, or a scale
    that is not positive, is a `ValueError`.

    Args:
        coefficient: weight of the loss, a number or a schedule.
        kind: "likelihood", behavioural cloning: -log pi(g | s); or "divergence": KL(N(g, scale) ||
            pi), which also trains the standard deviation of the policy. For bounded actions both
            normal distributions are squashed, and g is at most 0.8 of the way to a bound. For
            choices both are the cross-entropy, because g is certain.
        scale: standard deviation of the guide for the divergence of numbers, before squashing.
        guide: index of the guide in the advice.
        advice_key: entry with the advice, [N, n_guides, A].
    """

    LOSS: ClassVar[str] = "loss_guide"

    coefficient: float | Schedule = Linear(1.0, 0.0, until=0.5)
    kind: Literal["likelihood", "divergence"] = "likelihood"
    scale: Positive = 0.2
    guide: Index = 0
    advice_key: NestedKey = "guide_action"

    def __post_init__(self) -> None:
        self.coefficient_at = schedule(self.coefficient)

    @property
    def keys(self) -> Sequence[NestedKey]:
        """Entries that it reads, besides those that the policy observes."""
        return [self.advice_key]

    def meet(
        self, env: EnvBase, policy: ProbabilisticTensorDictSequential, critics: Critics | None
    ) -> None:
        """Refuse an env without the advice, and a policy whose density is not that of its action.

        Raises:
            KeyError: for the env.
            ValueError: for the policy.
        """
        if self.advice_key not in policy.out_keys:  # that of Dynamic COIL has its guides inside
            check_advised(env.observation_spec, self)
        if isinstance(policy.module[-1], AnchoredSample):
            raise ValueError(
                "what an anchored policy learns is added to its guide's action, and this loss "
                "would draw it to that action itself; leave learner.anchor out, or "
                "learner.auxiliary"
            )

    def losses(
        self, policy: ProbabilisticTensorDictSequential, minibatch: TensorDictBase
    ) -> dict[str, Tensor]:
        """Return the loss of a minibatch [N] by its name."""
        return {self.LOSS: self.each(policy, minibatch).mean()}

    def weights(self, weights: dict[str, float], progress: float) -> dict[str, float]:
        """Return the weights of all losses, with the coefficient as that of this one."""
        return weights | {self.LOSS: self.coefficient_at(progress)}

    def finish(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        """Return the coefficient, as `guide_weight`."""
        return {"guide_weight": self.coefficient_at(progress)}

    def each(self, policy: ProbabilisticTensorDictSequential, minibatch: TensorDictBase) -> Tensor:
        """Return the loss of each row of a minibatch, [N]."""
        advice = minibatch[self.advice_key][..., self.guide, :]
        density = policy.get_dist(minibatch.select(*policy.in_keys))
        if isinstance(density, Choices):
            # The advice has a one-hot vector for each choice, side by side. The logits have rows of
            # one length, in which `valid` are the options.
            return -(advice * density.logits[:, density.valid]).sum(-1)
        mean = advice
        if isinstance(density, SquashedNormal):
            unit = density.unit(advice).clamp(EDGE - 1, 1 - EDGE)
            advice, mean = density.from_unit(unit), unit.atanh()
        if self.kind == "likelihood":
            return -density.log_prob(advice)
        # The divergence of squashed distributions is that of the normal ones before squashing.
        guide = Normal(mean, torch.full_like(mean, self.scale), density.event_dims)
        return guide.divergence(density)


@checked
@dataclass(eq=False)
class FilteredKickstartLoss(KickstartLoss):
    """As `KickstartLoss`, but weighted by what critics think of g.

    It is for learners with critics of actions, such as SAC. The weight of a state is 1 where the
    critics' mean value of g is larger than that of the policy's action, else 0 (Q-filter, Nair et
    al. 2018).

    Args:
        soft: whether the weight is the probability that g has the larger value, by the spread of
            the critics (SPReD, 2025): Phi((mean Q_g - mean Q_pi) / sqrt(var Q_g + var Q_pi)).
    """

    soft: bool = field(default=False, kw_only=True)

    def meet(
        self, env: EnvBase, policy: ProbabilisticTensorDictSequential, critics: Critics | None
    ) -> None:
        """Take the critics; a learner without is a `ValueError`."""
        if critics is None:
            raise ValueError(
                "FilteredKickstartLoss compares values of actions; take learner=sac, or "
                "KickstartLoss"
            )
        super().meet(env, policy, critics)
        self.critics = critics

    def each(self, policy: ProbabilisticTensorDictSequential, minibatch: TensorDictBase) -> Tensor:
        """Return the weighted loss of each row of a minibatch, [N]."""
        return self.weight(policy, minibatch) * super().each(policy, minibatch)

    @torch.no_grad()
    def weight(
        self, policy: ProbabilisticTensorDictSequential, minibatch: TensorDictBase
    ) -> Tensor:
        """Return the weight of each row of a minibatch, [N]."""
        own = policy.get_dist(minibatch.select(*policy.in_keys)).mode
        advice = minibatch[self.advice_key][..., self.guide, :]
        of_guide, of_policy = self._values(minibatch, advice), self._values(minibatch, own)
        gain = of_guide.mean(0) - of_policy.mean(0)
        if not self.soft:
            return (gain > 0).to(gain.dtype)
        spread = (of_guide.var(0) + of_policy.var(0)).sqrt().clamp_min(1e-8)
        return torch.special.ndtr(gain / spread)

    def _values(self, minibatch: TensorDictBase, action: Tensor) -> Tensor:
        return self.critics.values(minibatch.copy().set("action", action))
