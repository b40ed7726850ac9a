"""One step of a controller as a function of tensors, which can be written to a file.

It is the chain of the controller, with a plain tensor for each entry that it reads, and for each
number that it remembers between two steps.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.modules import GRUModule

from coil_rl.export.contract import ADVICE
from coil_rl.run.controller import Controller
from coil_rl.transforms import GuideActions
from coil_rl.transforms.action_space import space_of
from coil_rl.transforms.chain import Chain, links_of
from coil_rl.transforms.degraded_advice import DegradedAdvice
from coil_rl.transforms.guide_transform import SeededGenerator
from coil_rl.transforms.last_action import LastAction
from coil_rl.transforms.link import Link, State


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
        """Return a value for some rows: the first one, or zeros."""
        first = torch.zeros(self.shape, dtype=self.dtype) if self.first is None else self.first
        return first.expand(count, *self.shape).clone()


class GivenAdvice(Link):
    """The actions of guides that are outside, which are an input in the unit of the env.

    Args:
        guides: the transform of the run that has these guides.
    """

    def __init__(self, guides: GuideActions) -> None:
        super().__init__(in_keys=[], out_keys=[])
        self.guides = guides

    @property
    def entry(self) -> Entry:
        """The input."""
        space, names = self.guides.given_space, len(self.guides.names)
        size, dtype = (
            (len(space.choices), torch.int64) if space.choices else (space.size, space.dtype)
        )
        return Entry(ADVICE, (*space.agents, names, size), dtype)

    def observe(self, data: TensorDictBase, state: State) -> State:
        """Write the advice as the policy sees it."""
        space, actions = self.guides.guide_space, data[ADVICE].unbind(-2)
        rows = [self.guides.observed(space.advice(each, data.batch_size)) for each in actions]
        data.set(self.guides.out_keys[0], torch.stack(rows, -2))
        return state


class WrittenGru(TensorDictModuleBase):
    """One step of a `GRUModule` of one layer, with the same weights: that one cannot be exported.

    The state that it reads is that of the step before; whoever begins an episode sets it to 0.

    Args:
        module: the module.
    """

    def __init__(self, module: GRUModule) -> None:
        super().__init__()
        observed, state, _ = module.in_keys
        self.in_keys, self.out_keys = [observed, state], list(module.out_keys)
        self.gru = module.gru

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write what is remembered, and the next state."""
        observed, state = (tensordict[key] for key in self.in_keys)
        gru = self.gru
        weights = gru.weight_ih_l0, gru.weight_hh_l0, gru.bias_ih_l0, gru.bias_hh_l0
        remembered = torch.gru_cell(observed, state.squeeze(-2), *weights)
        written, after = self.out_keys
        return tensordict.set(written, remembered).set(after, remembered.unsqueeze(-2))


class WrittenPolicy(nn.Sequential):
    """The modules of a policy, with memories written out.

    Args:
        policy: the policy.
    """

    def __init__(self, policy: TensorDictModuleBase) -> None:
        modules = list(_flat(policy))
        whole = TensorDictSequential(*modules)
        super().__init__(*modules)
        self.in_keys, self.out_keys = list(whole.in_keys), list(whole.out_keys)


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
        plant, policy = controller.plant, WrittenPolicy(controller.policy)
        links, guides = exportable(controller), controller.guides
        given = None if inside or guides is None else GivenAdvice(guides)
        if inside and guides is not None and "row" in guides.supplied:
            raise NotExportableError("a guide asks for the number of its row")
        if given is not None:
            others: list[Any] = [each for each in links if each is not guides]
            if not any(ADVICE in part.in_keys for part in (*others, policy)):
                links, guides, given = others, None, None
            else:
                links = [given if each is guides else each for each in links]
        self.guides = [] if guides is None else guides.names
        self.chain = Chain(controller.env, policy, links)
        self.inputs = []
        for key in self.chain.reads:
            spec = plant.observation_spec[key]
            self.inputs.append(Entry(key, tuple(spec.shape[plant.batch_dims :]), spec.dtype))
        if given is not None:
            self.inputs.append(given.entry)
        self.space = space_of(plant, plant.action_key)
        self.eval().requires_grad_(False)
        first = self.chain.remembered(self.chain.first(TensorDict({}, [1])))
        self.places = list(first)
        self.state = [self._entry(*place, value[0]) for place, value in first.items()]

    def _entry(self, number: int, key: NestedKey, first: Tensor) -> Entry:
        """Return an entry of the state."""
        # A guide may remember the executed action by the key of the agent's own ones.
        if isinstance(self.chain.links[number], LastAction):
            key = ("past", *((key,) if isinstance(key, str) else key))
        return Entry(key, tuple(first.shape), first.dtype, first)

    def forward(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        """Return the action and the state for the next step.

        Args:
            tensors: `inputs`, then `state`, [B, ...] each.
        """
        data = TensorDict({}, tensors[0].shape[:1])
        past = self.chain.first(data)
        for (number, key), tensor in zip(self.places, tensors[len(self.inputs) :], strict=True):
            past[number][key] = tensor
        for entry, tensor in zip(self.inputs, tensors, strict=False):
            data.set(entry.key, tensor)
        data, past = self.chain(data, past)
        action = self.space.executed(data[self.chain.action_key])
        return (action, *(past[number][key] for number, key in self.places))


def _flat(policy: TensorDictModuleBase) -> Iterable[TensorDictModuleBase]:
    """Yield the modules of a policy, with memories written out."""
    if isinstance(policy, TensorDictSequential):
        for module in policy.module:
            yield from _flat(module)
    elif isinstance(policy, GRUModule):
        yield WrittenGru(policy)
    else:
        yield policy


def exportable(controller: Controller) -> list[Link]:
    """Return the links of a controller; a `NotExportableError` for one that no function can be."""
    links = list(links_of(controller.env.transform, tensors=True))
    for link in links:
        if isinstance(link, DegradedAdvice):
            draws = any(isinstance(part, SeededGenerator) for part in link.children())
            if draws or link.needs_past or link.slots:
                raise NotExportableError(
                    f"{type(link).__name__} degrades the advice at random or by that of earlier "
                    "steps, which is for experiments only; train without degrade"
                )
    return links
