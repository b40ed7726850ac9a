"""Actors and critics, built from an env's specs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import NormalParamExtractor, TensorDictModuleBase
from torch import Tensor, nn
from torch.distributions import Categorical as CategoricalDistribution
from torchrl.data import Bounded, Categorical, OneHot, TensorSpec
from torchrl.envs import EnvBase
from torchrl.modules import MLP, IndependentNormal, OneHotCategorical, ProbabilisticActor, TanhNormal


class Joined(nn.Module):
    """Some of an env's entries as one vector: each is flattened beyond the batch, then they are joined.

    Args:
        env: for its specs.
        in_keys: the entries.
        shapes: of those that the env does not write, without the batch.

    Attributes:
        width: D, length of the vector.

    Raises:
        KeyError: if the env has no such entry, naming those it has.
    """

    def __init__(self, env: EnvBase, in_keys: Sequence[str], shapes: Mapping[str, torch.Size] | None = None) -> None:
        super().__init__()
        spec, batch, others = env.observation_spec, len(env.batch_size), shapes or {}
        known = [*(key for key in spec.keys(True, True) if isinstance(key, str)), *others]
        missing = [key for key in in_keys if key not in known]
        if missing:
            raise KeyError(f"the env has no entry {', '.join(missing)} to observe; it has {', '.join(known)}")
        each = [others[key] if key in others else spec[key].shape[batch:] for key in in_keys]
        self.event_dims = [len(shape) for shape in each]
        self.width = sum(shape.numel() for shape in each)

    def forward(self, *inputs: Tensor) -> Tensor:
        """[*batch, ...] each to [*batch, D]."""
        flat = [
            x.unsqueeze(-1) if dims == 0 else x.flatten(-dims) for x, dims in zip(inputs, self.event_dims, strict=True)
        ]
        return torch.cat(flat, -1) if len(flat) > 1 else flat[0]


def tanh_layers(
    inputs: int, outputs: int, hidden: Sequence[int], gain: float, device: torch.device | None = None
) -> MLP:
    """A tanh network with PPO's orthogonal start.

    Args:
        inputs: width of what it reads.
        outputs: width of the last layer.
        hidden: widths of the hidden layers.
        gain: size of the last layer's weights.
        device: where it lives.
    """
    layers = MLP(inputs, outputs, num_cells=list(hidden), activation_class=nn.Tanh, device=device)
    linear = [layer for layer in layers if isinstance(layer, nn.Linear)]
    for layer in linear:
        nn.init.orthogonal_(layer.weight, gain if layer is linear[-1] else 2**0.5)
        nn.init.zeros_(layer.bias)
    return layers


def relu_layers(
    inputs: int, outputs: int, hidden: Sequence[int], gain: float, device: torch.device | None = None
) -> MLP:
    """A rectified network with PyTorch's own start, the last layer scaled by `gain`; arguments as for `tanh_layers`."""
    layers = MLP(inputs, outputs, num_cells=list(hidden), activation_class=nn.ReLU, device=device)
    with torch.no_grad():
        for parameter in layers[-1].parameters():
            parameter.mul_(gain)
    return layers


class Network(nn.Module):
    """A network over some of an env's entries, joined.

    Args:
        env: for its specs.
        in_keys: the entries.
        hidden: widths of the hidden layers.
        outputs: width of the last layer.
        gain: size of the last layer's weights.
        shapes: as for `Joined`.
        layers: makes them, as `tanh_layers` does.
    """

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[str],
        hidden: Sequence[int],
        outputs: int,
        gain: float,
        shapes: Mapping[str, torch.Size] | None = None,
        layers: Callable[..., MLP] = tanh_layers,
    ) -> None:
        super().__init__()
        self.joined = Joined(env, in_keys, shapes)
        self.layers = layers(self.joined.width, outputs, hidden, gain, env.device)

    def forward(self, *inputs: Tensor) -> Tensor:
        """[*batch, ...] each to [*batch, outputs]."""
        out: Tensor = self.layers(self.joined(*inputs))
        return out


class NormalHead(nn.Module):
    """A network's output as the mean of a normal distribution whose spread is a parameter, the same in every state."""

    def __init__(self, network: Network, size: int, scale: float) -> None:
        super().__init__()
        self.network = network
        self.log_scale = nn.Parameter(torch.full((size,), math.log(scale), device=network.layers[-1].weight.device))

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation, [*batch, A] each."""
        loc = self.network(*inputs)
        return loc, self.log_scale.exp().expand_as(loc)


class SpreadHead(nn.Module):
    """A network's output as mean and standard deviation of a normal distribution, both different in every state."""

    def __init__(self, network: Network, scale: float) -> None:
        super().__init__()
        self.network = network
        self.split = NormalParamExtractor(f"biased_softplus_{scale}", scale_lb=1e-3)

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation, [*batch, A] each; for an output of 0 that is `scale`."""
        loc, scale = self.split(self.network(*inputs))
        return loc, scale


class Keyed(TensorDictModuleBase):
    """A module from some entries of a tensordict to others.

    What `TensorDictModule` is, without its search for optional packages at every call, which takes as long as a small
    network does.

    Args:
        module: from tensors to a tensor or several.
        in_keys: its arguments.
        out_keys: its results.
    """

    def __init__(self, module: nn.Module, in_keys: Sequence[str], out_keys: Sequence[str]) -> None:
        self.in_keys, self.out_keys = list(in_keys), list(out_keys)
        super().__init__()
        self.module = module

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the results into the tensordict that is read."""
        results = self.module(*(tensordict[key] for key in self.in_keys))
        for key, result in zip(self.out_keys, results if isinstance(results, tuple) else (results,), strict=True):
            tensordict.set(key, result)
        return tensordict


def actor(
    env: EnvBase,
    in_keys: Sequence[str],
    hidden: Sequence[int] = (64, 64),
    scale: float = 0.5,
    gain: float = 0.01,
    shapes: Mapping[str, torch.Size] | None = None,
) -> ProbabilisticActor:
    """A stochastic policy for the env's action: a squashed normal where actions are bounded, else a normal or a choice.

    Its deterministic action is the mode. The standard deviation does not depend on the state.

    Args:
        env: for its specs.
        in_keys: what the agent observes.
        hidden: widths of the hidden layers.
        scale: standard deviation at the start, before squashing.
        gain: size of the last layer's weights at the start.
        shapes: as for `Joined`.

    Returns:
        A module that writes `action` and `action_log_prob`.
    """
    spec = env.action_spec
    discrete = isinstance(spec, (Categorical, OneHot))
    size = spec.space.n if discrete else spec.shape[-1]
    network = Network(env, in_keys, hidden, size, gain, shapes)
    common = dict(spec=spec, return_log_prob=True, log_prob_key="action_log_prob")
    if discrete:
        module = Keyed(network, in_keys, ["logits"])
        kind = CategoricalDistribution if isinstance(spec, Categorical) else OneHotCategorical
        return ProbabilisticActor(module, ["logits"], distribution_class=kind, **common)
    module = Keyed(NormalHead(network, size, scale), in_keys, ["loc", "scale"])
    return ProbabilisticActor(module, ["loc", "scale"], **_distribution(spec), **common)


def spread_actor(
    env: EnvBase, in_keys: Sequence[str], hidden: Sequence[int] = (64, 64), scale: float = 0.5, gain: float = 0.01
) -> ProbabilisticActor:
    """As `actor`, for numbers only and with a standard deviation that depends on the state.

    Args:
        env: for its specs.
        in_keys: what the agent observes.
        hidden: widths of the hidden layers.
        scale: standard deviation at the start, before squashing.
        gain: size of the last layer's weights at the start.
    """
    spec = env.action_spec
    network = Network(env, in_keys, hidden, 2 * spec.shape[-1], gain)
    module = Keyed(SpreadHead(network, scale), in_keys, ["loc", "scale"])
    common = dict(spec=spec, return_log_prob=True, log_prob_key="action_log_prob")
    return ProbabilisticActor(module, ["loc", "scale"], **_distribution(spec), **common)


def _distribution(spec: TensorSpec) -> dict[str, object]:
    if not isinstance(spec, Bounded):
        return {"distribution_class": IndependentNormal}
    event = tuple(0 for _ in spec.shape[:-1])
    bounds = {"low": spec.space.low[event], "high": spec.space.high[event]}
    return {"distribution_class": TanhNormal, "distribution_kwargs": bounds | {"tanh_loc": False}}


def critic(env: EnvBase, in_keys: Sequence[str], hidden: Sequence[int] = (64, 64)) -> Keyed:
    """A state-value network over the same entries; writes `state_value` [*batch, 1]."""
    return Keyed(Network(env, in_keys, hidden, 1, gain=1.0), in_keys, ["state_value"])
