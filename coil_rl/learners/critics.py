"""Several critics of actions, which are computed at once."""

from collections.abc import Sequence
from typing import Any, Literal

import torch
from tensordict import NestedKey
from torch import Tensor, nn
from torch.nn import functional as F
from torchrl.envs import EnvBase

from coil_rl.learners.encoders import ACTIVATIONS, ConcatObservations, Mlp
from coil_rl.learners.networks import Inputs, action_shape
from coil_rl.learners.policy import KeyModule, read_through

Norm = Literal["none", "layer", "batch"]
MOMENTUM = 0.01  # share of a batch in the running statistics


class LayerNorm(nn.Module):
    """Normalisation of the numbers of each row of several networks, [critics, N, width].

    Args:
        critics: number of networks.
        width: numbers of each.
    """

    def __init__(self, critics: int, width: int, device: torch.device | None) -> None:
        super().__init__()
        self.gain = nn.Parameter(torch.ones((critics, 1, width), device=device))
        self.shift = nn.Parameter(torch.zeros((critics, 1, width), device=device))

    def forward(self, x: Tensor, train: bool) -> Tensor:
        """Normalise numbers, with or without `train`."""
        return torch.addcmul(self.shift, F.layer_norm(x, x.shape[-1:]), self.gain)


class BatchNorm(LayerNorm):
    """Normalisation of the numbers of several networks over a batch, [critics, N, width].

    Outside of the learning it normalises by running statistics of the batches that it has learned.
    """

    def __init__(self, critics: int, width: int, device: torch.device | None) -> None:
        super().__init__(critics, width, device)
        self.mean: Tensor = nn.Buffer(torch.zeros_like(self.gain))
        self.variance: Tensor = nn.Buffer(torch.ones_like(self.gain))

    def forward(self, x: Tensor, train: bool) -> Tensor:
        """Normalise numbers; with `train` by those of this batch, which are learned."""
        mean, variance = self.mean, self.variance
        if train:
            variance, mean = torch.var_mean(x, 1, keepdim=True, correction=0)
            with torch.no_grad():
                self.mean.lerp_(mean, MOMENTUM)
                self.variance.lerp_(variance, MOMENTUM)
        return (x - mean) * (variance + 1e-3).rsqrt() * self.gain + self.shift


class Layer(nn.Module):
    """The same layer of several networks, computed at once.

    Args:
        each: the layer of each network.
    """

    def __init__(self, each: Sequence[nn.Linear]) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.stack([layer.weight.detach().T for layer in each]))
        self.bias = nn.Parameter(torch.stack([layer.bias.detach()[None] for layer in each]))

    def forward(self, x: Tensor) -> Tensor:
        """Map [critics, N, inputs] to [critics, N, outputs]."""
        return torch.baddbmm(self.bias, x, self.weight)


class Critics(KeyModule):
    """Networks that estimate the return of an action, with one tensor for a layer of all of them.

    As a module it writes their uncertainty: the standard deviation of the values of an action, in
    the unit of the return, as `("next", "uncertainty")` [*B, 1].

    Args:
        env: the env, for its specs.
        in_keys: entries that they observe, besides the action.
        network: architecture of each; convolutions are shared. Those of a subclass with `layers` of
            its own are computed one after the other.
        count: how many they are.
        outputs: numbers that each gives for an action.
        norm: "layer" normalises the hidden layers before their activation, "batch" what each layer
            reads, the inputs among them.
        dropout: share of the numbers of a hidden layer that are left out in learning.
        gain: factor of the numbers that each gives; a small one slows the last layer down.
        inputs: writes, before these are asked, what they read in place of some of `in_keys`.
    """

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[NestedKey],
        network: Mlp,
        count: int,
        *,
        outputs: int = 1,
        norm: Norm = "none",
        dropout: float = 0.0,
        gain: float = 1.0,
        inputs: Inputs | None = None,
    ) -> None:
        keys: list[NestedKey] = [*in_keys, "action"]
        super().__init__(read_through(inputs, keys), [("next", "uncertainty")])
        self.count, self.dropout, self.gain = count, dropout, gain
        self.concat = ConcatObservations(env, keys, {"action": action_shape(env)}, network)
        own = type(network).layers is not Mlp.layers
        architecture = network if own else Mlp(network.hidden, network.activation)
        width = self.concat.width
        alone = [architecture.layers(width, outputs, 1.0, env.device) for _ in range(count)]
        self.own = nn.ModuleList(alone if own else [])
        # Of each network its layers with weights; of those the first ones, the second ones, ...
        linear = [[each for each in mlp.modules() if isinstance(each, nn.Linear)] for mlp in alone]
        stacked = [] if own else zip(*linear, strict=True)
        self.layers = nn.ModuleList(Layer(same) for same in stacked)
        self.activation = ACTIVATIONS[network.activation]()
        self.norm: Norm = "layer" if norm == "none" and network.layer_norm else norm
        if own and (dropout or self.norm != "none"):
            raise ValueError(
                f"{type(network).__name__} has layers of its own, and critics normalise, or leave "
                "out numbers (dropout), in those of Mlp only; do so in these layers"
            )
        hidden: Sequence[int] = network.hidden
        widths = {"none": [], "layer": hidden, "batch": [width, *hidden]}[self.norm]
        kind = BatchNorm if self.norm == "batch" else LayerNorm
        self.norms = nn.ModuleList(kind(count, numbers, env.device) for numbers in widths)

    def outputs(self, entries: Any, *, train: bool = False) -> Tensor:
        """Return the numbers of each critic for the action of entries, [critics, *B, outputs].

        Args:
            entries: [*B] with `in_keys`.
            train: whether dropout acts, and batches are normalised by their own statistics.
        """
        read = self.concat(*(entries[key] for key in self.in_keys))
        x = read.reshape(-1, read.shape[-1]).expand(self.count, -1, -1)
        if len(self.own):
            x = torch.stack([layers(rows) for layers, rows in zip(self.own, x, strict=True)])
        for place, layer in enumerate(self.layers):
            if place and self.dropout and train:
                x = F.dropout(x, self.dropout)
            if place and self.norm == "layer":
                x = self.norms[place - 1](x, train)
            if place:
                x = self.activation(x)
            if self.norm == "batch":
                x = self.norms[place](x, train)
            x = layer(x)
        x = x if self.gain == 1 else x * self.gain
        return x.view(self.count, *read.shape[:-1], x.shape[-1])

    def values(self, entries: Any) -> Tensor:
        """Return the values of the action of entries [*B], [critics, *B]."""
        return self.outputs(entries).mean(-1)

    def forward(self, tensordict: Any) -> Any:
        """Write the uncertainty for the next step of the env."""
        tensordict.set(("next", "uncertainty"), self.values(tensordict).std(0).unsqueeze(-1))
        return tensordict
