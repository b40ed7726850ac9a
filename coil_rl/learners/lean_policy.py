"""Policies as functions of tensors: their own modules and numbers, without TensorDicts in between.

A rollout and an update call a small network thousands of times. Then the searches for keys, and the
objects that TorchRL makes for a distribution, take longer than the arithmetic. Here the modules of
a policy read and write a plain dictionary, and the distribution is written out. The numbers are
those of the policy to the bit. A policy that is made of other modules keeps TorchRL's way.
"""

import math
from abc import ABC, abstractmethod
from typing import Any

import torch
from tensordict import NestedKey
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictSequential
from torch import Tensor
from torch.distributions import Categorical
from torch.nn import functional as F
from torchrl.modules import IndependentNormal, TanhNormal

from coil_rl.learners.anchor import AnchoredInputs, AnchoredSample
from coil_rl.learners.networks import FastTensorDictModule
from coil_rl.learners.normaliser import Normaliser
from coil_rl.learners.sampling import NOISE, ClippedNormal, Sample

INPUTS = (Normaliser, AnchoredInputs)  # modules that change what networks read
LOG_ROOT = math.log(math.sqrt(2 * math.pi))  # of a normal density


class Entries(dict[NestedKey, Tensor]):
    """Entries by key, for modules that read one by its key and write one by `set`."""

    def set(self, key: NestedKey, value: Tensor) -> "Entries":
        """Write an entry."""
        self[key] = value
        return self


Parameters = tuple[Tensor, ...]  # of a distribution


class Density(ABC):
    """A distribution of actions, written out."""

    @abstractmethod
    def parameters(self, entries: Entries) -> Parameters:
        """Return the parameters that a head has written."""

    @abstractmethod
    def draw(self, parameters: Parameters, noise: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return a sample [*batch, *event] and its logarithmic density [*batch].

        Args:
            parameters: of the distribution.
            noise: standard normal numbers of a rollout; None: new random numbers.
        """

    @abstractmethod
    def log_prob(self, parameters: Parameters, sample: Tensor) -> Tensor:
        """Return the logarithmic density [*batch] of a sample."""

    @abstractmethod
    def entropy(self, parameters: Parameters) -> Tensor:
        """Return the entropy [*batch]."""


class NormalDensity(Density):
    """Normal distribution of independent numbers.

    Args:
        event_dims: number of dimensions of an action.
    """

    def __init__(self, event_dims: int) -> None:
        self.event_dims = event_dims

    def parameters(self, entries: Entries) -> Parameters:
        """Return mean and standard deviation."""
        return entries["loc"], entries["scale"]

    def draw(self, parameters: Parameters, noise: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return a sample and its logarithmic density; arguments as for `Density`."""
        loc, scale = parameters
        if noise is None:
            noise = torch.empty(loc.shape, dtype=loc.dtype, device=loc.device).normal_()
        sample = loc + noise * scale
        return sample, self.log_prob(parameters, sample)

    def log_prob(self, parameters: Parameters, sample: Tensor) -> Tensor:
        """Return the logarithmic density of a sample."""
        loc, scale = parameters
        squares = -(sample - loc).square() / (2 * scale.square())
        return self.summed(squares - scale.log() - LOG_ROOT)

    def entropy(self, parameters: Parameters) -> Tensor:
        """Return the entropy."""
        return self.summed(0.5 + 0.5 * math.log(2 * math.pi) + parameters[1].log())

    def summed(self, values: Tensor) -> Tensor:
        """Return the sums over the numbers of an action."""
        return values.flatten(-self.event_dims).sum(-1) if self.event_dims else values


class SquashedDensity(Density):
    """Normal distribution whose samples tanh squashes to between -1 and 1.

    Args:
        event_dims: number of dimensions of an action.
    """

    def __init__(self, event_dims: int) -> None:
        self.normal = NormalDensity(event_dims)

    def parameters(self, entries: Entries) -> Parameters:
        """Return mean and standard deviation before tanh."""
        return self.normal.parameters(entries)

    def draw(self, parameters: Parameters, noise: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return a sample and its logarithmic density; arguments as for `Density`."""
        number, density = self.normal.draw(parameters, noise)
        sample = self._clamp(number.tanh())
        if noise is not None:  # as `Sample` does
            return sample, self.log_prob(parameters, sample)
        return sample, density - self._stretch(number)

    def log_prob(self, parameters: Parameters, sample: Tensor) -> Tensor:
        """Return the logarithmic density of a sample."""
        number = self._clamp(sample).atanh()
        return self.normal.log_prob(parameters, number) - self._stretch(number)

    def entropy(self, parameters: Parameters) -> Tensor:
        """Raise a `NotImplementedError`: there is no formula."""
        raise NotImplementedError("the entropy of a squashed normal distribution has no formula")

    def _stretch(self, number: Tensor) -> Tensor:
        """Return the logarithmic slope of tanh at the numbers of an action."""
        return self.normal.summed(2.0 * (math.log(2.0) - number - F.softplus(-2.0 * number)))

    def _clamp(self, sample: Tensor) -> Tensor:
        """Return samples as TorchRL keeps them from the bounds."""
        limit = 1.0 - torch.finfo(sample.dtype).resolution
        return sample.clamp(-limit, limit)


class ChoiceDensity(Density):
    """Distribution of one of several options, as an index."""

    def parameters(self, entries: Entries) -> Parameters:
        """Return the logarithmic probabilities."""
        logits = entries["logits"]
        return (logits - logits.logsumexp(-1, keepdim=True),)

    def draw(self, parameters: Parameters, noise: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return an index and its logarithmic probability; arguments as for `Density`."""
        (logits,) = parameters
        drawn = torch.multinomial(logits.softmax(-1).reshape(-1, logits.shape[-1]), 1, True)
        sample = drawn.T.reshape(logits.shape[:-1])
        return sample, self.log_prob(parameters, sample)

    def log_prob(self, parameters: Parameters, sample: Tensor) -> Tensor:
        """Return the logarithmic probability of an index."""
        return parameters[0].gather(-1, sample.long().unsqueeze(-1)).squeeze(-1)

    def entropy(self, parameters: Parameters) -> Tensor:
        """Return the entropy."""
        (logits,) = parameters
        floor = torch.finfo(logits.dtype).min
        return -(logits.clamp(min=floor) * logits.softmax(-1)).sum(-1)


def density_of(sample: Sample) -> Density | None:
    """Return the written-out distribution of a module that samples; None if there is none."""
    options = sample.options or {}
    if sample.distribution is IndependentNormal:
        return NormalDensity(options["event_dim"])
    if sample.distribution is TanhNormal and _is_unit(options):
        return SquashedDensity(options["event_dims"])
    return ChoiceDensity() if sample.distribution is Categorical else None


def _is_unit(options: Any) -> bool:
    """Return whether the bounds of an action are -1 and 1."""
    return bool((options["low"] == -1).all()) and bool((options["high"] == 1).all())


class LeanPolicy:
    """A policy that reads and writes `Entries`.

    Args:
        policy: for which `covers` is true. It keeps the weights.

    Attributes:
        inputs: the modules that change what the network reads.
        head: the module that gives the parameters of the distribution.
        density: the distribution.
    """

    def __init__(self, policy: ProbabilisticTensorDictSequential) -> None:
        *self.inputs, self.head, self.last = policy.module
        density = density_of(self.last)
        if density is None:
            raise ValueError("this policy has no lean form, see LeanPolicy.covers")
        self.density = density

    @staticmethod
    def covers(policy: Any) -> bool:
        """Return whether a policy has this form.

        It has if it is a network after at most a normaliser and shown advice, without a memory, for
        numbers that are squashed to between -1 and 1, clipped or unbounded, or for one choice. It
        may be anchored.
        """
        if type(policy) is not ProbabilisticTensorDictSequential:
            return False
        modules = list(policy.module)
        kinds = [type(module) for module in modules]
        return (
            len(kinds) >= 2
            and all(kind in INPUTS for kind in kinds[:-2])
            and kinds[-2] is FastTensorDictModule
            and kinds[-1] in (Sample, ClippedNormal, AnchoredSample)
            and density_of(modules[-1]) is not None
        )

    def act(self, entries: Entries) -> Entries:
        """Write what the policy writes: parameters, sample, its density and the action."""
        for module in (*self.inputs, self.head):
            module(entries)
        parameters = self.density.parameters(entries)
        sample, log_prob = self.density.draw(parameters, entries.get(NOISE))
        entries |= {self.last.sample_key: sample, "action_log_prob": log_prob}
        self.last.write_action(entries)
        return entries


def networks_of(critic: Any) -> list[FastTensorDictModule] | None:
    """Return the networks of a critic after what changes its inputs; None if it has others."""
    modules = list(critic.module) if type(critic) is TensorDictSequential else [critic]
    kinds = {type(module) for module in modules}
    if not kinds <= {*INPUTS, FastTensorDictModule}:
        return None
    return [module for module in modules if isinstance(module, FastTensorDictModule)]
