"""Anchored COIL: a policy that starts as its guide, if the guide is worth it, and else as PPO's.

COIL's first policy is that of plain reinforcement learning, whatever the guide advises. An anchored
policy executes, in normalised actions,

    a = clip(w g + r x),  x from the learner's own distribution, with mean 0 at first

so that its first deterministic action is w times the guide's action g, and the learner changes it
by at most r. This is a residual policy (Silver et al. 2018; Johannink et al. 2019) that also
observes the advice. For choices a constant is added to the logit of the advised option instead, and
to the value of the advised action in DQN. The weight w does not change during the training.

Before the training a start test decides w, in a few new cases whose steps are counted as frames:
the guide, or its opposite, is held if it is clearly and materially better than the new policy as it
acts in training; perhaps with a lower gain, if that is better still. If none is, w is 0, r is 1,
the advice is hidden from the networks, and the learner learns alone. The test at the end of the
training, which may hand over the guide itself, is in `coil_rl.run.delivery`.

The parts are `Anchor`, the numbers that a user chooses; `Hold`, the weights, which are a part of
the policy; what acts by them (`ShownAdvice`, `AnchoredSample`, `AnchoredHead`, `AnchoredValues`);
and `StartTest`, which sets them.
"""

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor, nn
from torchrl.envs import EnvBase, Transform

from coil_rl.learners.learner import Callback, Cases
from coil_rl.learners.normaliser import Normaliser
from coil_rl.learners.policy import UNCLIPPED, KeyModule, Sample
from coil_rl.ranges import Interval, Positive, Share, checked
from coil_rl.transforms.action_space import ActionSpace
from coil_rl.transforms.guide_actions import GuideActions

TIE = 1e-6  # decides between equal values
ADVISED = 0.9  # probability of the advised one of several options at a choice weight of 1
# Numbers of cases after which the start test may end, with the number of standard errors that a
# difference must exceed: quantiles of the t distribution, 0.5 % of one tail up to 8 cases, and 1 %
# at the last. Two cases have no such quantile of use; theirs was chosen on eight tasks.
BARS = {2: 20.0, 4: 5.8, 8: 3.5, 12: 2.7}
# Shares that the start test may take while something is ahead in every case, or for lower gains.
PROMISING = 1.6
GAIN_CASES = (4, 12)  # numbers of cases after which the comparison of gains may end
GAIN_ERRORS = 1.0  # standard errors by which a lower gain must be better: any of them is usable


@checked
@dataclass(frozen=True, kw_only=True)
class Anchor:
    """Settings of anchored COIL.

    Args:
        reach: r, how far the learner may go from the guide, as a share of the range from the centre
            of the action to its bound.
        gains: further values of w that the start test tries, from the highest to the lowest.
        choice_weight: of an advised option: 0 for none; with 1 the option has a probability of 0.9
            at first. In DQN the share of the range of the values that the advised action gains.
        share: of the frames of the run that the start test may take, and 1.6 times this share while
            something is ahead in every case, or for lower gains. Its first cases may take more.
            None: 0.05, or 0.15 of a learner with replay, which learns from these steps too.
        least_cases: of the start test, whatever they take: after two only a very large difference
            is certain, but where episodes are long four may be the whole run.
        advice_key: entry with the advice, [*batch, n_guides, A].

    Raises:
        ValueError: for a value out of range.
    """

    reach: Positive = 1.0
    gains: Sequence[Annotated[float, Interval(gt=0, le=1)]] = (0.75, 0.5)
    choice_weight: Positive = 0.5
    share: Share | None = None
    least_cases: Annotated[int, Interval(ge=2)] = 2
    advice_key: NestedKey = "guide_action"


class Hold(nn.Module):
    """The weights with which an anchored policy holds its guides.

    Args:
        guides: number of guides.
        space: of the actions.
        device: of the weights; None: PyTorch's default.

    Attributes:
        weight: w of each guide, [n_guides], below 0 for its opposite; all 0: none is held.
    """

    def __init__(self, guides: int, space: ActionSpace, device: torch.device | None = None) -> None:
        super().__init__()
        self.weight: Tensor = nn.Buffer(torch.eye(guides, device=device)[0])
        self.space = space

    @property
    def held(self) -> Tensor:
        """Whether a guide is held, a scalar."""
        return (self.weight != 0).any()

    def set(self, weight: Tensor | Sequence[float]) -> None:
        """Set the weights, [n_guides], in place."""
        self.weight.copy_(torch.as_tensor(weight))

    def pull(self, advice: Tensor) -> Tensor:
        """Return the weighted sum [*batch, A] of advice [*batch, n_guides, A].

        The opposite of an option is the option at its place in reverse order.
        """
        advice, weight = self.space.normalise(advice), self.weight.to(advice.dtype)
        if self.space.continuous:
            return weight @ advice
        return weight.clamp(min=0) @ advice + (-weight).clamp(min=0) @ self.space.mirrored(advice)


class ShownAdvice(KeyModule):
    """The advice as networks see it: 0 if no guide is held. It is written as `("shown", KEY)`.

    Args:
        hold: the weights.
        key: entry with the advice.
    """

    def __init__(self, hold: Hold, key: NestedKey) -> None:
        super().__init__([key], [unravel_key(("shown", key))])
        self.hold = hold

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the shown advice."""
        advice = tensordict[self.in_keys[0]]
        return tensordict.set(self.out_keys[0], advice * self.hold.held.to(advice.dtype))


class AnchoredInputs(KeyModule):
    """What the networks of an anchored learner read: normalised entries, and shown advice.

    Args:
        normaliser: of some entries; None: of none.
        shown: the advice.
    """

    def __init__(self, normaliser: Normaliser | None, shown: ShownAdvice) -> None:
        parts: list[Normaliser | ShownAdvice] = [] if normaliser is None else [normaliser]
        parts.append(shown)
        super().__init__(
            [key for part in parts for key in part.in_keys],
            [key for part in parts for key in part.out_keys],
        )
        self.parts = nn.ModuleList(parts)

    @property
    def hold(self) -> Hold:
        """The weights."""
        hold: Hold = self.parts[-1].hold  # type: ignore[assignment]
        return hold

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the entries."""
        for part in self.parts:
            tensordict = part(tensordict)
        return tensordict


class AnchoredSample(Sample):
    """Sample of numbers that is added to the action of a held guide.

    It writes `unclipped_action`, the learner's own part x, with `action_log_prob`, and the action,
    which the env executes.

    Args:
        sample: of the learner's own part.
        hold: the weights.
        anchor: the settings.
        action_key: entry for the action.
    """

    def __init__(self, sample: Sample, hold: Hold, anchor: Anchor, action_key: NestedKey) -> None:
        kind, options = sample.distribution_class, sample.distribution_kwargs
        super().__init__(sample.in_keys, UNCLIPPED, kind, options, action_key)
        self.hold, self.anchor = hold, anchor

    def write_action(self, entries: Any) -> None:
        """Write the action of the own part and the advice in some entries [*batch]."""
        space, own = self.hold.space, entries[UNCLIPPED]
        pull = self.hold.pull(entries[self.anchor.advice_key]).to(own.dtype)
        reach = torch.where(self.hold.held, self.anchor.reach, 1.0).to(own.dtype)
        action = space.denormalise(pull + reach * space.normalise(own))
        entries.set(self.action_key, space.clamp(action))


class AnchoredHead(nn.Module):
    """Head of a policy over options, with a bonus in the logits of the advised ones.

    Args:
        head: gives the logits.
        hold: the weights.
        valid: whether a choice has an option, [*event, n].
        weight: see `Anchor.choice_weight`.
    """

    def __init__(self, head: nn.Module, hold: Hold, valid: Tensor, weight: float) -> None:
        super().__init__()
        self.head, self.hold = head, hold
        options = valid.sum(-1, keepdim=True).clamp_min(2)
        bonus = weight * (math.log(ADVISED / (1 - ADVISED)) + (options - 1).log())
        # Plain tensors, as they are no state of the policy.
        self.bonus = bonus.expand(valid.shape).flatten()
        self.places = valid.flatten().nonzero().squeeze(-1)

    def forward(self, advice: Tensor, *inputs: Tensor) -> Tensor:
        """Return the logits of `head` for the inputs, with the bonus added."""
        logits: Tensor = self.head(*inputs)
        pull = self.hold.pull(advice)
        padded = torch.zeros(
            *pull.shape[:-1], self.bonus.numel(), dtype=pull.dtype, device=pull.device
        )
        bonus = padded.index_copy(-1, self.places, pull) * self.bonus
        return logits + bonus.to(logits.dtype).view_as(logits)


class AnchoredValues(nn.Module):
    """Values of actions with a bonus for the advised one: a share of the range of the values.

    So the advised action is taken unless its value is worse than the best one by more than this.

    Args:
        hold: the weights.
        weight: the share, see `Anchor.choice_weight`.
    """

    def __init__(self, hold: Hold, weight: float) -> None:
        super().__init__()
        self.hold, self.weight = hold, weight

    def forward(self, advice: Tensor, values: Tensor) -> Tensor:
        """Return values [*batch, n] with the bonus; advice is one-hot, [*batch, n_guides, n]."""
        span = values.amax(-1, keepdim=True) - values.amin(-1, keepdim=True)
        return values + self.weight * self.hold.pull(advice).to(values.dtype) * (span + TIE)


def hold_of(policy: nn.Module) -> Hold | None:
    """Return the weights of an anchored policy; None for another policy."""
    return next((part for part in policy.modules() if isinstance(part, Hold)), None)


def rest_guides(policy: nn.Module, env: EnvBase, others: Sequence[NestedKey]) -> None:
    """Stop asking the guides of an env whose advice nothing reads.

    The networks of a policy that holds no guide see 0 in place of advice.

    Args:
        others: entries that something else reads.
    """
    hold = hold_of(policy)
    if hold is None or hold.held:
        return
    transforms = [each for each in env.modules() if isinstance(each, Transform)]
    read = {*others, *(key for each in transforms for key in each.in_keys or ())}
    for each in transforms:
        if isinstance(each, GuideActions) and each.out_keys[0] not in read:
            each.rest()


def start_tests(
    anchor: Anchor | None, policy: nn.Module, cases: Cases, share: float = 0.05
) -> list[Callback]:
    """Return the start test of an anchored policy; nothing for another policy.

    Args:
        anchor: the settings; None: the policy is not anchored.
        share: of the frames that the test may take, unless the settings have another one.
    """
    hold = hold_of(policy)
    if anchor is None or hold is None:
        return []
    share = share if anchor.share is None else anchor.share
    return [StartTest(anchor, share, policy, hold, cases)]


class StartTest:
    """The test before the training that decides which guide a policy holds, a `Callback`.

    All compared policies act in the same new cases: each guide alone and its opposite, both
    deterministically; and the new policy without a guide as it acts in training. A guide or
    opposite is held if its mean return is better by more than one standard deviation of the new
    policy's returns, and by more than a number of standard errors of the difference (`BARS`). The
    best one that passes is held. Opposites are tried only where no guide passes or was ahead in
    every case. Once some of them are ahead in every case, only these go on. More cases are added
    until one passes, or the test would take more than its share of the frames; what is ahead in
    every case may take more.

    Then lower gains of it are tried in further cases. One is taken if it is better by more than a
    standard error than the best of the gains above it, or, where the test would take more than its
    share, by the number of standard errors with which a guide is held.

    Args:
        anchor: the settings.
        share: of the frames that the test may take, see `Anchor.share`.
        policy: of the learner.
        hold: its weights.
        cases: in which policies are tested.
    """

    names: Sequence[str] = (
        "start/guide",
        "start/opposite",
        "start/new",
        "start/cases",
        "start/weight",
    )

    def __init__(
        self, anchor: Anchor, share: float, policy: nn.Module, hold: Hold, cases: Cases
    ) -> None:
        self.anchor, self.share = anchor, share
        self.policy, self.hold, self.cases = policy, hold, cases
        self.returns: dict[tuple[float, ...], Tensor] = {}  # by the weights
        self.steps: dict[tuple[float, ...], int] = {}  # of the episodes with these weights

    def due(self, update: int, updates: int, row: Mapping[str, float]) -> bool:
        """Return whether the training has not begun."""
        return update == 0

    def after_update(self, update: int) -> dict[str, float]:
        """Test, set the weights, and return the mean returns and the weight by name."""
        self.cases.begin()
        guides = [tuple(row) for row in torch.eye(len(self.hold.weight)).tolist()]
        opposites = [tuple(-value for value in row) for row in guides]
        new = tuple(0.0 for _ in guides)
        held = self._first_held(guides, opposites, new)
        # Before gains are compared in other cases: these are returns in the same ones.
        means = self._best(guides), self._best(opposites), self._mean(new)
        self.cases.guide_ahead = held == new and bool(self._ahead(guides, new))
        if held != new and self.hold.space.continuous and self.anchor.gains:
            held = self._best_gain(held)
        self.hold.set(held)
        numbers = (*means, float(len(self.returns[new])), sum(held))
        return dict(zip(self.names, numbers, strict=True))

    def _first_held(
        self, guides: Sequence[Any], opposites: Sequence[Any], new: tuple[float, ...]
    ) -> tuple[float, ...]:
        """Return the weights of the best guide or opposite that passes; those of none else."""
        done, shares = 0, 1.0
        for total in BARS:
            more = total - done
            steps = more * sum(map(self._length, [new, *guides, *opposites]))
            if total > self.anchor.least_cases and not self._affordable(steps, shares):
                break
            self.cases.renew(more)
            self._act([new, *guides])
            if found := self._passing(guides, new):
                return found
            if ahead := self._ahead(guides, new):
                guides, opposites = ahead, []
            self._act(opposites)
            if found := self._passing(opposites, new):
                return found
            if not ahead and (ahead := self._ahead(opposites, new)):
                guides, opposites = [], ahead
            done, shares = total, PROMISING if ahead else 1.0
        return new

    def _best_gain(self, held: tuple[float, ...]) -> tuple[float, ...]:
        """Return the best gain of held weights; these where the frames do not allow for a test."""
        tried = [held] + [tuple(gain * value for value in held) for gain in self.anchor.gains]
        length = self._length(held)  # with a lower gain episodes are assumed to be as long
        done, best = 0, held
        for total in GAIN_CASES:
            more = total - done
            steps = more * sum(self._length(each) or length for each in tried)
            if self._affordable(steps):
                errors = GAIN_ERRORS
            elif self._affordable(steps, PROMISING):
                errors = BARS[total]
            else:
                break
            if done == 0:  # all gains are compared in the same new cases
                del self.returns[held], self.steps[held]
            self.cases.renew(more)
            self._act(tried)
            best = held
            for each in tried[1:]:
                if self._clear(each, best, errors):
                    best = each
            done = total
        return best

    def _affordable(self, steps: float, shares: float = 1.0) -> bool:
        """Return whether the frames of the test allow for further steps.

        Args:
            shares: of the frames that the test may take, see `Anchor.share`.
        """
        return self.cases.steps + steps <= shares * self.share * self.cases.frames

    def _act(self, each: Sequence[tuple[float, ...]]) -> None:
        """Add the returns of the policy with each of some weights in the present cases."""
        if not each:
            return
        policies = [self._with(weights) for weights in each]
        found = self.cases.compared(policies, [not any(weights) for weights in each])
        for weights, returns, steps in zip(each, found, self.cases.taken, strict=True):
            known = self.returns.get(weights, returns.new_empty(0))
            self.returns[weights] = torch.cat([known, returns])
            self.steps[weights] = self.steps.get(weights, 0) + steps

    def _with(self, weights: tuple[float, ...]) -> Any:
        """Return a copy of the policy with some weights."""
        # Copied together, so that the weights stay those of the policy.
        policy, hold = copy.deepcopy((self.policy, self.hold))
        hold.set(weights)
        return policy

    def _passing(self, candidates: Sequence[Any], new: tuple[float, ...]) -> Any:
        """Return the best of some weights that pass; None if none does."""
        spread = float(self.returns[new].std())
        passing = [
            each
            for each in candidates
            if self._mean(each) - self._mean(new) > spread and self._clear(each, new)
        ]
        return max(passing, key=self._mean, default=None)

    def _ahead(self, candidates: Sequence[Any], new: tuple[float, ...]) -> list[Any]:
        """Return the candidates that were better than the new policy in all of their cases."""
        known = [(each, self.returns[each]) for each in candidates]
        return [each for each, own in known if (own > self.returns[new][: len(own)]).all()]

    def _clear(
        self, better: tuple[float, ...], worse: tuple[float, ...], errors: float | None = None
    ) -> bool:
        """Return whether a paired difference is more than some standard errors.

        Args:
            errors: number of standard errors; None: the bar of the number of cases.
        """
        both = torch.stack([self.returns[better], self.returns[worse]])
        differences = both[0] - both[1]
        bar = BARS[len(differences)] if errors is None else errors
        error = float(standard_error(differences))
        if len(differences) == 2:
            # Where returns are whole numbers, two differences are often the same by chance.
            error = max(error, float(standard_error(both).square().sum().sqrt()))
        mean = float(differences.mean())
        return mean > 0 and mean > bar * error

    def _length(self, weights: tuple[float, ...]) -> float:
        """Return the mean number of steps of an episode with some weights; 0 before the first."""
        known = self.returns.get(weights)
        return 0.0 if known is None else self.steps[weights] / len(known)

    def _mean(self, weights: tuple[float, ...]) -> float:
        return float(self.returns[weights].mean())

    def _best(self, candidates: Sequence[Any]) -> float:
        """Return the highest mean return of some weights, NaN if none of them was tried."""
        means = [self._mean(each) for each in candidates if each in self.returns]
        return max(means, default=math.nan)


def standard_error(values: Tensor) -> Tensor:
    """Return the standard error of the mean over the last dimension."""
    return values.std(-1) / values.shape[-1] ** 0.5
