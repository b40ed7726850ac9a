"""Advice: the actions of guides as an additional observation, as in COIL.

It is the central idea of the paper (section 3, equation 97): the agent sees what its guides would
do and learns by reward when to listen. `Guides` runs several guides as one module, and
`GuideActions` is the transform.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import Composite, TensorSpec

from coil_rl.transforms.action_space import (
    ActionSpace,
    ActionTransform,
    OwnForms,
    nested_key,
    own_forms,
    space_of,
)
from coil_rl.transforms.guide_memory import SUPPLIED, GuideMemory
from coil_rl.transforms.hosted import HostedGuide, ToldGuide, guide_of
from coil_rl.transforms.link import State
from coil_rl.transforms.normalised_action import ActionUnits


class UnfitActionError(ValueError):
    """The action of a guide does not fit the env."""

    outside: ClassVar[bool] = True  # the cause is not in this program


def unfit_action(
    name: str, guide: nn.Module, action: Tensor, batch: torch.Size, space: ActionSpace, problem: str
) -> Exception:
    """Return the error for the action of a guide that does not fit the env.

    That of a controller tells what it returned itself, which has no batch.

    Args:
        name: of the guide.
        guide: the guide.
        action: that it wrote.
        batch: of the action.
        space: of its actions.
        problem: says why, as the end of a sentence.
    """
    own = None
    if isinstance(guide, HostedGuide):
        own = guide.unfit(action, batch, space, problem)
    return own or UnfitActionError(f"the action of guide {name!r} {problem}")


@dataclass(frozen=True)
class Ended:
    """Rows whose episode is over, so that nothing needs new advice for them.

    Args:
        rows: which these are, [*batch].
        advice: the last advice of all rows, [*batch, *agents, n_guides, A].
    """

    rows: Tensor
    advice: Tensor


class Guides(TensorDictModuleBase):
    """Several guides as one module that writes their actions side by side.

    Args:
        guides: name to guide, in the order of the rows of the advice.
        action_key: entry written by each guide, [*batch, A].
        out_key: entry for the advice, [*batch, n_guides, A].
        trainable: require parameters and no memory in each guide.

    Attributes:
        units: of the actions of the guides; None: of the advice.

    Raises:
        TypeError: if `guides` is not a mapping.
        ValueError: without a guide, for an invalid name, for a guide that does not write
            `action_key`, for one that cannot be trained although it has to be, and for a memory
            that `GuideMemory` refuses.
    """

    def __init__(
        self,
        guides: Mapping[str, Any],
        action_key: NestedKey = "action",
        out_key: NestedKey = "guide_action",
        trainable: bool = False,
    ) -> None:
        action_key, out_key = nested_key(action_key), nested_key(out_key)
        if not isinstance(guides, Mapping):
            raise TypeError(
                f"guides must be a mapping from name to guide, not {type(guides).__name__}"
            )
        guides = {name: guide_of(guide) for name, guide in guides.items()}
        if not guides:
            raise ValueError("at least one guide is required, none was given")
        for name, guide in guides.items():
            _check_guide(name, guide, action_key)
            if trainable and next(guide.parameters(), None) is None:
                raise ValueError(
                    f"guide {name!r} has no parameters to train; imitate it with a network "
                    "(coil-distill)"
                )
        memories = {name: GuideMemory(name, guide) for name, guide in guides.items()}
        self.memories = {name: memory for name, memory in memories.items() if memory.specs}
        if trainable and self.memories:
            name = next(iter(self.memories))
            raise ValueError(f"guide {name!r} has a memory, and such a guide cannot be trained")
        read = (key for guide in guides.values() for key in guide.in_keys)
        self.in_keys: list[NestedKey] = list(dict.fromkeys(read))
        self.out_keys = [out_key]
        super().__init__()
        self.guides = nn.ModuleDict(guides)
        self.action_key = action_key
        self.units: ActionUnits | None = None
        self._in_keys_of = {name: guide.in_keys for name, guide in guides.items()}
        self._input_dtype: dict[str, torch.dtype] = {}

    @property
    def names(self) -> list[str]:
        """Names of the guides, one per row of the advice."""
        return list(self.guides)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the advice, normalised if `units` are set."""
        advice = self.advice(tensordict)
        if self.units is not None:
            advice = self.units.normalise(advice)
        return tensordict.set(self.out_keys[0], advice)

    def advice(
        self,
        tensordict: TensorDictBase,
        convert: Callable[[str, Tensor, torch.Size], Tensor] | None = None,
        memory: State | None = None,
        ended: Ended | None = None,
    ) -> Tensor:
        """Return the advice [*batch, n_guides, A].

        Args:
            tensordict: observations; each guide gets a copy of its own entries.
            convert: applied to name, action and batch of each guide.
            memory: of the guides; replaced by what they remember for the next step.
            ended: rows for which guides with `by_row` are not asked.
        """
        rows = []
        for number, (name, guide) in enumerate(self.guides.items()):
            if ended is None or not _is_by_row(guide) or not ended.rows.any():
                rows.append(self._asked(name, tensordict, convert, memory))
                continue
            advice = ended.advice.select(-2, number)
            if not ended.rows.all():
                running = (~ended.rows,)
                own = {key: value[running] for key, value in (memory or {}).items()}
                new = self._asked(name, tensordict[running], convert, own)
                advice = advice.index_put(running, new)
                if memory is not None:
                    for key, value in own.items():
                        memory[key] = memory[key].index_put(running, value)
            rows.append(advice)
        return torch.stack(rows, -2)

    def _asked(
        self,
        name: str,
        tensordict: TensorDictBase,
        convert: Callable[[str, Tensor, torch.Size], Tensor] | None,
        memory: State | None,
    ) -> Tensor:
        """Return the advice of a guide [*batch, A]; the arguments are those of `advice`."""
        guide = self.guides[name]
        data = tensordict.select(*self._in_keys_of[name], strict=False)
        if name in self._input_dtype:
            dtype = self._input_dtype[name]
            data = data.apply(lambda each: each.to(dtype) if each.is_floating_point() else each)
        if memory is not None and name in self.memories:
            data = guide(self.memories[name].given_to(data, memory))
            self.memories[name].kept(data, memory)
        else:
            data = guide(data)
        action: Tensor = data[self.action_key]
        return action if convert is None else convert(name, action, tensordict.batch_size)

    def tell(self, space: ActionSpace, own: OwnForms) -> None:
        """Tell the guides that ask for it about their env.

        Args:
            space: of the actions of the guides.
            own: what converts entries from the form of networks to that of the env.
        """
        for guide in self.guides.values():
            if isinstance(guide, ToldGuide):
                guide.meet(space, own)

    def match_dtypes(self, tensordict: TensorDictBase) -> None:
        """Convert from here on what a guide reads to the dtype of its parameters.

        Args:
            tensordict: an example of the observations, which may have another dtype.
        """
        for name, guide in self.guides.items():
            of_guide = {each.dtype for each in guide.parameters() if each.is_floating_point()}
            read = tensordict.select(*self._in_keys_of[name], strict=False).values(True, True)
            of_entries = {each.dtype for each in read if each.is_floating_point()}
            if len(of_guide) == 1 and of_entries - of_guide:
                self._input_dtype[name] = of_guide.pop()


def _is_by_row(guide: nn.Module) -> bool:
    return isinstance(guide, HostedGuide) and guide.by_row


def _check_guide(name: str, guide: TensorDictModuleBase, action_key: NestedKey) -> None:
    """Raise a `ValueError` for a guide that does not write `action_key` or has an invalid name."""
    if action_key not in guide.out_keys:
        raise ValueError(f"guide {name!r} must write {action_key!r}; it writes {guide.out_keys}")
    if not name or "." in name or hasattr(nn.ModuleDict, name):
        raise ValueError(
            f"{name!r} cannot be the name of a guide: PyTorch reserves it; use another name"
        )


class GuideActions(ActionTransform):
    """Write the action of each guide into the observation.

    The agent is free to use the advice. A guide is a TensorDictModule that reads observations of
    the env and writes an action, or anything else that `ControllerGuide` takes. Guides run in
    evaluation mode, without gradients, on a copy of the data. With discrete actions the advice is
    one-hot; a guide may write an index, in the numbering of the env, or a one-hot vector. Advice is
    clamped to the bounds of the action. Guides act in the unit of the env; behind
    `NormalisedAction` the advice is normalised.

    A guide may have a memory: what it reads as `k` and writes as `("next", k)`, declared by its
    `make_tensordict_primer()`, as TorchRL's `LSTMModule` and `GRUModule` do. It is kept in the data
    as `("guide_state", NAME, k)` and begins anew with each episode. Guides may also read `is_init`
    [*batch, 1], whether this is the first step of an episode; `row` [*batch, 1], the number of the
    row; and `last_action` [*batch, A], the last action that the env was given, after all transforms
    of it, 0 in the first step (one-hot if discrete).

    Args:
        guides: name to guide, in the order of the rows of the advice.
        action_key: entry written by the guides, and the env's action.
        out_key: entry for the advice, [*batch, n_guides, A] in the unit of the agent's action; with
            an action for each of several agents [*batch, n_agents, n_guides, A].

    Raises:
        TypeError: if `guides` is not a mapping.
        ValueError: without a guide, for an invalid name, or for a guide that does not write
            `action_key`; at the first step for an action of another shape, or one that is not
            finite.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from coil_rl.envs import ConeTrackEnv, shipped_tracks
        >>> from coil_rl.guides import SplineGuide
        >>> cars = ConeTrackEnv(shipped_tracks("train"))
        >>> env = TransformedEnv(cars, GuideActions({"middle": SplineGuide()}))
        >>> env.reset()["guide_action"].shape
        torch.Size([64, 1, 1])
    """

    def __init__(
        self,
        guides: Mapping[str, Any],
        action_key: NestedKey = "action",
        out_key: NestedKey = "guide_action",
    ) -> None:
        module = Guides(guides, action_key, out_key)
        self.supplied = [key for key in SUPPLIED if key in module.in_keys]
        super().__init__(in_keys=module.in_keys, out_keys=module.out_keys)
        self.guides, self.action_key = module.eval(), module.action_key
        self.needs_past = bool(self.supplied or module.memories)
        if any(map(_is_by_row, module.guides.values())):
            self.passed = (self.out_keys[0],)
        self.calls = 0  # number of actions that guides were asked for
        # Their last advice by name in the unit of the env, where somebody listens.
        self.heard: dict[str, Tensor] | None = None
        self.rests = False

    @cached_property
    def given_space(self) -> ActionSpace:
        """Action space of the env without any transforms."""
        return space_of(self.parent.base_env, self.action_key)

    @cached_property
    def guide_space(self) -> ActionSpace:
        """Action space of the guides: that of the env, in its own unit and numbering."""
        if self.given_units is not None:
            return self.given_space
        space = self.action_space
        given = self.given_space
        return ActionSpace(space.spec, self.parent.batch_dims, given.first, given.own_shape)

    @cached_property
    def rows(self) -> Tensor:
        """Numbers of the rows of the env, [*batch, 1]."""
        batch = self.parent.batch_size
        return torch.arange(batch.numel(), device=self.parent.device).reshape(*batch, 1)

    @cached_property
    def _checked(self) -> set[str]:
        """Names of the guides whose actions were checked in this env."""
        return set()

    @property
    def names(self) -> list[str]:
        """Names of the guides, one per row of the advice."""
        return self.guides.names

    def rest(self) -> None:
        """Ask no guide from now on: the advice, which nothing reads, is 0."""
        self.rests, self.supplied = True, []
        self.in_keys: list[NestedKey] = []
        self.needs_past = bool(self.guides.memories)

    def train(self, mode: bool = True) -> GuideActions:
        """Set the training mode; guides stay in evaluation mode."""
        super().train(mode)
        self.guides.eval()
        return self

    def get_extra_state(self) -> dict[str, list[str]]:
        """Return the names of the guides."""
        return {"names": self.names}

    def set_extra_state(self, state: dict[str, list[str]]) -> None:
        """Raise a `ValueError` for a state of other guides, or of another order of them.

        A policy depends on both.
        """
        if state["names"] != self.names:
            raise ValueError(
                f"the state is of the guides {', '.join(state['names'])}, not "
                f"{', '.join(self.names)}"
            )

    def first(self, data: TensorDictBase, reset: TensorDictBase | None = None) -> State:
        """Return the memory of the guides at the start of episodes."""
        if not self.needs_past:
            return {}
        state: State = {}
        for memory in self.guides.memories.values():
            state |= memory.start(data.batch_size, data.device)
        space, device = self.given_space, data.device or "cpu"
        size = (*data.batch_size, *space.agents, space.size)
        action = torch.zeros(size, dtype=space.dtype, device=device)
        return state | self._supplied(data.batch_size, action, begins=True)

    def sent(self, data: TensorDictBase, state: State) -> State:
        """Add the action that the env was given to what the guides remember."""
        if not self.needs_past:
            return state
        action = self.given_space.clamp(self.given_space.vectors(data[self.action_key]))
        return state | self._supplied(data.batch_size, action, begins=False)

    def _supplied(self, batch: torch.Size, action: Tensor, *, begins: bool) -> State:
        """Return what the guides may read besides the entries of the env and their memory.

        Args:
            batch: of the data.
            action: the last one of the env.
            begins: whether this is the first step of an episode.
        """
        is_init = torch.full((*batch, 1), begins, device=action.device)
        supplied: State = {"is_init": is_init, "last_action": action}
        return {key: supplied[key] for key in self.supplied if key in supplied}

    def observe(self, data: TensorDictBase, state: State) -> State:
        """Write the advice, and return the memory of the guides."""
        if not self.needs_past:
            data.set(self.out_keys[0], self._advice(data))
            return {}
        read = data.select(*self.in_keys, strict=False)
        for key in self.supplied:
            if key not in read:  # an entry of the env comes first
                read.set(key, state.get(key, self.rows))
        own = (memory.key(key) for memory in self.guides.memories.values() for key in memory.specs)
        memory = {key: state[key] for key in own}
        ended = self._ended(data, state.get(self.out_keys[0], None))
        data.set(self.out_keys[0], self._advice(read, memory, ended))
        return memory

    def _ended(self, data: TensorDictBase, advice: Tensor | None) -> Ended | None:
        """Return the rows that need no advice after a step; None where that is not known.

        In training a critic may read the advice after the last step of a truncated episode.

        Args:
            data: after the step.
            advice: before it.
        """
        rows, batch = data.get("terminated" if self.training else "done", None), data.batch_size
        if advice is None or rows is None or rows.numel() != batch.numel():
            return None
        return Ended(rows.reshape(batch), advice)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        mask = tensordict.get("_reset", None)
        if mask is None or mask.all():
            return super()._reset(tensordict, tensordict_reset)
        # TorchRL discards the other rows; in a large batch nearly every step resets a few rows.
        rows: tuple[Tensor, ...] = mask.reshape(tensordict.batch_size).nonzero(as_tuple=True)
        data = tensordict_reset.select(*self.in_keys, strict=False)[rows]
        written = self.observe(data, {**self.first(data), "row": self.rows[rows]})
        written[self.out_keys[0]] = data[self.out_keys[0]]
        for key, part in written.items():
            whole = part.new_zeros((*tensordict_reset.batch_size, *part.shape[1:]))
            tensordict_reset.set(key, whole.index_put(rows, part))
        return tensordict_reset

    @torch.no_grad()
    def _advice(
        self,
        tensordict: TensorDictBase,
        memory: State | None = None,
        ended: Ended | None = None,
    ) -> Tensor:
        """Return the advice within the bounds of the action; the memory is replaced by the next."""
        if self.rests:
            space = self.action_space
            shape = (*tensordict.batch_size, *space.agents, len(self.names), space.size)
            return torch.zeros(shape, dtype=space.dtype, device=tensordict.device)
        if not self._checked:
            self.guides.match_dtypes(tensordict)
            self.guides.tell(self.guide_space, own_forms(self.parent.base_env))
        return self.guides.advice(tensordict, self._fitted, memory, ended)

    def _fitted(self, name: str, action: Tensor, batch: torch.Size) -> Tensor:
        """Return the action of a guide within the bounds.

        It is checked in the first step; that of a `HostedGuide` in every step.
        """
        guide = self.guides.guides[name]
        try:
            # An exported function can neither count nor raise.
            if not torch.compiler.is_exporting():
                self.calls += batch.numel()
                if name not in self._checked or isinstance(guide, HostedGuide):
                    self.guide_space.check_advice(action, batch)
                    self._checked.add(name)
            advice = self.guide_space.advice(action, batch)
            if self.heard is not None:
                self.heard[name] = advice.clone()
        except ValueError as error:
            raise unfit_action(name, guide, action, batch, self.guide_space, str(error)) from None
        return self.observed(advice)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the advice and the memory.

        Two guides of one name with a memory, or one in an env that resets its agents one by one,
        are a `ValueError`.
        """
        advice = self.action_space.advice_spec(self.parent.batch_size, len(self.names))
        observation_spec[self.out_keys[0]] = advice
        for name in self.guides.memories:
            if ("guide_state", name) in observation_spec.keys(True):
                raise ValueError(f"two guides {name!r} have a memory; give them different names")
            if "_reset" not in self.parent.reset_keys:
                raise ValueError(
                    f"guide {name!r} has a memory, but the env resets its agents one by one"
                )
        return super().transform_observation_spec(observation_spec)

    @property
    def state(self) -> Mapping[NestedKey, TensorSpec]:
        """The memory of the guides."""
        specs: dict[NestedKey, TensorSpec] = {}
        for memory in self.guides.memories.values():
            specs |= memory.spec(self.parent.batch_size, self.parent.device)
        return specs
