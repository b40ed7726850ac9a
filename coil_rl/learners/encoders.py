"""What a network is made of: how it reads the entries of an env, and its layers. Named in YAML by `learner.network`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import torch
from tensordict import unravel_key
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.nn import functional as F
from torchrl.data import Binary, Categorical, MultiCategorical, TensorSpec, Unbounded
from torchrl.envs import EnvBase, InitTracker, TensorDictPrimer, Transform
from torchrl.modules import MLP, ConvNet

from coil_rl.envs.limits import check_choice, check_range

ACTIVATIONS: Mapping[str, type[nn.Module]] = {"tanh": nn.Tanh, "relu": nn.ReLU, "elu": nn.ELU, "silu": nn.SiLU}
Shapes = Mapping[NestedKey, torch.Size]
STATE, IS_INIT = "policy_state", "is_init"  # what an env carries for a network with a memory


def entry_keys(keys: Iterable[NestedKey | Sequence[str]]) -> list[NestedKey]:
    """Return keys of entries as TorchRL writes them; a nested key may be a list, as in YAML."""
    return [key if isinstance(key, str) else unravel_key(tuple(key)) for key in keys]


def entry_specs(env: EnvBase, in_keys: Sequence[NestedKey], shapes: Shapes | None = None) -> list[TensorSpec]:
    """Return the specs of entries of an env; those in `shapes`, which the env does not write, are numbers.

    Raises:
        KeyError: if the env has no such entry.
    """
    spec, extra = env.observation_spec, shapes or {}
    available = [*spec.keys(True, True), *extra]
    missing = [key for key in in_keys if key not in available]
    if missing:
        names = [", ".join(key if isinstance(key, str) else "/".join(key) for key in keys)
                 for keys in (missing, available)]  # fmt: skip
        raise KeyError(f"the env has no entry {names[0]} to observe; it has {names[1]}")
    return [Unbounded((*env.batch_size, *extra[key])) if key in extra else spec[key] for key in in_keys]


class ReadEntry(nn.Module):
    """One entry of an env as numbers of the network's dtype: an index is one-hot, a byte is divided by 255.

    Args:
        spec: of the entry.
        batch_dims: number of batch dimensions.

    Attributes:
        shape: of what is read, without the batch dimensions; at least one dimension.
    """

    def __init__(self, spec: TensorSpec, batch_dims: int) -> None:
        super().__init__()
        shape: torch.Size = spec.shape[batch_dims:]
        self.dims = len(shape)
        self.dtype = torch.get_default_dtype()
        self.choices: list[int] = []
        if isinstance(spec, MultiCategorical):
            self.choices = spec.nvec.reshape(-1, shape[-1])[0].tolist() * shape[:-1].numel()
        elif isinstance(spec, Categorical) and not isinstance(spec, Binary) and spec.dtype != torch.bool:
            self.choices = [spec.n] * shape.numel()
        self.shape: torch.Size = torch.Size([sum(self.choices)]) if self.choices else shape or torch.Size([1])

    def forward(self, entry: Tensor) -> Tensor:
        """Map [*batch, *shape of the entry] to [*batch, *shape]."""
        if self.dims == 0:
            entry = entry.unsqueeze(-1)
        if self.choices:
            columns = entry.flatten(-max(self.dims, 1)).long().unbind(-1)
            each = [F.one_hot(column, n) for column, n in zip(columns, self.choices, strict=True)]
            entry = torch.cat(each, -1)
        return entry.to(self.dtype) / 255 if entry.dtype == torch.uint8 else entry.to(self.dtype)


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

    def __init__(self, env: EnvBase, in_keys: Sequence[NestedKey], shapes: Shapes | None = None) -> None:
        super().__init__()
        entries = [ReadEntry(spec, len(env.batch_size)) for spec in entry_specs(env, in_keys, shapes)]
        self.entries = nn.ModuleList(entries)
        self.event_shapes = [entry.shape for entry in entries]
        self.width = sum(shape.numel() for shape in self.event_shapes)

    def forward(self, *inputs: Tensor) -> Tensor:
        """Concatenate inputs [*batch, ...] to [*batch, D]."""
        flat = [self.encode(index, entry(x)) for index, (entry, x) in enumerate(zip(self.entries, inputs, strict=True))]
        return torch.cat(flat, -1) if len(flat) > 1 else flat[0]

    def encode(self, index: int, numbers: Tensor) -> Tensor:
        """Flatten what was read from the entry at an index."""
        return numbers.flatten(-len(self.event_shapes[index]))


class ConvolvedObservations(ConcatObservations):
    """As `ConcatObservations`, but entries of three dimensions are images, which convolutions turn into vectors.

    An image is [C, H, W], or [H, W, C] if its last dimension is the smallest.
    """

    def __init__(self, env: EnvBase, in_keys: Sequence[NestedKey], shapes: Shapes | None, network: Cnn) -> None:
        super().__init__(env, in_keys, shapes)
        self.convolutions, self.channels_last = nn.ModuleDict(), {}
        for index, shape in enumerate(self.event_shapes):
            if len(shape) != 3:
                continue
            self.channels_last[index] = last = shape[2] < min(shape[:2])
            image = torch.zeros(1, *shape, device=env.device)
            image = image.movedim(-1, -3) if last else image
            layers = ConvNet(
                image.shape[1], num_cells=list(network.channels), kernel_sizes=list(network.kernels),
                strides=list(network.strides), activation_class=ACTIVATIONS[network.activation], device=env.device,
            )  # fmt: skip
            try:
                outputs = layers(image).shape[-1]
            except RuntimeError as error:
                raise ValueError(
                    f"the image {in_keys[index]} of shape {list(shape)} is too small for kernels="
                    f"{list(network.kernels)} with strides={list(network.strides)}; take smaller or fewer ones"
                ) from error
            self.convolutions[str(index)] = layers
            self.width += outputs - shape.numel()
        if not self.channels_last:
            raise ValueError(
                f"a convolutional network needs an image among {', '.join(map(str, in_keys))}, an entry of three "
                "dimensions, but there is none; use network=mlp"
            )

    def encode(self, index: int, numbers: Tensor) -> Tensor:
        """Turn the image at an index into a vector, or flatten another entry."""
        if index not in self.channels_last:
            return super().encode(index, numbers)
        image = numbers.movedim(-1, -3) if self.channels_last[index] else numbers
        # One batch dimension: ConvNet can do without the others, but not without any.
        vectors: Tensor = self.convolutions[str(index)](image.reshape(-1, *image.shape[-3:]))
        return vectors.reshape(*image.shape[:-3], -1)


@dataclass(frozen=True)
class Mlp:
    """A network that reads concatenated entries. With tanh its weights are orthogonal, else PyTorch's initial ones.

    Args:
        hidden: widths of the hidden layers.
        activation: tanh, relu, elu or silu.

    Raises:
        ValueError: for hidden layers that are empty, or too large for the memory of a typical machine.
    """

    hidden: Sequence[int] = (64, 64)
    activation: str = "tanh"

    def __post_init__(self) -> None:
        check_choice(tuple(ACTIVATIONS), activation=self.activation)
        check_range(0, 16, hidden_layers=len(self.hidden))
        for width in self.hidden:
            check_range(1, 4096, hidden=width)

    def observations(self, env: EnvBase, in_keys: Sequence[NestedKey], shapes: Shapes | None) -> ConcatObservations:
        """Return the part that turns entries into one vector."""
        return ConcatObservations(env, in_keys, shapes)

    def layers(self, inputs: int, outputs: int, gain: float, device: torch.device | None = None) -> MLP:
        """Return the layers after it; `gain` scales the initial weights of the last one."""
        activation = ACTIVATIONS[self.activation]
        layers = MLP(inputs, outputs, num_cells=list(self.hidden), activation_class=activation, device=device)
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


@dataclass(frozen=True)
class Cnn(Mlp):
    """A network that reads images by convolutions, and other entries beside what these give.

    Args:
        hidden: widths of the hidden layers after the convolutions.
        activation: of all layers: tanh, relu, elu or silu.
        channels: of each convolution.
        kernels: widths of each convolution.
        strides: of each convolution.

    Raises:
        ValueError: as `Mlp`, or if the lists for the convolutions are empty or differ in length; when it is built, if
            no entry is an image, or an image is too small.
    """

    hidden: Sequence[int] = (512,)
    activation: str = "relu"
    channels: Sequence[int] = (32, 64, 64)
    kernels: Sequence[int] = (8, 4, 3)
    strides: Sequence[int] = (4, 2, 1)

    def __post_init__(self) -> None:
        super().__post_init__()
        lengths = {name: len(getattr(self, name)) for name in ("channels", "kernels", "strides")}
        if len(set(lengths.values())) > 1 or not self.channels:
            raise ValueError(f"channels, kernels and strides must have one number for each convolution, not {lengths}")
        for name in lengths:
            for number in getattr(self, name):
                check_range(1, 4096, **{name: number})

    def observations(self, env: EnvBase, in_keys: Sequence[NestedKey], shapes: Shapes | None) -> ConcatObservations:
        """Return the part that turns entries into one vector."""
        return ConvolvedObservations(env, in_keys, shapes, self)


@dataclass(frozen=True)
class Gru(Mlp):
    """A network with a memory: a gated recurrent unit (GRU) reads concatenated entries, and hidden layers its state.

    The state is zero at the start of an episode, and the data of the env carry it from step to step as `policy_state`;
    `env_transforms` makes an env do so. Critics have no memory of their own: their hidden layers read the entries and
    the state that the policy had before the step.

    Args:
        hidden: widths of the hidden layers after the GRU.
        activation: of the hidden layers: tanh, relu, elu or silu.
        state: width of the state of the GRU.

    Raises:
        ValueError: as `Mlp`.

    Example:
        >>> from torchrl.envs import Compose, TransformedEnv
        >>> from coil_rl.envs import ConeTrackEnv, shipped_tracks
        >>> from coil_rl.learners import PPO
        >>> gru = Gru(state=32)
        >>> env = TransformedEnv(ConeTrackEnv(shipped_tracks("train")), Compose(*gru.env_transforms()))
        >>> PPO(env, network=gru).policy(env.reset())["next", "policy_state"].shape
        torch.Size([64, 1, 32])
    """

    hidden: Sequence[int] = (64,)
    state: int = 64

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(1, 4096, state=self.state)

    @property
    def after(self) -> Mlp:
        """The hidden layers after the GRU."""
        return Mlp(self.hidden, self.activation)

    def env_transforms(self) -> list[Transform]:
        """Return transforms by which an env marks the starts of episodes and carries the state, as TorchRL expects."""
        return [InitTracker(IS_INIT), TensorDictPrimer({STATE: Unbounded((1, self.state))}, expand_specs=True)]


def without_memory(network: Mlp, learner: str) -> Mlp:
    """Return the network of a learner that cannot train a memory; raises a `ValueError` for one that has a memory."""
    if isinstance(network, Gru):
        raise ValueError(
            f"{learner} cannot train a network with a memory; take network=mlp, or learner=ppo, a2c or reinforce"
        )
    return network


class ObservationNetwork(nn.Module):
    """A network that reads entries of an env.

    Args:
        env: the env.
        in_keys: the entries.
        network: its architecture.
        outputs: number of its outputs.
        gain: scale of the initial weights of the last layer.
        shapes: as for `ConcatObservations`.
        dtype: of its outputs; PyTorch's default by default, as that of its weights.
    """

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[NestedKey],
        network: Mlp,
        outputs: int,
        gain: float,
        shapes: Shapes | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        super().__init__()
        self.concat = network.observations(env, in_keys, shapes)
        self.layers = network.layers(self.concat.width, outputs, gain, env.device)
        self.dtype = dtype or torch.get_default_dtype()

    def forward(self, *inputs: Tensor) -> Tensor:
        """Map inputs [*batch, ...] to [*batch, outputs]."""
        out: Tensor = self.layers(self.concat(*inputs))
        return out.to(self.dtype)
