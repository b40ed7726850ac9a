"""What a network is made of: how it reads the entries of an env, and its layers.

A YAML file names an architecture by `learner.network`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Literal

import torch
from tensordict import NestedKey
from torch import Tensor, nn
from torch.nn import functional as F
from torchrl.data import Binary, Categorical, MultiCategorical, TensorSpec, Unbounded
from torchrl.envs import EnvBase, InitTracker, TensorDictPrimer, Transform
from torchrl.modules import MLP, ConvNet

from coil_rl.ranges import Interval, Len, checked
from coil_rl.transforms.action_space import written_key

Width = Annotated[int, Interval(ge=1, le=4096)]
Hidden = Annotated[Sequence[Width], Len(0, 16)]
Activation = Literal["tanh", "relu", "elu", "silu"]
ACTIVATIONS: Mapping[Activation, type[nn.Module]] = {
    "tanh": nn.Tanh,
    "relu": nn.ReLU,
    "elu": nn.ELU,
    "silu": nn.SiLU,
}
Shapes = Mapping[NestedKey, torch.Size]
ADDED = ("episode_reward", "task_reward", "limit_count")  # entries that no env has by itself
STATE = "policy_state"  # what an env carries for a network with a memory


def entry_specs(
    env: EnvBase, in_keys: Sequence[NestedKey], shapes: Shapes | None = None
) -> list[TensorSpec]:
    """Return the specs of entries of an env.

    Entries in `shapes`, which the env does not write, are numbers. One that it does not have is a
    `KeyError`.
    """
    spec, extra = env.observation_spec, shapes or {}
    available = [*spec.keys(True, True), *extra]
    missing = [key for key in in_keys if key not in available]
    if missing:
        own = [key for key in available if key not in ADDED]
        names = [", ".join(map(written_key, keys)) for keys in (missing, own)]
        raise KeyError(
            f"the env has no entry {names[0]} to observe; it has {names[1]}: name "
            "some of them by observes=[ENTRY,...], from Python by in_keys"
        )
    shape = env.batch_size
    return [
        Unbounded((*shape, *extra[key]), device=env.device) if key in extra else spec[key]
        for key in in_keys
    ]


class ReadEntry(nn.Module):
    """One entry of an env as a vector of the network's dtype.

    An index becomes one-hot, a byte is divided by 255.

    Args:
        spec: of the entry.
        batch_dims: number of batch dimensions of the spec.

    Attributes:
        width: length of the vector.
    """

    def __init__(self, spec: TensorSpec, batch_dims: int) -> None:
        super().__init__()
        self.shape: torch.Size = spec.shape[batch_dims:]
        self.dtype = torch.get_default_dtype()
        self.choices: list[int] = []
        if isinstance(spec, MultiCategorical):
            self.choices = (
                spec.nvec.reshape(-1, self.shape[-1])[0].tolist() * self.shape[:-1].numel()
            )
        elif (
            isinstance(spec, Categorical)
            and not isinstance(spec, Binary)
            and spec.dtype != torch.bool
        ):
            self.choices = [spec.n] * self.shape.numel()
        self.width = sum(self.choices) or self.shape.numel()

    def forward(self, entry: Tensor) -> Tensor:
        """Map [*batch, *shape of the entry] to [*batch, width]."""
        flat = entry.flatten(-len(self.shape)) if self.shape else entry.unsqueeze(-1)
        if self.choices:
            columns = zip(flat.long().unbind(-1), self.choices, strict=True)
            flat = torch.cat([F.one_hot(column, n) for column, n in columns], -1)
        return self.numbers(flat)

    def numbers(self, entry: Tensor) -> Tensor:
        """Convert the dtype."""
        return entry.to(self.dtype) / 255 if entry.dtype == torch.uint8 else entry.to(self.dtype)


class ReadImage(ReadEntry):
    """An image as a vector by convolutions.

    Args:
        spec: of the entry, [C, H, W], or [H, W, C] if its last dimension is the smallest.
        network: has the convolutions.
    """

    def __init__(self, spec: TensorSpec, batch_dims: int, network: "Cnn") -> None:
        super().__init__(spec, batch_dims)
        self.channels_last = self.shape[2] < min(self.shape[:2])
        self.layers = ConvNet(
            self.shape[2 if self.channels_last else 0],
            num_cells=list(network.channels),
            kernel_sizes=list(network.kernels),
            strides=list(network.strides),
            activation_class=ACTIVATIONS[network.activation],
            device=spec.device,
        )
        self.width = self(torch.zeros(self.shape, device=spec.device)).numel()

    def forward(self, entry: Tensor) -> Tensor:
        """Map [*batch, *shape of the entry] to [*batch, width]."""
        image = self.numbers(entry.movedim(-1, -3) if self.channels_last else entry)
        # One batch dimension: ConvNet can do without the others, but not without any.
        vectors: Tensor = self.layers(image.reshape(-1, *image.shape[-3:]))
        return vectors.reshape(*image.shape[:-3], -1)


class ConcatObservations(nn.Module):
    """Concatenation of entries of an env, each flattened beyond the batch dimensions.

    Args:
        env: the env, for its specs.
        in_keys: the entries.
        shapes: shapes of entries that the env does not write, without the batch dimensions.
        network: a `Cnn` reads entries of three dimensions; otherwise they are flattened like
            others.

    Attributes:
        width: length of the concatenation.
    """

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[NestedKey],
        shapes: Shapes | None = None,
        network: "Mlp | None" = None,
    ) -> None:
        super().__init__()
        images = network if isinstance(network, Cnn) else None
        entries, dims = list[ReadEntry](), len(env.batch_size)
        for key, spec in zip(in_keys, entry_specs(env, in_keys, shapes), strict=True):
            entry = ReadEntry(spec, dims)
            if images and len(entry.shape) == 3 and not entry.choices:
                try:
                    entry = ReadImage(spec, dims, images)
                except RuntimeError as error:
                    raise ValueError(
                        f"the image {key} of shape {list(entry.shape)} is too small for "
                        f"kernels={list(images.kernels)} with strides={list(images.strides)}; "
                        "take smaller or fewer ones"
                    ) from error
            entries.append(entry)
        self.entries = nn.ModuleList(entries)
        self.width = sum(entry.width for entry in entries)
        if images and not any(isinstance(entry, ReadImage) for entry in entries):
            raise ValueError(
                f"a convolutional network needs an image among {', '.join(map(str, in_keys))}, an "
                "entry of three dimensions, but there is none; use network=mlp"
            )

    def forward(self, *inputs: Tensor) -> Tensor:
        """Concatenate inputs [*batch, ...] to [*batch, width]."""
        flat = [entry(x) for entry, x in zip(self.entries, inputs, strict=True)]
        return torch.cat(flat, -1) if len(flat) > 1 else flat[0]


@checked
@dataclass(frozen=True)
class Mlp:
    """A network that reads concatenated entries.

    With tanh its initial weights are orthogonal, else PyTorch's. Layers that are empty, or too
    large for the memory of a typical machine, are a `ValueError`.

    Args:
        hidden: widths of the hidden layers.
        activation: tanh, relu, elu or silu.
        layer_norm: whether the numbers of a hidden layer are normalised before its activation.
    """

    hidden: Hidden = (64, 64)
    activation: Activation = "tanh"
    layer_norm: bool = field(default=False, kw_only=True)

    def layers(
        self, inputs: int, outputs: int, gain: float, device: torch.device | None = None
    ) -> nn.Module:
        """Return the layers after it; `gain` scales the initial weights of the last one.

        An architecture of your own is a subclass that has this method.
        """
        widths = [{"normalized_shape": width} for width in self.hidden]
        layers = MLP(
            inputs,
            outputs,
            num_cells=list(self.hidden),
            activation_class=ACTIVATIONS[self.activation],
            device=device,
            norm_class=nn.LayerNorm if self.layer_norm else None,
            norm_kwargs=widths if self.layer_norm else None,
        )
        if self.activation == "tanh":
            linear = [layer for layer in layers if isinstance(layer, nn.Linear)]
            for layer in linear:
                nn.init.orthogonal_(layer.weight, gain if layer is linear[-1] else 2**0.5)
                nn.init.zeros_(layer.bias)
        else:
            with torch.no_grad():
                for parameter in layers[-1].parameters():
                    parameter.mul_(gain)
        return layers


@checked
@dataclass(frozen=True)
class Cnn(Mlp):
    """A network that reads images by convolutions, and other entries beside what these give.

    The lists for the convolutions must be as long as each other. When it is built, an entry must be
    an image, and none may be too small; else it raises a `ValueError`.

    Args:
        hidden: widths of the hidden layers after the convolutions.
        activation: of all layers, see `Mlp`.
        channels: output channels of each convolution.
        kernels: width of each convolution.
        strides: step of each convolution.
    """

    hidden: Hidden = (512,)
    activation: Activation = "relu"
    channels: Sequence[Width] = (32, 64, 64)
    kernels: Sequence[Width] = (8, 4, 3)
    strides: Sequence[Width] = (4, 2, 1)

    def __post_init__(self) -> None:
        lengths = {name: len(getattr(self, name)) for name in ("channels", "kernels", "strides")}
        if len(set(lengths.values())) > 1 or not self.channels:
            raise ValueError(
                "channels, kernels and strides must have one number for each convolution, "
                f"not {lengths}"
            )


@checked
@dataclass(frozen=True)
class Gru(Mlp):
    """A network with a memory: a gated recurrent unit (GRU), and hidden layers that read its state.

    The GRU reads concatenated entries. Its state is zero at the start of an episode, and the data
    of the env carry it from step to step as `policy_state`; `env_transforms` makes an env do so.
    Critics have no memory of their own: their hidden layers read the entries and the state that the
    policy had before the step.

    Args:
        hidden: widths of the hidden layers after the GRU.
        state: width of the state of the GRU.

    Example:
        >>> from torchrl.envs import Compose, TransformedEnv
        >>> from coil_rl.envs import ConeTrackEnv, shipped_tracks
        >>> from coil_rl.learners import PPO
        >>> gru = Gru(state=32)
        >>> cones = ConeTrackEnv(shipped_tracks("train"))
        >>> env = TransformedEnv(cones, Compose(*gru.env_transforms()))
        >>> PPO(env, network=gru).policy(env.reset())["next", "policy_state"].shape
        torch.Size([64, 1, 32])
    """

    hidden: Hidden = (64,)
    state: Width = 64

    @property
    def after(self) -> Mlp:
        """The hidden layers after the GRU."""
        return Mlp(self.hidden, self.activation, layer_norm=self.layer_norm)

    def env_transforms(self) -> list[Transform]:
        """Return transforms by which an env marks the starts of episodes and carries the state."""
        return [
            InitTracker(),
            TensorDictPrimer({STATE: Unbounded((1, self.state))}, expand_specs=True),
        ]


def without_memory(network: Mlp, learner: str) -> Mlp:
    """Return the network of a learner that cannot train a memory; a memory is a `ValueError`."""
    if isinstance(network, Gru):
        raise ValueError(
            f"{learner} cannot train a network with a memory; "
            "take network=mlp, or learner=ppo, a2c or reinforce"
        )
    return network


class ObservationNetwork(nn.Module):
    """A network that reads entries of an env.

    Args:
        env: the env, for its specs.
        in_keys: the entries.
        network: its architecture.
        outputs: number of its outputs.
        gain: scale of the initial weights of the last layer.
        shapes: shapes of entries that the env does not write, without the batch dimensions.
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
        self.concat = ConcatObservations(env, in_keys, shapes, network)
        self.layers = network.layers(self.concat.width, outputs, gain, env.device)
        self.dtype = dtype or torch.get_default_dtype()

    def forward(self, *inputs: Tensor) -> Tensor:
        """Map inputs [*batch, ...] to [*batch, outputs]."""
        out: Tensor = self.layers(self.concat(*inputs))
        return out.to(self.dtype)
