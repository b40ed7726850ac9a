"""Heads of policies: the parameters of a distribution of actions from what a network gives."""

import math

import torch
from tensordict.nn import NormalParamExtractor
from torch import Tensor, nn

from coil_rl.learners.density import padding
from coil_rl.learners.encoders import ObservationNetwork


class GlobalScaleHead(nn.Module):
    """Normal distribution with a mean from a network, and one standard deviation for all states.

    Args:
        network: gives the mean of each number of an action.
        event: shape of an action.
        scale: initial standard deviation.
    """

    outputs = 1  # of the network for each number of an action

    def __init__(self, network: ObservationNetwork, event: torch.Size, scale: float) -> None:
        super().__init__()
        self.network, self.event = network, event
        self.log_scale = nn.Parameter(
            torch.full(event, math.log(scale), device=next(network.parameters()).device)
        )

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and standard deviation, [*batch, *event] each."""
        loc = shaped(self.network(*inputs), self.event)
        return loc, self.log_scale.exp().to(loc.dtype).expand_as(loc)


class GaussianHead(nn.Module):
    """Normal distribution with mean and standard deviation from a network.

    Args:
        network: gives the means of the numbers of an action, then as many outputs that become
            standard deviations.
        event: shape of an action.
        scale: standard deviation where the network gives 0.
    """

    outputs = 2

    def __init__(self, network: ObservationNetwork, event: torch.Size, scale: float) -> None:
        super().__init__()
        self.network, self.event = network, event
        self.split = NormalParamExtractor(f"biased_softplus_{scale}", scale_lb=1e-3)

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and standard deviation, [*batch, *event] each."""
        loc, scale = self.split(self.network(*inputs))
        return shaped(loc, self.event), shaped(scale, self.event)


class ChoicesHead(nn.Module):
    """Logits of several choices at once from a network.

    They are padded to the longest choice with a number so low that its probability is exactly 0. It
    is finite, because a number that is not in recorded data is a fault.

    Args:
        network: gives logits for all choices, of each as many as the longest one has.
        event: shape of an action, which is one index for each choice.
        options: number of options of each choice, of shape `event`.
    """

    def __init__(self, network: ObservationNetwork, event: torch.Size, options: Tensor) -> None:
        super().__init__()
        self.network, self.event = network, event
        longest = torch.arange(int(options.max()), device=options.device)
        self.valid: Tensor = nn.Buffer(longest < options.unsqueeze(-1), persistent=False)

    def forward(self, *inputs: Tensor) -> Tensor:
        """Return the logits, [*batch, *event, n]."""
        logits = shaped(self.network(*inputs), self.valid.shape)
        return logits.masked_fill(~self.valid, padding(logits.dtype))


def shaped(vectors: Tensor, event: torch.Size) -> Tensor:
    """Return vectors [*batch, n] as [*batch, *event]."""
    return vectors.reshape(*vectors.shape[:-1], *event)
