"""One step of a controller as a function of tensors, which can be written to a file.

`Controller` applies the chain of an evaluation to observations: guides, transforms, normaliser,
policy, and what the transforms make of its action. Here the same modules are called in the same
order, but what they remember between two steps is an input and an output: nothing but the entries
of the env and this state decides the action.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.envs import (
    Compose,
    InitTracker,
    RewardSum,
    StepCounter,
    TensorDictPrimer,
    Transform,
)
from torchrl.modules import GRUModule

from coil_rl.export.gru import WrittenGru
from coil_rl.learners.critics import Critics
from coil_rl.run.controller import Controller
from coil_rl.transforms import GuideActions
from coil_rl.transforms.action_space import ActionSpace, space_of
from coil_rl.transforms.advice_dropout import AdviceDropout
from coil_rl.transforms.combined_actions import AdaptiveMixedAction, CombinedAction
from coil_rl.transforms.degraded_advice import DegradedAdvice
from coil_rl.transforms.disturbance import Disturbance
from coil_rl.transforms.guide_transform import GuideTransform, SeededGenerator
from coil_rl.transforms.last_action import LastAction

ADVICE = "guide_action"  # input for the actions of guides that are outside
# Transforms that neither change what the policy sees nor what it does. A controller takes off what
# disturbs its env.
WITHOUT_EFFECT = (Disturbance, InitTracker, RewardSum, StepCounter, TensorDictPrimer)


class NotExportableError(Exception):
    """A part of a policy that cannot be a function of tensors; the message says why."""


@dataclass(frozen=True)
class Entry:
    """An input of the exported function.

    Attributes:
        key: of the entry.
        shape: of one row.
        dtype: of its numbers.
        first: value in the first step of an episode, of the shape of one row; None for an entry
            of the env.
    """

    key: NestedKey
    shape: tuple[int, ...]
    dtype: torch.dtype
    first: Tensor | None = None

    @property
    def name(self) -> str:
        """The key with points."""
        return self.key if isinstance(self.key, str) else ".".join(self.key)

    def rows(self, count: int) -> Tensor:
        """Return a value for some rows: the first one, or zeros.

        Args:
            count: number of rows.
        """
        first = torch.zeros(self.shape, dtype=self.dtype) if self.first is None else self.first
        return first.expand(count, *self.shape).clone()


class _Part:
    """What a transform does before the policy acts, and after."""

    state: Sequence[Entry] = ()  # what it remembers
    reads: Sequence[NestedKey] = ()  # entries that it reads

    def observe(self, data: TensorDictBase, after: dict[NestedKey, Tensor]) -> None:
        """Write what the policy sees, and what is remembered for the next step."""

    def act(self, data: TensorDictBase, after: dict[NestedKey, Tensor]) -> None:
        """Replace the action."""


class _Advice(_Part):
    """The guides of a run.

    Args:
        transform: has the guides.
        inside: whether they are a part of the function; otherwise their actions are an input, in
            the unit and numbering of the env.
    """

    def __init__(self, transform: GuideActions, inside: bool) -> None:
        self.transform, self.inside = transform, inside
        self.space: ActionSpace = transform.guide_space
        self.given: ActionSpace = transform.given_space
        self.normalise = transform.given_units
        self.clamp = transform.action_space.clamp
        self.state, self.reads = [], [ADVICE]
        if inside:
            self.state, self.reads = self._state(), list(transform.guides.in_keys)

    def _state(self) -> list[Entry]:
        entries = []
        for name, memory in self.transform.guides.memories.items():
            start = memory.start(torch.Size([1]), None)
            for key in memory.specs:
                first = start[key][0]
                own = ("guide_state", name, *([key] if isinstance(key, str) else key))
                entries.append(Entry(own, tuple(first.shape), first.dtype, first))
        supplied = self.transform.supplied
        if "row" in supplied:
            raise NotExportableError("a guide asks for the number of its row")
        if "is_init" in supplied:
            entries.append(Entry("is_init", (1,), torch.bool, torch.ones(1, dtype=torch.bool)))
        if "last_action" in supplied:
            shape = (*self.given.agents, self.given.size)
            first = torch.zeros(shape, dtype=self.given.dtype)
            entries.append(Entry("last_action", shape, first.dtype, first))
        return entries

    @property
    def outside(self) -> Entry:
        """The input for the actions of guides that are outside."""
        names = len(self.transform.names)
        if self.given.choices:
            shape = (*self.given.agents, names, len(self.given.choices))
            return Entry(ADVICE, shape, torch.int64)
        return Entry(ADVICE, (*self.given.agents, names, self.given.size), self.given.dtype)

    def observe(self, data: TensorDictBase, after: dict[NestedKey, Tensor]) -> None:
        if not self.inside:
            actions = data[ADVICE].unbind(-2)
            data.set(ADVICE, torch.stack([self._fitted("", each, ()) for each in actions], -2))
            return
        guides = self.transform.guides
        memory = TensorDict({}, data.batch_size)
        for name in guides.memories:
            memory.set(name, data["guide_state", name])
        advice = guides.advice(data, self._fitted, memory)
        for entry in self.state:
            if entry.key == "is_init":
                after["is_init"] = torch.zeros_like(data["is_init"])
            elif entry.key != "last_action":
                after[entry.key] = memory[entry.key[1:]]
        data.set(self.transform.out_keys[0], advice)

    def _fitted(self, name: str, action: Tensor, batch: Any) -> Tensor:
        """Return the action of a guide as the policy sees it; see `GuideActions`."""
        advice = self.space.advice(action, action.shape[:1])
        return advice if self.normalise is None else self.clamp(self.normalise.normalise(advice))


class _Combined(_Part):
    """An action that is combined of those of agent and guide."""

    def __init__(self, transform: CombinedAction) -> None:
        self.transform = transform
        self.reads = [transform.advice_key]
        if isinstance(transform, AdaptiveMixedAction):
            first = torch.full((1,), transform.low, dtype=transform.action_space.dtype)
            self.state = [Entry("agent_weight", (1,), first.dtype, first)]

    def act(self, data: TensorDictBase, after: dict[NestedKey, Tensor]) -> None:
        data.set(self.transform.action_key, self.transform._executed(data))
        if isinstance(self.transform, AdaptiveMixedAction):
            doubt = data.get(("next", "uncertainty"), None)
            after["agent_weight"] = self.transform.weight_after(data["agent_weight"], doubt)


class _Dropout(_Part):
    """Advice that is missing in some episodes of a training; outside of one it is there, or not."""

    def __init__(self, transform: AdviceDropout) -> None:
        self.transform = transform
        self.reads = [transform.advice_key]

    def observe(self, data: TensorDictBase, after: dict[NestedKey, Tensor]) -> None:
        shape, device = (*data.batch_size, 1), data[self.transform.advice_key].device
        given = torch.full(shape, self.transform.in_evaluation, device=device)
        self.transform._write(data, given)


class _LastAction(_Part):
    """The actions that the agent chose in the steps before."""

    def __init__(self, transform: LastAction) -> None:
        self.transform, self.key = transform, transform.out_key
        first = transform.observation_at_start[0]
        # Not the entry itself: a guide may read the executed action by the same key.
        own = ("past", *([self.key] if isinstance(self.key, str) else self.key))
        self.past = Entry(own, tuple(first.shape), first.dtype, first)
        self.state = [self.past]

    def observe(self, data: TensorDictBase, after: dict[NestedKey, Tensor]) -> None:
        data.set(self.key, data[self.past.key])

    def act(self, data: TensorDictBase, after: dict[NestedKey, Tensor]) -> None:
        newest = self.transform.action_space.vectors(data[self.transform.action_key])
        after[self.past.key] = self.transform.shifted(data[self.past.key], newest)


class _Other(_Part):
    """Any other transform, which must not remember anything."""

    def __init__(self, transform: Transform) -> None:
        name = type(transform).__name__
        if isinstance(transform, DegradedAdvice):
            draws = any(isinstance(part, SeededGenerator) for part in transform.modules())
            if draws or transform.slots or transform.needs_past:
                raise NotExportableError(
                    f"{name} degrades the advice at random or by that of earlier steps, which is "
                    "for experiments only; train without degrade"
                )
        elif getattr(transform, "needs_past", False):
            raise NotExportableError(f"{name} remembers earlier steps in a way of its own")
        self.transform = transform
        self.reads = list(transform.in_keys or ())

    def observe(self, data: TensorDictBase, after: dict[NestedKey, Tensor]) -> None:
        self.transform._call(data)

    def act(self, data: TensorDictBase, after: dict[NestedKey, Tensor]) -> None:
        if not isinstance(self.transform, (DegradedAdvice, GuideTransform)):
            data.update(self.transform._inv_call(data))


class _Memory(_Part):
    """What the policy itself remembers."""

    def __init__(self, policy: TensorDictModuleBase, env: Any) -> None:
        keys = [key[1:] for key in policy.out_keys if isinstance(key, tuple) and key[0] == "next"]
        self.state = []
        for (key,) in keys:
            spec = env.observation_spec.get(key, None)
            if spec is not None:
                first = spec.zero()[0]
                self.state.append(Entry(key, tuple(first.shape), first.dtype, first))

    def act(self, data: TensorDictBase, after: dict[NestedKey, Tensor]) -> None:
        for entry in self.state:
            after[entry.key] = data["next", entry.key]


class PolicyStep(nn.Module):
    """The step of a controller: the entries of an env, and its state, to the action and the state.

    Args:
        controller: of a run; it must have acted before.
        inside: whether its guides are inside. Otherwise their actions are the input `guide_action`,
            [B, n_guides, A] in the unit of the env, for choices the numbers of the choices; guides
            that nothing reads are left out.

    Attributes:
        inputs: entries of the env that the step reads, and perhaps the advice.
        state: what it remembers.
        guides: names of the guides.

    Raises:
        NotExportableError: for a part that is no function of tensors.
    """

    def __init__(self, controller: Controller, *, inside: bool = True) -> None:
        super().__init__()
        env, plant = controller.env, controller.plant
        self.policy = nn.ModuleList(_flat(controller.policy))
        self.transforms = nn.ModuleList(_transforms(env.transform))
        self.parts = [_part(each, inside) for each in self.transforms]
        self.parts.append(_Memory(controller.policy, env))
        advice = next((part for part in self.parts if isinstance(part, _Advice)), None)
        if advice is not None and not inside:
            others = [part for part in self.parts if part is not advice]
            if ADVICE not in {*controller.policy.in_keys, *(k for p in others for k in p.reads)}:
                self.parts, advice = others, None
        self.state = [entry for part in self.parts for entry in part.state]
        self.inputs = _inputs(plant, self.parts, controller.policy)
        self.guides = [] if advice is None else advice.transform.names
        if advice is not None and not inside:
            self.inputs.append(advice.outside)
        self.action_key = env.action_key
        self.space = space_of(plant, plant.action_key)
        self.eval().requires_grad_(False)

    def forward(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        """Return the action and the state for the next step.

        Args:
            tensors: `inputs`, then `state`, [B, ...] each.
        """
        data = TensorDict({}, tensors[0].shape[:1])
        for entry, tensor in zip((*self.inputs, *self.state), tensors, strict=True):
            data.set(entry.key, tensor)
        after: dict[NestedKey, Tensor] = {}
        for part in self.parts:
            part.observe(data, after)
        for module in self.policy:
            data = module(data)
        for part in reversed(self.parts):
            part.act(data, after)
        action = data[self.action_key]
        after["last_action"] = self.space.clamp(self.space.vectors(action))
        return (self.executed(action), *(after[entry.key] for entry in self.state))

    def executed(self, action: Tensor) -> Tensor:
        """Return an action in the numbering of the env, and within its bounds.

        Args:
            action: as an entry of the env, [B, *A].
        """
        if self.space.continuous:
            return self.space.clamp(action)
        first = self.space.first
        return action if first is None else action + first.to(action).reshape(action.shape[1:])


def _flat(policy: TensorDictModuleBase) -> Iterable[TensorDictModuleBase]:
    """Yield the modules of a policy, with memories written out."""
    if isinstance(policy, TensorDictSequential):
        for module in policy.module:
            yield from _flat(module)
    elif not all(getattr(part, "is_network", True) for part in policy.modules()):
        raise NotExportableError("it is a forest, not a network")
    elif isinstance(policy, GRUModule):
        yield WrittenGru(policy)
    elif isinstance(policy, Critics):
        yield policy.written_out()
    else:
        yield policy


def _transforms(transform: Transform) -> Iterable[Transform]:
    """Yield the transforms that have an effect on what a policy sees or does."""
    if isinstance(transform, Compose):
        for each in transform.transforms:
            yield from _transforms(each)
    elif not isinstance(transform, WITHOUT_EFFECT):
        yield transform


def check_transforms(controller: Controller) -> None:
    """Raise a `NotExportableError` for a transform of a controller that no function can be."""
    for each in _transforms(controller.env.transform):
        _part(each, inside=False)


def _part(transform: Transform, inside: bool) -> _Part:
    if isinstance(transform, GuideActions):
        return _Advice(transform, inside)
    if isinstance(transform, CombinedAction):
        return _Combined(transform)
    if isinstance(transform, AdviceDropout):
        return _Dropout(transform)
    if isinstance(transform, LastAction):
        return _LastAction(transform)
    return _Other(transform)


def _inputs(plant: Any, parts: Iterable[_Part], policy: TensorDictModuleBase) -> list[Entry]:
    """Return the entries of an env that are read."""
    read = {key for part in parts for key in part.reads} | set(policy.in_keys)
    entries = []
    for key, spec in plant.observation_spec.items(True, True):
        if key in read:
            entries.append(Entry(key, tuple(spec.shape[plant.batch_dims :]), spec.dtype))
    return entries
