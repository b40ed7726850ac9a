"""Heads of policies: they turn what a network gives into the parameters of a distribution of actions."""

import math

import torch
from tensordict.nn import NormalParamExtractor
from torch import Tensor, nn
from torch.distributions import Categorical, Independent

from coil_rl.learners.encoders import ObservationNetwork


class GlobalScaleHead(nn.Module):
    """Normal distribution with a mean from a network and a standard deviation that is the same in every state.

    The network's outputs are the numbers of an action, of shape `event`; `scale` is the initial
    standard deviation.
    """

    def __init__(self, network: ObservationNetwork, event: torch.Size, scale: float) -> None:
        super().__init__()
        self.network, self.event = network, event
        self.log_scale = nn.Parameter(
            torch.full(event, math.log(scale), device=network.layers[-1].weight.device)
        )

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and standard deviation, [*batch, *event] each."""
        loc = shaped(self.network(*inputs), self.event)
        return loc, self.log_scale.exp().to(loc.dtype).expand_as(loc)


class GaussianHead(nn.Module):
    """Normal distribution with mean and standard deviation from a network; an output of 0 gives `scale`."""

    def __init__(self, network: ObservationNetwork, event: torch.Size, scale: float) -> None:
        super().__init__()
        self.network, self.event = network, event
        self.split = NormalParamExtractor(f"biased_softplus_{scale}", scale_lb=1e-3)

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and standard deviation, [*batch, *event] each."""
        loc, scale = self.split(self.network(*inputs))
        return shaped(loc, self.event), shaped(scale, self.event)


class ChoicesHead(nn.Module):
    """Logits of several choices at once from a network, padded with minus infinity to the longest choice.

    The network gives logits for all choices, each of as many as the longest one has. An action has
    the shape `event`, one index for each choice; so have the `options`, their numbers.
    """

    def __init__(self, network: ObservationNetwork, event: torch.Size, options: Tensor) -> None:
        super().__init__()
        self.network, self.event = network, event
        longest = torch.arange(int(options.max()), device=options.device)
        self.valid: Tensor = nn.Buffer(longest < options.unsqueeze(-1), persistent=False)

    def forward(self, *inputs: Tensor) -> Tensor:
        """Return the logits, [*batch, *event, n]."""
        return shaped(self.network(*inputs), self.valid.shape).masked_fill(~self.valid, -torch.inf)


class Choices(Independent):
    """Distribution of several independent choices, of each by the logits of its options [*batch, *event, n].

    An action, one index for each choice, has `event_dims` dimensions.
    """

    def __init__(self, logits: Tensor, event_dims: int) -> None:
        super().__init__(Categorical(logits=logits), event_dims)

    @property
    def deterministic_sample(self) -> Tensor:
        """The most probable choices."""
        return self.base_dist.mode


def shaped(vectors: Tensor, event: torch.Size) -> Tensor:
    """Return vectors [*batch, n] as [*batch, *event]."""
    return vectors.reshape(*vectors.shape[:-1], *event)
