"""Distributions of actions, written out.

For small networks it takes longer to construct an object of `torch.distributions` than to compute
with it, and a rollout does so in each step. The samples are the same to the bit.
"""

import math

import torch
from torch import Tensor
from torch.distributions import Categorical, kl_divergence
from torch.nn import functional as F

LOG_ROOT = math.log(math.sqrt(2 * math.pi))  # of a normal density


class Normal:
    """Independent normal numbers.

    Args:
        loc: means, [*batch, *event].
        scale: standard deviations, of the same shape.
        event_dims: number of dimensions of an action.
    """

    def __init__(self, loc: Tensor, scale: Tensor, event_dims: int) -> None:
        self.loc, self.scale, self.event_dims = loc, scale, event_dims

    def drawn(self) -> tuple[Tensor, Tensor]:
        """Return random normal numbers, and their logarithmic normal density [*batch]."""
        noise = torch.empty(self.loc.shape, dtype=self.loc.dtype, device=self.loc.device).normal_()
        log_prob = summed(-noise.square() / 2 - self.scale.log() - LOG_ROOT, self.event_dims)
        return self.loc + noise * self.scale, log_prob

    def draw(self, noise: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return a sample [*batch, *event] and its logarithmic density [*batch].

        Args:
            noise: standard normal numbers of the shape of an action; None: new random numbers.
        """
        if noise is None:
            return self.drawn()
        number = self.loc + noise * self.scale
        return number, self.log_prob(number)

    def log_prob(self, sample: Tensor) -> Tensor:
        """Return the logarithmic density of a sample."""
        squares = -(sample - self.loc).square() / (2 * self.scale.square())
        return summed(squares - self.scale.log() - LOG_ROOT, self.event_dims)

    def entropy(self) -> Tensor:
        """Return the entropy."""
        return summed(0.5 + 0.5 * math.log(2 * math.pi) + self.scale.log(), self.event_dims)

    @property
    def mode(self) -> Tensor:
        """The means."""
        return self.loc

    def divergence(self, other: "Normal") -> Tensor:
        """Return the divergence KL(self || other) [*batch]; squashing both does not change it."""
        ratio, distance = self.scale / other.scale, (self.loc - other.loc) / other.scale
        return summed(0.5 * (ratio.square() + distance.square() - 1) - ratio.log(), self.event_dims)


class SquashedNormal(Normal):
    """Independent normal numbers that tanh squashes to the bounds of an action.

    Args:
        loc: means before squashing, [*batch, *event].
        scale: standard deviations before squashing.
        bounds: lower and upper ones, of the shape of an action; None: -1 and 1.
    """

    def __init__(
        self,
        loc: Tensor,
        scale: Tensor,
        event_dims: int,
        bounds: tuple[Tensor, Tensor] | None = None,
    ) -> None:
        super().__init__(loc, scale, event_dims)
        self.bounds = bounds

    def draw(self, noise: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return a sample and its logarithmic density."""
        if noise is not None:  # the density as an update computes it, from the sample
            sample = self.squashed(self.loc + noise * self.scale)
            return sample, self.log_prob(sample)
        number, log_prob = self.drawn()
        return self.squashed(number), log_prob - self._stretch(number)

    def log_prob(self, sample: Tensor) -> Tensor:
        """Return the logarithmic density of a sample."""
        number = self._clamp(self.unit(sample)).atanh()
        return super().log_prob(number) - self._stretch(number)

    def entropy(self) -> Tensor:
        """Return an estimate of the entropy by one sample."""
        return -self.draw()[1]

    @property
    def mode(self) -> Tensor:
        """The squashed means."""
        return self.squashed(self.loc)

    def squashed(self, number: Tensor) -> Tensor:
        """Return an action from normal numbers."""
        return self.from_unit(self._clamp(number.tanh()))

    def unit(self, action: Tensor) -> Tensor:
        """Return an action as numbers between -1 and 1."""
        if self.bounds is None:
            return action
        low, high = self.bounds
        return (action - (high + low) / 2) / ((high - low) / 2)

    def from_unit(self, unit: Tensor) -> Tensor:
        """Return an action from numbers between -1 and 1."""
        if self.bounds is None:
            return unit
        low, high = self.bounds
        return (high + low) / 2 + (high - low) / 2 * unit

    def _stretch(self, number: Tensor) -> Tensor:
        """Return the logarithmic slope of the squashing at the numbers of an action."""
        slopes = 2.0 * (math.log(2.0) - number - F.softplus(-2.0 * number))
        if self.bounds is not None:
            slopes = slopes + ((self.bounds[1] - self.bounds[0]) / 2).log()
        return summed(slopes, self.event_dims)

    def _clamp(self, sample: Tensor) -> Tensor:
        """Return samples as TorchRL keeps them from the bounds."""
        limit = 1.0 - torch.finfo(sample.dtype).resolution
        return sample.clamp(-limit, limit)


class Choices:
    """Independent choices, each as the index of one of several options.

    Args:
        logits: of the options, [*batch, *event, n].
        event_dims: number of dimensions of an action; 0: it is one choice.
    """

    def __init__(self, logits: Tensor, event_dims: int = 0) -> None:
        self.logits, self.event_dims = logits - logits.logsumexp(-1, keepdim=True), event_dims

    def draw(self, noise: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return indices and their logarithmic probability; noise is not for choices."""
        rows = self.logits.softmax(-1).reshape(-1, self.logits.shape[-1])
        drawn = torch.multinomial(rows, 1, True).T.reshape(self.logits.shape[:-1])
        return drawn, Choices.log_prob(self, drawn)

    def log_prob(self, sample: Tensor) -> Tensor:
        """Return the logarithmic probability of a sample."""
        return summed(
            self.logits.gather(-1, sample.long().unsqueeze(-1)).squeeze(-1), self.event_dims
        )

    def entropy(self) -> Tensor:
        """Return the entropy."""
        floor = torch.finfo(self.logits.dtype).min
        return summed(
            -(self.logits.clamp(min=floor) * self.logits.softmax(-1)).sum(-1), self.event_dims
        )

    @property
    def mode(self) -> Tensor:
        """The most probable options."""
        return self.logits.softmax(-1).argmax(-1)

    @property
    def valid(self) -> Tensor:
        """Whether each logit is that of an option, not padding, [*event, n]."""
        event = self.logits[(0,) * (self.logits.ndim - self.event_dims - 1)]
        return event > padding(self.logits.dtype) / 2

    def divergence(self, other: "Choices") -> Tensor:
        """Return the divergence KL(self || other) [*batch]."""
        own, others = (Categorical(logits=each.logits) for each in (self, other))
        return summed(kl_divergence(own, others), self.event_dims)


class OneHotChoice(Choices):
    """One choice, one-hot; logits [*batch, n]."""

    def draw(self, noise: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return a one-hot option and its logarithmic probability."""
        index, log_prob = super().draw(noise)
        return F.one_hot(index, self.logits.shape[-1]), log_prob

    def log_prob(self, sample: Tensor) -> Tensor:
        """Return the logarithmic probability of a one-hot option."""
        return super().log_prob(sample.argmax(-1))

    @property
    def mode(self) -> Tensor:
        """The most probable option."""
        return F.one_hot(super().mode, self.logits.shape[-1])


def padding(dtype: torch.dtype) -> float:
    """Return the logit of what is no option: finite, with a probability of exactly 0."""
    return torch.finfo(dtype).min / 2


def summed(values: Tensor, event_dims: int) -> Tensor:
    """Return the sums over the numbers or choices of an action, of `event_dims` dimensions."""
    return values.flatten(-event_dims).sum(-1) if event_dims else values


Density = Normal | Choices  # what a policy samples from
