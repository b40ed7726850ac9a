"""Policy and value networks, built from the specs of an env."""

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
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
from torchrl.modules import GRUModule

from coil_rl.learners.anchor import (
    Anchor,
    AnchoredHead,
    AnchoredInputs,
    AnchoredSample,
    Hold,
    ShownAdvice,
)
from coil_rl.learners.density import Choices, Density, Normal, OneHotChoice, SquashedNormal
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
from coil_rl.learners.policy import (
    ByKey,
    ChoicesHead,
    ClippedSample,
    GaussianHead,
    GlobalScaleHead,
    KeyModule,
    Policy,
    Sample,
    read_through,
)
from coil_rl.transforms.action_space import ActionSpace, choices_of
from coil_rl.transforms.normalised_action import units_of

REMEMBERED = "remembered"  # what a memory gives to the layers after it
DEFAULT = Mlp()
Inputs = Normaliser | AnchoredInputs  # what networks read in place of entries of the env


class FastTensorDictModule(KeyModule):
    """A `TensorDictModule` with less overhead per call.

    There is no dispatch, and no search for optional packages.

    Args:
        module: takes the entries `in_keys`, and returns a tensor or a tuple of them.
        in_keys: as of `KeyModule`.
        out_keys: as of `KeyModule`.
    """

    def __init__(
        self,
        module: Callable[..., Any],
        in_keys: Sequence[NestedKey],
        out_keys: Sequence[NestedKey],
    ) -> None:
        super().__init__(in_keys, out_keys)
        self.module = module

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the results into the tensordict."""
        results = self.module(*(tensordict[key] for key in self.in_keys))
        for key, result in zip(
            self.out_keys, results if isinstance(results, tuple) else (results,), strict=True
        ):
            tensordict.set(key, result)
        return tensordict


def action_spec(env: EnvBase) -> TensorSpec:
    """Return the spec of the action of an env.

    Several actions, or one that no policy can choose, are a `ValueError`.
    """
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
        raise ValueError(
            f"the action of this env is {type(spec).__name__} of {spec.dtype}, but a policy "
            "chooses numbers (Bounded, Unbounded), one of several options (Categorical, OneHot) or "
            "several such (MultiCategorical); transform it"
        )
    units = units_of(spec, len(env.batch_size))
    if units is not None and not units.identity:
        warnings.warn(
            f"the action of this env goes from {units.bounds[0].tolist()} to "
            f"{units.bounds[1].tolist()}, but networks compute with numbers between -1 and 1; put "
            "NormalisedAction() first, next to the env",
            stacklevel=3,
        )
    return spec


def actor(
    env: EnvBase,
    in_keys: Sequence[NestedKey],
    network: Mlp = DEFAULT,
    scale: float = 0.5,
    gain: float = 0.01,
    *,
    shapes: Shapes | None = None,
    head: type[GlobalScaleHead | GaussianHead] = GlobalScaleHead,
    squash: bool = True,
    clip: bool = True,
    inputs: Inputs | None = None,
    anchor: Anchor | None = None,
) -> Policy:
    """Return a stochastic policy for the actions of an env.

    Its distribution is a tanh-squashed normal for bounded actions (without `squash`, or if a bound
    is infinite, a normal whose samples are clipped, see `ClippedSample`), a normal for unbounded
    ones, a categorical for discrete ones, and several of these for several choices. Its
    deterministic action is the mode. It writes the action, and its logarithmic probability as
    `action_log_prob`. With a memory it also writes its next state, see `Gru`.

    Args:
        network: architecture, perhaps with a memory, which the env then carries.
        scale: initial standard deviation, before squashing; for continuous actions only.
        gain: scale of the initial weights of the last layer.
        shapes: shapes of observed entries that the env does not write, without the batch
            dimensions.
        head: gives mean and standard deviation of numbers.
        squash: whether bounded actions are squashed by tanh; otherwise samples are clipped.
        clip: whether samples that are not squashed are clipped; otherwise the env does that.
        inputs: what networks read in place of some of `in_keys`; the first module of the policy.
        anchor: the settings of an anchored policy, which needs `AnchoredInputs`; None: it is none.

    Raises:
        ValueError: if no policy can choose such actions, or the env does not carry the memory.
        KeyError: if the env does not have one of the entries.
    """
    spec = action_spec(env)
    keys = read_through(inputs, in_keys)
    before: list[TensorDictModuleBase] = [] if inputs is None else [inputs]
    if isinstance(network, Gru):
        before += memory(env, in_keys, keys, network, shapes)
        # What follows reads the memory only.
        in_keys = keys = [REMEMBERED]
        shapes, network = {REMEMBERED: torch.Size([network.state])}, network.after

    def network_of(outputs: int) -> ObservationNetwork:
        dtype = spec.dtype if spec.dtype.is_floating_point else None
        return ObservationNetwork(env, in_keys, network, outputs, gain, shapes, dtype)

    valid: Tensor | None = None
    if spec.dtype.is_floating_point:
        event = action_shape(env)
        module: nn.Module = head(network_of(head.outputs * event.numel()), event, scale)
        sample = _sample_of_numbers(env, spec, squash, clip)
    else:
        module, sample, valid = _choices(env, spec, network_of)
    if anchor is not None and isinstance(inputs, AnchoredInputs):
        if valid is None:
            sample = AnchoredSample(sample, inputs.hold, anchor, env.action_key)
        else:
            module = AnchoredHead(module, inputs.hold, valid, anchor.choice_weight)
            keys = [anchor.advice_key, *keys]
    return Policy(*before, FastTensorDictModule(module, keys, sample.in_keys), sample)


def inputs_of(env: EnvBase, normaliser: Normaliser | None, anchor: Anchor | None) -> Inputs | None:
    """Return what the networks of a learner read in place of entries of the env, if anything.

    Args:
        normaliser: of some entries; None: of none.
        anchor: the settings of an anchored policy; None: it is none.

    Raises:
        KeyError: if the env does not have the advice.
    """
    if anchor is None:
        return normaliser
    (advice,) = entry_specs(env, [anchor.advice_key])
    space = ActionSpace(env.full_action_spec[env.action_key], len(env.batch_size))
    hold = Hold(advice.shape[-2], space, env.device)
    return AnchoredInputs(normaliser, ShownAdvice(hold, anchor.advice_key))


NetworkOf = Callable[[int], ObservationNetwork]  # makes a network with that many outputs


def _choices(
    env: EnvBase, spec: TensorSpec, network_of: NetworkOf
) -> tuple[nn.Module, Sample, Tensor]:
    """Return head and sample of choices, and whether each has an option, [*event, n]."""
    event = action_shape(env)
    if isinstance(spec, OneHot) or (isinstance(spec, Categorical) and not event):
        kind = Choices if isinstance(spec, Categorical) else OneHotChoice
        valid = torch.ones(spec.space.n, dtype=torch.bool, device=spec.device)
        return network_of(spec.space.n), Sample(["logits"], env.action_key, kind), valid
    options = torch.tensor(choices_of(spec), device=spec.device).expand(event)
    head = ChoicesHead(network_of(options.numel() * int(options.max())), event, options)
    sample = Sample(["logits"], env.action_key, Choices, {"event_dims": len(event)})
    return head, sample, head.valid


def _sample_of_numbers(env: EnvBase, spec: TensorSpec, squash: bool, clip: bool) -> Sample:
    """Return what samples numbers, squashed or clipped to their bounds; arguments of `actor`."""
    kind: type[Density] = Normal
    options: dict[str, Any] = {"event_dims": len(action_shape(env))}
    if isinstance(spec, Bounded):
        row = (0,) * len(env.batch_size)  # all have the same bounds
        low, high = spec.space.low[row], spec.space.high[row]
        if squash and bool((high - low).isfinite().all()):
            is_unit = bool((low == -1).all() and (high == 1).all())
            kind, options["bounds"] = SquashedNormal, None if is_unit else (low, high)
        elif clip:
            return ClippedSample(low, high, env.action_key)
    return Sample(["loc", "scale"], env.action_key, kind, options)


def memory(
    env: EnvBase,
    in_keys: Sequence[NestedKey],
    read: Sequence[NestedKey],
    network: Gru,
    shapes: Shapes | None,
) -> list[TensorDictModuleBase]:
    """Return the modules of a policy that remember the entries of an episode.

    They write `remembered` [*batch, H]. An env that does not carry the state is a `ValueError`.

    Args:
        in_keys: entries of the env, for their shapes.
        read: the keys under which the modules find them, in the same order.
        network: has the size of the memory.
        shapes: see `actor`.
    """
    carried = {
        key: spec.shape[len(env.batch_size) :]
        for key, spec in env.observation_spec.items(True, True)
    }
    if "is_init" not in carried or carried.get(STATE) != (1, network.state):
        raise ValueError(
            "the env does not carry the memory of the network; put the network's env_transforms() "
            "around the env"
        )
    entries = ConcatObservations(env, in_keys, shapes)
    gru = GRUModule(
        entries.width,
        network.state,
        device=env.device,
        in_keys=["concatenated", STATE, "is_init"],
        out_keys=[REMEMBERED, ("next", STATE)],
    )
    return [FastTensorDictModule(entries, read, ["concatenated"]), gru]


def parts_of(policy: Policy) -> tuple[Inputs | None, TensorDictSequential | None, Policy]:
    """Return a policy in parts, as an update computes them, with its own modules.

    Returns:
        What changes the entries that networks read, once for a batch; None: nothing does. The
        memory, computed for whole episodes, which writes `remembered`; None: there is none. And the
        head, computed for each minibatch.
    """
    inputs, modules, memory = None, list(policy.module), None
    if isinstance(modules[0], Inputs):
        inputs = modules.pop(0)
    for count, module in enumerate(modules, start=1):
        if isinstance(module, GRUModule):
            memory, modules = TensorDictSequential(*modules[:count]), modules[count:]
            break
    return inputs, memory, Policy(*modules)


def values_of(critic: TensorDictModuleBase, inputs: Inputs | None) -> TensorDictModuleBase:
    """Return the part of a critic after `inputs`; all of it if it does not begin with them."""
    if isinstance(critic, ByKey) and critic.module[0] is inputs:
        return ByKey(*list(critic.module)[1:])
    return critic


def action_shape(env: EnvBase) -> torch.Size:
    """Return the shape of an action of an env without the batch dimensions."""
    return env.full_action_spec[env.action_key].shape[len(env.batch_size) :]


def critic(
    env: EnvBase,
    in_keys: Sequence[NestedKey],
    network: Mlp = DEFAULT,
    inputs: Inputs | None = None,
) -> TensorDictModuleBase:
    """Return a state-value network; it writes `state_value` [*batch, 1].

    Args:
        in_keys: entries that it observes; with a memory it also reads the stored state.
        network: architecture, perhaps with a memory.
        inputs: what it reads in place of some of `in_keys`.
    """
    if isinstance(network, Gru):
        in_keys, network = [*in_keys, STATE], network.after
    values = ObservationNetwork(
        env, in_keys, network, 1, gain=1.0, dtype=env.full_reward_spec[env.reward_key].dtype
    )
    module = FastTensorDictModule(values, read_through(inputs, in_keys), ["state_value"])
    return module if inputs is None else ByKey(inputs, module)
