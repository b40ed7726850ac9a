"""Policy and value networks, built from the specs of an env."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import (
    NormalParamExtractor,
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
    TensorDictSequential,
)
from torch import Tensor, nn
from torch.distributions import Categorical as CategoricalDistribution
from torch.distributions import Independent
from torchrl.data import (
    Bounded,
    Categorical,
    MultiCategorical,
    MultiOneHot,
    OneHot,
    TensorSpec,
    Unbounded,
)
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, exploration_type
from torchrl.modules import (
    GRUModule,
    IndependentNormal,
    OneHotCategorical,
    SafeProbabilisticModule,
    TanhNormal,
)

from coil_rl.learners.anchor import Anchor, AnchoredHead, pull_to_choice, pull_to_number
from coil_rl.learners.encoders import (
    STATE,
    ConcatObservations,
    Gru,
    Mlp,
    ObservationNetwork,
    Shapes,
    entry_specs,
)
from coil_rl.learners.normaliser import Normaliser
from coil_rl.transforms.action_space import choices_of

UNCLIPPED, REMEMBERED, NOISE = "unclipped_action", "remembered", "exploration_noise"
DEFAULT = Mlp()


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
        super().__init__(CategoricalDistribution(logits=logits), event_dims)

    @property
    def deterministic_sample(self) -> Tensor:
        """The most probable choices."""
        return self.base_dist.mode


def shaped(vectors: Tensor, event: torch.Size) -> Tensor:
    """Return vectors [*batch, n] as [*batch, *event]."""
    return vectors.reshape(*vectors.shape[:-1], *event)


class FastTensorDictModule(TensorDictModuleBase):
    """A `TensorDictModule` with less overhead per call: no dispatch, no search for optional packages."""

    def __init__(
        self, module: nn.Module, in_keys: Sequence[NestedKey], out_keys: Sequence[NestedKey]
    ) -> None:
        self.in_keys, self.out_keys = list(in_keys), list(out_keys)
        super().__init__()
        self.module = module

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the results into the tensordict."""
        results = self.module(*(tensordict[key] for key in self.in_keys))
        for key, result in zip(
            self.out_keys, results if isinstance(results, tuple) else (results,), strict=True
        ):
            tensordict.set(key, result)
        return tensordict


class Sample(SafeProbabilisticModule):
    """Module that samples from a distribution; it writes the sample, and its logarithmic probability `action_log_prob`.

    If a rollout has written `exploration_noise`, standard normal numbers, a normal distribution
    takes these.
    """

    def __init__(
        self, parameters: Sequence[str], key: NestedKey, distribution: type, **options: Any
    ) -> None:
        super().__init__(
            list(parameters),
            [key],
            distribution_class=distribution,
            distribution_kwargs=options,
            return_log_prob=True,
            log_prob_key="action_log_prob",
        )

    def forward(self, tensordict: TensorDictBase, *args: Any, **options: Any) -> TensorDictBase:
        """Write the sample and its logarithmic probability."""
        noise = tensordict.get(NOISE, None)
        if noise is None or exploration_type() is not ExplorationType.RANDOM:
            return super().forward(tensordict, *args, **options)
        distribution = self.get_dist(tensordict)
        sample = tensordict["loc"] + tensordict["scale"] * noise
        for transform in getattr(distribution, "transforms", ()):
            sample = transform(sample)
        return tensordict.set(self.out_keys[0], sample).set(
            "action_log_prob", distribution.log_prob(sample)
        )


class ClippedNormal(Sample):
    """Sample of a normal distribution, clipped to the bounds of an action.

    It writes `unclipped_action`, the sample, with `action_log_prob`, and the action, which the env
    executes.
    """

    def __init__(self, low: Tensor, high: Tensor, action_key: NestedKey = "action") -> None:
        super().__init__(["loc", "scale"], UNCLIPPED, IndependentNormal, event_dim=low.ndim)
        self.low, self.high, self.action_key = low, high, action_key

    @property
    def out_keys(self) -> list[NestedKey]:
        """Keys of the entries that `forward` writes."""
        return [*super().out_keys, self.action_key]

    def forward(self, tensordict: TensorDictBase, *args: Any, **options: Any) -> TensorDictBase:
        """Write the sample and the action."""
        tensordict = super().forward(tensordict, *args, **options)
        return tensordict.set(self.action_key, tensordict[UNCLIPPED].clamp(self.low, self.high))


def action_spec(env: EnvBase) -> TensorSpec:
    """Return the spec of the action of an env; several actions, or one no policy can choose, are a `ValueError`."""
    if len(env.action_keys) != 1:
        names = ", ".join(map(str, env.action_keys))
        raise ValueError(
            f"this env has the actions {names}, but a policy chooses one; take another env"
        )
    spec = env.full_action_spec[env.action_key]
    numbers = isinstance(spec, (Bounded, Unbounded)) and spec.dtype.is_floating_point
    options = isinstance(spec, (Categorical, MultiCategorical, OneHot)) and not isinstance(
        spec, MultiOneHot
    )
    if not (numbers or options):
        known = "numbers (Bounded, Unbounded), one of several options (Categorical, OneHot) or several such"
        given = f"the action of this env is {type(spec).__name__} of {spec.dtype}"
        raise ValueError(f"{given}, but a policy chooses {known} (MultiCategorical); transform it")
    return spec


def actor(
    env: EnvBase,
    in_keys: Sequence[NestedKey],
    network: Mlp = DEFAULT,
    scale: float = 0.5,
    gain: float = 0.01,
    *,
    shapes: Shapes | None = None,
    state_dependent_scale: bool = False,
    squash: bool = True,
    normaliser: Normaliser | None = None,
    anchor: Anchor | None = None,
) -> ProbabilisticTensorDictSequential:
    """Return a stochastic policy for the actions of an env.

    Its distribution is a tanh-squashed normal for bounded actions (without `squash`, or if a bound
    is infinite, a normal whose samples are clipped, see `ClippedNormal`), a normal for unbounded
    ones, a categorical for discrete ones, and several of these for several choices. Its
    deterministic action is the mode. It writes the action, and its logarithmic probability as
    `action_log_prob`.

    The initial standard deviation before squashing is `scale`; with `state_dependent_scale` it is
    an output of the network, for continuous actions only. `gain` scales the initial weights of the
    last layer. `shapes` are as for `ConcatObservations`. A network with a memory also writes its
    next state, see `Gru`. With an `anchor` the policy starts as its guide.

    An action of another kind, or a network with a memory that the env does not carry, is a
    `ValueError`; an entry that the env does not have, such as the advice for an anchor, a
    `KeyError`.
    """
    spec, key, event = action_spec(env), env.action_key, action_shape(env)
    keys = in_keys if normaliser is None else normaliser.reads(in_keys)
    before: list[TensorDictModuleBase] = [] if normaliser is None else [normaliser]
    if isinstance(network, Gru):
        before += memory(env, in_keys, keys, network, shapes)
        in_keys = keys = [REMEMBERED]
        shapes, network = {REMEMBERED: torch.Size([network.state])}, network.after

    def network_of(outputs: int) -> ObservationNetwork:
        dtype = spec.dtype if spec.dtype.is_floating_point else None
        return ObservationNetwork(env, in_keys, network, outputs, gain, shapes, dtype)

    if anchor is not None:
        (advice,) = entry_specs(env, [anchor.advice_key])
        keys = [anchor.advice_key, *keys]

    def anchored(head: nn.Module, pull: Callable[[Tensor], Tensor]) -> nn.Module:
        return (
            head
            if anchor is None
            else anchor.attach(AnchoredHead(head, pull, advice.shape[-2], env.device))
        )

    def policy(head: nn.Module, parameters: list[str], distribution: type, **options: Any) -> Any:
        module = FastTensorDictModule(head, keys, parameters)
        return ProbabilisticTensorDictSequential(
            *before, module, Sample(parameters, key, distribution, **options)
        )

    if isinstance(spec, OneHot) or (isinstance(spec, Categorical) and not event):
        distribution = (
            CategoricalDistribution if isinstance(spec, Categorical) else OneHotCategorical
        )
        valid = torch.ones(spec.space.n, dtype=torch.bool, device=spec.device)
        return policy(
            anchored(network_of(spec.space.n), pull_to_choice(valid)), ["logits"], distribution
        )
    if not spec.dtype.is_floating_point:
        options = torch.tensor(choices_of(spec), device=spec.device).expand(event)
        choices = ChoicesHead(network_of(options.numel() * int(options.max())), event, options)
        return policy(
            anchored(choices, pull_to_choice(choices.valid)),
            ["logits"],
            Choices,
            event_dims=len(event),
        )
    size = event.numel()
    gaussian = GaussianHead if state_dependent_scale else GlobalScaleHead
    head: nn.Module = gaussian(
        network_of(2 * size if state_dependent_scale else size), event, scale
    )
    if not isinstance(spec, Bounded):
        head = anchored(head, pull_to_number)
        return policy(head, ["loc", "scale"], IndependentNormal, event_dim=len(event))
    first = (0,) * len(env.batch_size)
    low, high = spec.space.low[first], spec.space.high[first]
    squash = squash and bool((high - low).isfinite().all())
    head = anchored(head, partial(pull_to_number, bounds=(low, high)) if squash else pull_to_number)
    if squash:
        return policy(
            head,
            ["loc", "scale"],
            TanhNormal,
            low=low,
            high=high,
            event_dims=len(event),
            tanh_loc=False,
        )
    module = FastTensorDictModule(head, keys, ["loc", "scale"])
    return ProbabilisticTensorDictSequential(*before, module, ClippedNormal(low, high, key))


def memory(
    env: EnvBase,
    in_keys: Sequence[NestedKey],
    read: Sequence[NestedKey],
    network: Gru,
    shapes: Shapes | None,
) -> list[TensorDictModuleBase]:
    """Return the modules of a policy that remember the entries of an episode; they write `remembered` [*batch, H].

    `read` are the keys under which the modules read the entries `in_keys` of the env. An env that
    does not carry the state is a `ValueError`.
    """
    carried = {
        key: spec.shape[len(env.batch_size) :]
        for key, spec in env.observation_spec.items(True, True)
    }
    if "is_init" not in carried or carried.get(STATE) != (1, network.state):
        remedy = "put the network's env_transforms() around the env"
        raise ValueError(f"the env does not carry the memory of the network; {remedy}")
    entries = ConcatObservations(env, in_keys, shapes)
    gru = GRUModule(
        entries.width,
        network.state,
        device=env.device,
        in_keys=["concatenated", STATE, "is_init"],
        out_keys=[REMEMBERED, ("next", STATE)],
    )
    return [FastTensorDictModule(entries, read, ["concatenated"]), gru]


def split_memory(
    policy: ProbabilisticTensorDictSequential,
) -> tuple[TensorDictSequential | None, ProbabilisticTensorDictSequential]:
    """Return the part of a policy that writes `remembered`, None without a memory, and the part after it."""
    modules = list(policy.module)
    for count, module in enumerate(modules, start=1):
        if isinstance(module, GRUModule):
            return TensorDictSequential(*modules[:count]), ProbabilisticTensorDictSequential(
                *modules[count:]
            )
    return None, policy


def action_shape(env: EnvBase) -> torch.Size:
    """Return the shape of an action of an env without the batch dimensions."""
    return env.full_action_spec[env.action_key].shape[len(env.batch_size) :]


def critic(
    env: EnvBase,
    in_keys: Sequence[NestedKey],
    network: Mlp = DEFAULT,
    normaliser: Normaliser | None = None,
) -> TensorDictModuleBase:
    """Return a state-value network; it writes `state_value` [*batch, 1]. Of a memory it reads the stored state."""
    if isinstance(network, Gru):
        in_keys, network = [*in_keys, STATE], network.after
    values = ObservationNetwork(
        env, in_keys, network, 1, gain=1.0, dtype=env.full_reward_spec[env.reward_key].dtype
    )
    if normaliser is None:
        return FastTensorDictModule(values, in_keys, ["state_value"])
    return TensorDictSequential(
        normaliser, FastTensorDictModule(values, normaliser.reads(in_keys), ["state_value"])
    )


def action_critic(
    env: EnvBase,
    in_keys: Sequence[NestedKey],
    network: Mlp = DEFAULT,
    normaliser: Normaliser | None = None,
) -> FastTensorDictModule:
    """Return an action-value network for continuous actions; it writes `state_action_value` [*batch, 1].

    It reads entries that have been normalised already.
    """
    keys: list[NestedKey] = [*in_keys, "action"]
    values = ObservationNetwork(
        env,
        keys,
        network,
        1,
        1.0,
        {"action": action_shape(env)},
        env.full_reward_spec[env.reward_key].dtype,
    )
    read = keys if normaliser is None else normaliser.reads(keys)
    return FastTensorDictModule(values, read, ["state_action_value"])
