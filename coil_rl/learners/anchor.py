"""Anchored COIL: a policy that starts as its guide, and lets go of it with a brake.

COIL's first policy is that of plain reinforcement learning, whatever the guide advises. An anchored
policy adds the advice g to what its network f gives, before squashing:

    mean = w atanh(clip(g, -0.97, 0.97)) + f(s, g)

The last layer of f starts at zero, so with w = 1 the first policy is the guide. For discrete
actions w kappa is added to the logit of the advised action. Residual policies start the same way
(Silver et al. 2018; Johannink et al. 2019), but here f is unbounded, and w falls: a policy that
keeps w = 1 never loses the guide's habits. A guide that is always wrong is of use too: with w = -1
the first policy does the opposite, and |w| falls.

Falling too far breaks the policy, and any update may, so there is a brake. At a few check-ups over
the run the policy is evaluated deterministically in fixed cases, with its present weight and with
one that is lower by a margin. If the present one has become worse, the policy is rolled back to
that of the best check-up. Else the weight falls, if the lower one fails in no further case: by a
step, which is shorter than the margin, if it loses next to nothing; by the margin if it gains much.

The parts are `AnchoredHead` in the policy, `AnchoredUpdate` in the updates, and `Brake` between
them; `Anchor` has the numbers that a user chooses.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn

from coil_rl.envs.limits import check_range
from coil_rl.learners.extension import Extension
from coil_rl.learners.heads import GlobalScaleHead
from coil_rl.learners.learner import Callback, CaseResults, Cases
from coil_rl.learners.state import Stateful
from coil_rl.schedules import Linear, Schedule, schedule

LIMIT = 0.97  # of advice before atanh, as a fraction of half the range of the action
TIE = 1e-6  # decides between equal values
FIRST = 0.9  # probability of the advised one of several actions at weight 1
# A policy is rolled back if it loses more than both: this many tolerances, and this many standard
# errors of the difference from the best check-up.
ROLL_BACK_TOLERANCES, ROLL_BACK_ERRORS = 3, 2
LARGE_GAIN_TOLERANCES = 3  # gain from which on the weight falls by the whole margin
# Losses that do not train a policy, but values or, in SAC, the temperature; `loss` is that of DQN.
NOT_OF_THE_POLICY = ("loss", "loss_critic", "loss_qvalue", "loss_alpha")


class AnchoredHead(nn.Module):
    """Head of a policy whose mean, or logits, are pulled to the weighted actions of guides.

    Args:
        head: gives the mean and the standard deviation, or the logits.
        pull: turns advice [*batch, n_guides, A] into means or logits [*batch, n_guides, *event].
        guides: number of guides.
        device: of the weights; None: PyTorch's default.

    Attributes:
        weight: of each guide, [n_guides]; at first 1 for the first guide and 0 for the others.
    """

    def __init__(
        self,
        head: nn.Module,
        pull: Callable[[Tensor], Tensor],
        guides: int,
        device: torch.device | None = None,
    ) -> None:
        super().__init__()
        self.head, self.pull = head, pull
        self.weight: Tensor = nn.Buffer(torch.eye(guides, device=device)[0])

    def forward(self, advice: Tensor, *inputs: Tensor) -> Any:
        """Return what `head` returns for the inputs, with the pull added."""
        outputs = self.head(*inputs)
        first = outputs[0] if isinstance(outputs, tuple) else outputs
        pull = self.weight.to(first.dtype) @ self.pull(advice).to(first.dtype)
        pulled = first + pull.view_as(first)
        return (pulled, *outputs[1:]) if isinstance(outputs, tuple) else pulled


class AnchoredValues(AnchoredHead):
    """Values of actions with a bonus for the advised one: the weight times the range of the values.

    So the advised action is taken unless its value is worse than the best one by more than this.
    With weight 1 it is taken always.

    Args:
        guides: number of guides.
        device: of the weights; None: PyTorch's default.
    """

    def __init__(self, guides: int, device: torch.device | None = None) -> None:
        super().__init__(nn.Identity(), nn.Identity(), guides, device)

    def forward(self, advice: Tensor, *inputs: Tensor) -> Tensor:
        """Return values [*batch, n] with the bonus; advice is one-hot, [*batch, n_guides, n]."""
        (values,) = inputs
        span = values.amax(-1, keepdim=True) - values.amin(-1, keepdim=True)
        return values + (self.weight @ advice.to(self.weight.dtype)).to(values.dtype) * (span + TIE)


def pull_to_number(advice: Tensor, bounds: tuple[Tensor, Tensor] | None = None) -> Tensor:
    """Return the pull to advised numbers: themselves, or what tanh maps near them.

    Args:
        advice: [*batch, n_guides, *event].
        bounds: lower and upper ones, [*event] each, of a policy that is squashed; None: it is not.
    """
    if bounds is None:
        return advice
    low, high = bounds
    return ((2 * advice - high - low) / (high - low)).clamp(-LIMIT, LIMIT).atanh()


def pull_to_choice(valid: Tensor) -> Callable[[Tensor], Tensor]:
    """Return the pull to advised choices, which are one-hot for each choice, one beside the other.

    `valid` is [*event, n], whether a choice has an option.
    """
    options = valid.sum(-1, keepdim=True).clamp_min(2)
    gain = (math.log(FIRST / (1 - FIRST)) + (options - 1).log()).expand(valid.shape).flatten()
    places = valid.flatten().nonzero().squeeze(-1)

    def pull(advice: Tensor) -> Tensor:
        padded = torch.zeros(
            *advice.shape[:-1], valid.numel(), dtype=gain.dtype, device=advice.device
        )
        return padded.index_copy(-1, places, advice.to(gain.dtype)) * gain

    return pull


def anchored_head(policy: nn.Module) -> tuple[str, AnchoredHead]:
    """Return the anchored head of a policy, and its name among the modules of the policy."""
    (found,) = [
        (name, module)
        for name, module in policy.named_modules()
        if isinstance(module, AnchoredHead)
    ]
    return found


@dataclass(frozen=True, kw_only=True)
class Anchor:
    """Settings of anchored COIL: the start of a policy at its guide, and how it lets go of it.

    A value out of range is a `ValueError`.

    Args:
        looks: number of check-ups over the run, besides the one before training.
        cases: number of cases of a check-up; None: as many as the run has for this: 96 where
            failures, often rare, are counted, else 24.
        step: by which the weight falls at a check-up.
        margin: by which the candidate weight of a check-up is lower; at least `step`.
        tolerance: share of the guide's return that may be lost for a step; at least half a standard
            error of that return may be. Three times as much below the best check-up, and two
            standard errors of the difference, the policy is rolled back to that.
        warmup: share of the run, from its start, in which only the critic learns.
        noise: standard deviation of a policy that has one of its own, as that of PPO; with DQN
            probability of a random action. A number or a schedule.
        advice_key: entry with the advice, [*batch, n_guides, A].
    """

    looks: int = 32
    cases: int | None = None
    step: float = 0.05
    margin: float = 0.3
    tolerance: float = 0.01
    warmup: float = 0.05
    noise: float | Schedule = Linear(0.3, 0.06, until=0.95, since=0.5)
    advice_key: NestedKey = "guide_action"

    def __post_init__(self) -> None:
        check_range(1, looks=self.looks)
        check_range(2, cases=2 if self.cases is None else self.cases)
        check_range(0, 1, step=self.step, tolerance=self.tolerance, warmup=self.warmup)
        check_range(self.step, 1, margin=self.margin)
        check_range(0, above=True, noise=self.noise_at(0))

    def noise_at(self, progress: float) -> float:
        """Return the noise at this progress of the run, in [0, 1]."""
        return schedule(self.noise)(progress)


class AnchoredUpdate(Stateful, Extension):
    """What an anchor changes in the updates of a learner, and the state of the anchor.

    At first only the critic learns, because it knows nothing about the returns of the guide.
    The noise of the policy follows a schedule.

    Args:
        anchor: the settings.
        policy: has an `AnchoredHead`.

    Attributes:
        active: whether the policy is anchored; otherwise the weight is 0 and training is COIL.
        guide: index of the guide to which it is anchored.
        sign: 1, or -1 for the opposite of the guide.
        guide_failures: number of cases in which the guide failed before training.
        tolerance: return that may be lost for a step of the weight; NaN before training.
        best_returns: of the best check-up, [C].
        best_state: state of the policy at the best check-up.
    """

    parts: ClassVar[tuple[str, ...]] = (
        "active",
        "guide",
        "sign",
        "guide_failures",
        "tolerance",
        "best_returns",
        "best_state",
    )

    def __init__(self, anchor: Anchor, policy: nn.Module) -> None:
        self.anchor = anchor
        _, self.head = anchored_head(policy)
        self.active = True
        self.guide, self.sign = 0, 1
        self.guide_failures, self.tolerance = 0, math.nan
        self.best_returns = torch.empty(0)
        self.best_state: dict[str, Tensor] = {}

    def weights(self, weights: dict[str, float], progress: float) -> dict[str, float]:
        """Return the weights of the losses; those of the policy are 0 during the warm-up."""
        if not (self.active and progress < self.anchor.warmup):
            return weights
        return {
            name: weight if name in NOT_OF_THE_POLICY else 0.0 for name, weight in weights.items()
        }

    def finish(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        """Set the standard deviation of an anchored policy that has one of its own.

        Returns:
            `anchor`, the weight of the guide, below 0 of its opposite; and `noise`, the standard
            deviation.
        """
        return self.set_noise(progress)

    @torch.no_grad()
    def set_noise(self, progress: float) -> dict[str, float]:
        """Set the standard deviation for the finished share of a run; see `finish`."""
        metrics = {"anchor": self.sign * self.weight}
        if isinstance(self.head.head, GlobalScaleHead):
            scale = self.head.head.log_scale
            if self.active:
                scale.fill_(math.log(self.anchor.noise_at(progress)))
            metrics["noise"] = float(scale.exp().mean())
        return metrics

    def callbacks(self, policy: nn.Module, cases: Cases) -> Sequence[Callback]:
        """Return the brake."""
        return [Brake(self, policy, cases)]

    @property
    def weight(self) -> float:
        """Weight of the guide, or of its opposite; 0 without an anchor."""
        return self.sign * float(self.head.weight.sum())

    def set_weight(self, value: float) -> None:
        """Set the weight of the guide, or of its opposite."""
        self.head.weight.copy_(self.weights_of_guides(value))

    def weights_of_guides(self, value: float) -> Tensor:
        """Return the weights of all guides, [n_guides]: a value for the anchor's, 0 for others."""
        return self.first_candidates()[self.guide] * (self.sign * value)

    def first_candidates(self) -> list[Tensor]:
        """Return the weights, [n_guides] each, to compare before training.

        They are for each guide alone, for none, and for the opposite of each guide.
        """
        guides = torch.eye(len(self.head.weight), device=self.head.weight.device)
        return [*guides, guides[0] * 0, *-guides]

    def candidates(self) -> list[Tensor]:
        """Return the two weights of a check-up, [n_guides] each: the present and the lower one."""
        lower = max(self.weight - self.anchor.margin, 0.0)
        return [self.weights_of_guides(self.weight), self.weights_of_guides(lower)]

    def begin(self, results: CaseResults, random: Tensor, policy: nn.Module) -> None:
        """Choose the best guide, or the opposite of one, as the anchor of the policy, or none.

        The anchor is active if the best guide or opposite is better than a new policy without a
        guide, and than random actions, by more than a standard error of the difference.

        Args:
            results: with the weights of `first_candidates`.
            random: returns of random actions in the same cases, [C].
            policy: with the head.
        """
        guides = len(self.head.weight)
        anchors = [index for index in range(2 * guides + 1) if index != guides]
        best = max(anchors, key=results.mean_return)
        others = torch.stack([results.returns[guides], random])
        differences = results.returns[best] - others
        self.active = bool((differences.mean(1) > standard_error(differences)).all())
        self.guide, self.sign = best % (guides + 1), 1 if best < guides else -1
        self.set_weight(float(self.active))
        self.set_noise(0.0)
        self.guide_failures = results.failures[best]
        guide_return = abs(results.mean_return(best))
        if self.active:
            self._keep(policy, results.returns[best])
        chance = float(standard_error(results.returns[best])) / 2
        self.tolerance = max(self.anchor.tolerance * guide_return, chance)

    def decide(self, results: CaseResults, policy: nn.Module) -> bool:
        """Lower the weight of the guide, keep it, or roll the policy back to the best check-up.

        Args:
            results: with the weights of `candidates`.
            policy: with the head.

        Returns:
            Whether the policy was rolled back.
        """
        if self._has_become_worse(results):
            policy.load_state_dict(self.best_state)
            return True
        present, lower = results.mean_return(0), results.mean_return(1)
        best = float(self.best_returns.mean())
        if present >= best:
            self._keep(policy, results.returns[0])
        if self._may_fall(results):
            large_gain = lower > max(present, best) + LARGE_GAIN_TOLERANCES * self.tolerance
            fall = self.anchor.margin if large_gain else self.anchor.step
            self.set_weight(max(self.weight - fall, 0.0))
        return False

    def _has_become_worse(self, results: CaseResults) -> bool:
        """Return whether the policy with the present weight fails more often or lost too much."""
        if results.failures[0] > self.guide_failures:
            return True
        error = float(standard_error(self.best_returns - results.returns[0]))
        accepted = max(ROLL_BACK_TOLERANCES * self.tolerance, ROLL_BACK_ERRORS * error)
        return results.mean_return(0) < float(self.best_returns.mean()) - accepted

    def _may_fall(self, results: CaseResults) -> bool:
        """Return whether the lower weight fails in no further case and loses next to nothing."""
        steps = self.anchor.margin / self.anchor.step if self.anchor.step else 1.0
        accepted = results.mean_return(0) - steps * self.tolerance
        return results.failures[1] <= results.failures[0] and results.mean_return(1) >= accepted

    def _keep(self, policy: nn.Module, returns: Tensor) -> None:
        self.best_returns = returns
        self.best_state = {name: value.clone() for name, value in policy.state_dict().items()}


class Brake:
    """The check-ups of an anchored policy, a `Callback`: they decide how strongly it is anchored.

    Args:
        anchored: the anchor of the policy.
        policy: of the learner.
        cases: in which copies of the policy are evaluated.
    """

    names: Sequence[str] = (
        "look/return",
        "look/lower_return",
        "look/failures",
        "look/lower_failures",
        "look/back",
    )

    def __init__(self, anchored: AnchoredUpdate, policy: nn.Module, cases: Cases) -> None:
        self.anchored, self.policy = anchored, policy
        count = anchored.anchor.cases
        self.cases = cases if count is None else cases.take(count)

    def due(self, update: int, updates: int, row: Mapping[str, float]) -> bool:
        """Return whether there is a check-up: before training, then evenly over the run."""
        if update == 0:
            return True
        looks = self.anchored.anchor.looks
        return self.anchored.active and update in {
            round(updates * number / looks) for number in range(1, looks + 1)
        }

    def after_update(self, update: int) -> dict[str, float]:
        """Evaluate the candidate weights, decide, and return numbers of the first two by name."""
        rolled_back = False
        if update == 0:
            results = self._evaluate(self.anchored.first_candidates())
            self.anchored.begin(results, self.cases.evaluate_random(), self.policy)
        else:
            results = self._evaluate(self.anchored.candidates())
            rolled_back = self.anchored.decide(results, self.policy)
        returns = results.mean_return(0), results.mean_return(1)
        numbers = (*returns, *results.failures[:2], rolled_back)
        return dict(zip(self.names, map(float, numbers), strict=True))

    def _evaluate(self, weights: Sequence[Tensor]) -> CaseResults:
        """Evaluate the policy in all cases with each of some weights of the guides."""
        name, _ = anchored_head(self.policy)
        state = self.policy.state_dict()
        return self.cases.evaluate([{**state, f"{name}.weight": weight} for weight in weights])


def standard_error(values: Tensor) -> Tensor:
    """Return the standard error of the mean over the last dimension."""
    return values.std(-1) / values.shape[-1] ** 0.5
