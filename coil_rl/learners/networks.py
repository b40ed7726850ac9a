"""Policy and value networks, built from the specs of an env."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import NormalParamExtractor, ProbabilisticTensorDictSequential, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.distributions import Categorical as CategoricalDistribution
from torchrl.data import Bounded, Categorical, OneHot
from torchrl.envs import EnvBase
from torchrl.modules import (
    MLP,
    IndependentNormal,
    OneHotCategorical,
    ProbabilisticActor,
    SafeProbabilisticModule,
    TanhNormal,
)

from coil_rl.envs.limits import check_range

UNCLIPPED = "unclipped_action"


class ConcatObservations(nn.Module):
    """Concatenation of entries of an env, each flattened beyond the batch dimensions.

    Args:
        env: the env.
        in_keys: the entries.
        shapes: shapes of entries that the env does not write, without the batch dimensions.

    Attributes:
        width: D, length of the concatenated vector.

    Raises:
        KeyError: if the env has no such entry.
    """

    def __init__(self, env: EnvBase, in_keys: Sequence[str], shapes: Mapping[str, torch.Size] | None = None) -> None:
        super().__init__()
        spec, batch_dims, extra = env.observation_spec, len(env.batch_size), shapes or {}
        available = [*(key for key in spec.keys(True, True) if isinstance(key, str)), *extra]
        missing = [key for key in in_keys if key not in available]
        if missing:
            raise KeyError(f"the env has no entry {', '.join(missing)} to observe; it has {', '.join(available)}")
        event_shapes = [extra[key] if key in extra else spec[key].shape[batch_dims:] for key in in_keys]
        self.event_dims = [len(shape) for shape in event_shapes]
        self.width = sum(shape.numel() for shape in event_shapes)

    def forward(self, *inputs: Tensor) -> Tensor:
        """Concatenate inputs [*batch, ...] to [*batch, D]."""
        flat = [
            x.unsqueeze(-1) if dims == 0 else x.flatten(-dims) for x, dims in zip(inputs, self.event_dims, strict=True)
        ]
        return torch.cat(flat, -1) if len(flat) > 1 else flat[0]


def check_hidden(hidden: Sequence[int]) -> None:
    """Raise a `ValueError` for hidden layers that are empty, or too large for the memory of a typical machine."""
    check_range(0, 16, hidden_layers=len(hidden))
    for width in hidden:
        check_range(1, 4096, hidden=width)


def mlp(
    inputs: int,
    outputs: int,
    hidden: Sequence[int],
    gain: float,
    device: torch.device | None = None,
    activation: type[nn.Module] = nn.Tanh,
) -> MLP:
    """Return a tanh network with orthogonal weights and zero biases, or a ReLU network with PyTorch's initial weights.

    `gain` scales the weights of the last layer.
    """
    check_hidden(hidden)
    layers = MLP(inputs, outputs, num_cells=list(hidden), activation_class=activation, device=device)
    if activation is nn.Tanh:
        linear = [layer for layer in layers if isinstance(layer, nn.Linear)]
        for layer in linear:
            nn.init.orthogonal_(layer.weight, gain if layer is linear[-1] else 2**0.5)
            nn.init.zeros_(layer.bias)
    else:
        with torch.no_grad():
            for parameter in layers[-1].parameters():
                parameter.mul_(gain)
    return layers


class ObservationNetwork(nn.Module):
    """An `mlp` that reads concatenated entries of an env; arguments as for `ConcatObservations` and `mlp`."""

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[str],
        hidden: Sequence[int],
        outputs: int,
        gain: float,
        shapes: Mapping[str, torch.Size] | None = None,
        activation: type[nn.Module] = nn.Tanh,
    ) -> None:
        super().__init__()
        self.concat = ConcatObservations(env, in_keys, shapes)
        self.layers = mlp(self.concat.width, outputs, hidden, gain, env.device, activation)

    def forward(self, *inputs: Tensor) -> Tensor:
        """Map inputs [*batch, ...] to [*batch, outputs]."""
        out: Tensor = self.layers(self.concat(*inputs))
        return out


class GlobalScaleHead(nn.Module):
    """Normal distribution with a mean from a network and a standard deviation that is the same in every state."""

    def __init__(self, network: ObservationNetwork, size: int, scale: float) -> None:
        super().__init__()
        self.network = network
        self.log_scale = nn.Parameter(torch.full((size,), math.log(scale), device=network.layers[-1].weight.device))

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and standard deviation, [*batch, A] each."""
        loc = self.network(*inputs)
        return loc, self.log_scale.exp().expand_as(loc)


class GaussianHead(nn.Module):
    """Normal distribution with mean and standard deviation from a network; an output of 0 gives `scale`."""

    def __init__(self, network: ObservationNetwork, scale: float) -> None:
        super().__init__()
        self.network = network
        self.split = NormalParamExtractor(f"biased_softplus_{scale}", scale_lb=1e-3)

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and standard deviation, [*batch, A] each."""
        loc, scale = self.split(self.network(*inputs))
        return loc, scale


class FastTensorDictModule(TensorDictModuleBase):
    """A `TensorDictModule` with less overhead per call: no dispatch, no search for optional packages."""

    def __init__(self, module: nn.Module, in_keys: Sequence[str], out_keys: Sequence[str]) -> None:
        self.in_keys, self.out_keys = list(in_keys), list(out_keys)
        super().__init__()
        self.module = module

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the results into the tensordict."""
        results = self.module(*(tensordict[key] for key in self.in_keys))
        for key, result in zip(self.out_keys, results if isinstance(results, tuple) else (results,), strict=True):
            tensordict.set(key, result)
        return tensordict


class ClippedNormal(SafeProbabilisticModule):
    """Sample of a normal distribution, clipped to the bounds of an action.

    It writes `unclipped_action`, the sample, with `action_log_prob`, and `action`, which the env executes.
    """

    def __init__(self, low: Tensor, high: Tensor) -> None:
        super().__init__(
            ["loc", "scale"], [UNCLIPPED], distribution_class=IndependentNormal, return_log_prob=True,
            log_prob_key="action_log_prob",
        )  # fmt: skip
        self.low, self.high = low, high

    @property
    def out_keys(self) -> list[NestedKey]:
        """Keys of the entries that `forward` writes."""
        return [*super().out_keys, "action"]

    def forward(self, tensordict: TensorDictBase, *args: Any, **options: Any) -> TensorDictBase:
        """Write the sample and the action."""
        tensordict = super().forward(tensordict, *args, **options)
        return tensordict.set("action", tensordict[UNCLIPPED].clamp(self.low, self.high))


def actor(
    env: EnvBase,
    in_keys: Sequence[str],
    hidden: Sequence[int] = (64, 64),
    scale: float = 0.5,
    gain: float = 0.01,
    *,
    shapes: Mapping[str, torch.Size] | None = None,
    state_dependent_scale: bool = False,
    squash: bool = True,
) -> ProbabilisticTensorDictSequential:
    """Return a stochastic policy for the actions of an env.

    Its distribution is a tanh-squashed normal for bounded actions (without `squash` a normal whose samples are clipped,
    see `ClippedNormal`), a normal for unbounded ones and a categorical for discrete ones. Its deterministic action is
    the mode. It writes `action` and `action_log_prob`.

    The initial standard deviation before squashing is `scale`; with `state_dependent_scale` it is an output of the
    network, for continuous actions only. `gain` scales the initial weights of the last layer. `shapes` are as for
    `ConcatObservations`.
    """
    spec = env.action_spec
    common = dict(spec=spec, return_log_prob=True, log_prob_key="action_log_prob")
    if isinstance(spec, (Categorical, OneHot)):
        logits = ObservationNetwork(env, in_keys, hidden, spec.space.n, gain, shapes)
        module = FastTensorDictModule(logits, in_keys, ["logits"])
        distribution = CategoricalDistribution if isinstance(spec, Categorical) else OneHotCategorical
        return ProbabilisticActor(module, ["logits"], distribution_class=distribution, **common)
    size = spec.shape[-1]
    network = ObservationNetwork(env, in_keys, hidden, 2 * size if state_dependent_scale else size, gain, shapes)
    head = GaussianHead(network, scale) if state_dependent_scale else GlobalScaleHead(network, size, scale)
    module = FastTensorDictModule(head, in_keys, ["loc", "scale"])
    if not isinstance(spec, Bounded):
        return ProbabilisticActor(module, ["loc", "scale"], distribution_class=IndependentNormal, **common)
    event = tuple(0 for _ in spec.shape[:-1])
    low, high = spec.space.low[event], spec.space.high[event]
    if not squash:
        return ProbabilisticTensorDictSequential(module, ClippedNormal(low, high))
    bounds = {"low": low, "high": high, "tanh_loc": False}
    return ProbabilisticActor(
        module, ["loc", "scale"], distribution_class=TanhNormal, distribution_kwargs=bounds, **common
    )


def critic(env: EnvBase, in_keys: Sequence[str], hidden: Sequence[int] = (64, 64)) -> FastTensorDictModule:
    """Return a state-value network; it writes `state_value` [*batch, 1]."""
    return FastTensorDictModule(ObservationNetwork(env, in_keys, hidden, 1, gain=1.0), in_keys, ["state_value"])


def action_critic(env: EnvBase, in_keys: Sequence[str], hidden: Sequence[int] = (64, 64)) -> FastTensorDictModule:
    """Return an action-value network for continuous actions; it writes `state_action_value` [*batch, 1]."""
    keys, shapes = [*in_keys, "action"], {"action": env.action_spec.shape[-1:]}
    network = ObservationNetwork(env, keys, hidden, 1, 1.0, shapes)
    return FastTensorDictModule(network, keys, ["state_action_value"])
