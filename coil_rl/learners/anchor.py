"""Anchored COIL: a policy that starts as its guide, and lets go of it with a brake.

COIL's first policy is that of plain reinforcement learning, whatever the guide advises. An anchored
policy adds the advice g to what its network f gives, before squashing:

    mean = w atanh(clip(g, -0.97, 0.97)) + f(s, g)

The last layer of f starts at zero, so with w = 1 the first policy is the guide. For discrete
actions w kappa is added to the logit of the advised action. Residual policies start the same way
(Silver et al. 2018; Johannink et al. 2019), but here f is unbounded, and w falls: a policy that
keeps w = 1 never loses the guide's habits. A guide that is always wrong is of use too: with w = -1
the first policy does the opposite, and |w| falls.

Falling too far breaks the policy, and any update may, so there is a brake. At a few looks over the
run the policy acts deterministically in fixed cases of the training, with today's weight and with
one that is lower by a margin. If today's has become worse, the policy goes back to that of the best
look. Else the weight falls, if the lower one fails in no further case: by a step, which is shorter
than the margin, if it loses next to nothing; by the margin if it gains much.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from tensordict import NestedKey
from torch import Tensor, nn

from coil_rl.envs.limits import check_range
from coil_rl.learners.state import Stateful
from coil_rl.schedules import Linear, Schedule, schedule

LIMIT = 0.97  # of advice before atanh, as a fraction of half the range of the action
TIE = 1e-6  # decides between equal values
FIRST = 0.9  # probability of the advised one of several actions at weight 1


class AnchoredHead(nn.Module):
    """Head of a policy whose mean, or logits, are pulled to the weighted actions of guides.

    `head` gives the mean and the standard deviation, or the logits. `pull` turns advice [*batch,
    n_guides, A] into means or logits [*batch, n_guides, *event].
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
    """Values of actions with a bonus for the advised one: the weight times the range of the values of the state.

    So the advised action is taken unless its value is worse than the best one by more than this.
    With weight 1 it is taken always.
    """

    def __init__(self, guides: int, device: torch.device | None = None) -> None:
        super().__init__(nn.Identity(), nn.Identity(), guides, device)

    def forward(self, advice: Tensor, *inputs: Tensor) -> Tensor:
        """Return values [*batch, n] with the bonus; the advice is one-hot, [*batch, n_guides, n]."""
        (values,) = inputs
        span = values.amax(-1, keepdim=True) - values.amin(-1, keepdim=True)
        return values + (self.weight @ advice.to(self.weight.dtype)).to(values.dtype) * (span + TIE)


def pull_to_number(advice: Tensor, bounds: tuple[Tensor, Tensor] | None = None) -> Tensor:
    """Return the pull to advised numbers: themselves, or for a policy squashed to `bounds` what tanh maps near them."""
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


@dataclass(frozen=True)
class Look:
    """Drives of the training cases with some weights of the anchor."""

    returns: Tensor  # [C] for each weight
    failures: Sequence[int]  # number of failed cases for each weight

    def score(self, index: int) -> float:
        """Mean return with a weight."""
        return float(self.returns[index].mean())


@dataclass(eq=False, kw_only=True)
class Anchor(Stateful):
    """Start of a policy at the action of a guide, and the brake by which it lets go of it.

    Before training the guides, their opposites (weight -1), the first policy without a guide and
    random actions are compared in the same cases. The anchor holds if the best guide or opposite is
    better than the last two by more than a standard error of the difference; otherwise the weight
    is 0, and training is COIL. A value out of range is a `ValueError`.

    Attributes:
        head: of the policy, see `AnchoredHead`.
        unit: of rewards in updates of PPO and the like: the largest mean return, without its sign,
            before training; 1 without an anchor. A critic starts near 0, and would follow returns
            of hundreds for most of the run.
    """

    parts: ClassVar[tuple[str, ...]] = (
        "holds",
        "guide",
        "sign",
        "unit",
        "guide_failures",
        "allowed",
        "best",
        "kept",
    )

    looks: int = 32  # number of looks over the run, besides the one before training
    cases: int | None = (
        # C, number of cases of a look; None: 96 where failures, often rare, are counted, else 24
        None
    )
    step: float = 0.05  # by which the weight falls at a look
    margin: float = 0.3  # by which the weight that is tried at a look is lower; at least `step`
    # Share of the guide's return that may be lost for a step; at least half a standard error of
    # that return may be. Three times as much below the best look, and two standard errors of the
    # difference, the policy goes back to that.
    tolerance: float = 0.01
    warmup: float = 0.05  # share of the run, from its start, in which only the critic learns
    # Standard deviation of a policy that has one of its own, as that of PPO; with DQN probability
    # of a random action.
    noise: float | Schedule = Linear(0.3, 0.06, until=0.95, since=0.5)
    advice_key: NestedKey = "guide_action"  # entry with the advice, [*batch, n_guides, A]

    def __post_init__(self) -> None:
        check_range(1, looks=self.looks)
        check_range(2, cases=2 if self.cases is None else self.cases)
        check_range(0, 1, step=self.step, tolerance=self.tolerance, warmup=self.warmup)
        check_range(self.step, 1, margin=self.margin)
        self.noise_at = schedule(self.noise)
        check_range(0, above=True, noise=self.noise_at(0))
        self.holds = True
        self.allowed, self.best = math.nan, torch.empty(0)  # returns of the best look, [C]
        self.guide, self.guide_failures, self.sign, self.unit = 0, 0, 1, 1.0
        self.kept: dict[str, Tensor] = {}  # state of the policy at the best look

    def attach(self, head: AnchoredHead) -> AnchoredHead:
        """Choose the head of the policy, and return it."""
        self.head = head
        return head

    @property
    def weight(self) -> float:
        """Weight of the guide, or of its opposite; 0 without an anchor."""
        return self.sign * float(self.head.weight.sum())

    def weights(self, value: float) -> Tensor:
        """Return the weights of all guides, [n_guides], with a value for the one that holds, or for its opposite."""
        return self.starts()[self.guide] * (self.sign * value)

    def starts(self) -> list[Tensor]:
        """Return the weights, [n_guides] each, of the look before training: each guide, none, each opposite."""
        guides = torch.eye(len(self.head.weight), device=self.head.weight.device)
        return [*guides, guides[0] * 0, *-guides]

    def waits(self, progress: float) -> bool:
        """Return whether the policy is not to learn yet."""
        return self.holds and progress < self.warmup

    @torch.no_grad()
    def set_noise(self, progress: float) -> dict[str, float]:
        """Set the standard deviation of an anchored policy that has one of its own.

        The metrics are `anchor`, the weight of the guide, below 0 of its opposite; and `noise`, the
        standard deviation.
        """
        scale: Tensor | None = getattr(self.head.head, "log_scale", None)
        if scale is not None and self.holds:
            scale.fill_(math.log(self.noise_at(progress)))
        return {"anchor": self.sign * self.weight} | (
            {} if scale is None else {"noise": float(scale.exp().mean())}
        )

    def due(self, update: int, updates: int) -> bool:
        """Return whether the brake is to test the policy after an update; `updates` is the number of all updates."""
        return self.holds and update in {
            round(updates * look / self.looks) for look in range(1, self.looks + 1)
        } - {0}

    def tried(self) -> list[Tensor]:
        """Return the two weights to test, [n_guides] each: the present one, and one that is lower by the margin."""
        return [
            self.weights(weight) for weight in (self.weight, max(self.weight - self.margin, 0.0))
        ]

    def begin(self, look: Look, random: Tensor, policy: nn.Module) -> None:
        """Choose the best guide, or the opposite of one, as the anchor of the policy, or none.

        `look` is with the weights of `starts`; `random` are returns of random actions, [C].
        """
        guides = len(self.head.weight)
        best = max((index for index in range(2 * guides + 1) if index != guides), key=look.score)
        others = torch.stack([look.returns[guides], random])
        differences = look.returns[best] - others
        self.holds = bool((differences.mean(1) > standard_error(differences)).all())
        self.guide, self.sign = best % (guides + 1), 1 if best < guides else -1
        self.head.weight.copy_(self.weights(float(self.holds)))
        self.set_noise(0.0)
        self.guide_failures = look.failures[best]
        if self.holds:
            self._keep(policy, look.returns[best])
            self.unit = max(abs(look.score(best)), float(others.mean(1).abs().max()))
        self.allowed = max(
            self.tolerance * abs(look.score(best)), float(standard_error(look.returns[best])) / 2
        )

    def decide(self, look: Look, policy: nn.Module) -> bool:
        """Lower the weight of the guide or keep it, after drives with the two weights of `tried`.

        If the policy has become worse, it goes back to that of the best look instead; return
        whether it did.
        """
        now, lower, best = look.score(0), look.score(1), float(self.best.mean())
        chance = 2 * float(standard_error(self.best - look.returns[0]))
        if look.failures[0] > self.guide_failures or now < best - max(3 * self.allowed, chance):
            policy.load_state_dict(self.kept)
            return True
        if now >= best:
            self._keep(policy, look.returns[0])
        steps = self.margin / self.step if self.step else 1.0
        if look.failures[1] <= look.failures[0] and lower >= now - steps * self.allowed:
            fall = self.margin if lower > max(now, best) + 3 * self.allowed else self.step
            self.head.weight.copy_(self.weights(max(self.weight - fall, 0.0)))
        return False

    def _keep(self, policy: nn.Module, returns: Tensor) -> None:
        self.best, self.kept = (
            returns,
            {name: value.clone() for name, value in policy.state_dict().items()},
        )


def standard_error(values: Tensor) -> Tensor:
    """Return the standard error of the mean over the last dimension."""
    return values.std(-1) / values.shape[-1] ** 0.5
