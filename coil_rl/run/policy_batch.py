"""Faster evaluation of policies.

Several act in one batch, and their operations are traced once and repeated.
"""

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, exploration_type, set_exploration_type

from coil_rl.compiled import record
from coil_rl.learners.policy import NOISE
from coil_rl.transforms.chain import memory_keys


def policy_batch(
    policy: TensorDictModuleBase, states: Sequence[dict[str, Any]]
) -> TensorDictModuleBase:
    """Return a policy for rows [S * C] that acts in state s, one of S, on rows s C to (s + 1) C."""
    copies = [copy.deepcopy(policy) for _ in states]
    for each, state in zip(copies, states, strict=True):
        each.load_state_dict(state)
    if not is_tensors(policy):
        return OnRows(list(map(Acting, copies)))
    weights = torch.stack([TensorDict.from_module(each) for each in copies]).detach()

    def act_with(own: TensorDictBase, rows: TensorDictBase) -> Tensor:
        with own.to_module(copies[0]):
            return copies[0](rows)["action"]

    def act(rows: TensorDictBase) -> Tensor:
        return torch.vmap(act_with)(weights, rows.view(len(copies), -1)).flatten(0, 1)

    return TracedPolicy(policy.in_keys, act)


def is_tensors(policy: TensorDictModuleBase) -> bool:
    """Return whether a policy has no state but its parameters and buffers.

    It has no memory within an episode, either.
    """
    # A part that stands in two places has two names, as in the state.
    parameters = policy.named_parameters(remove_duplicate=False)
    buffers = policy.named_buffers(remove_duplicate=False)
    tensors = {name for name, _ in [*parameters, *buffers]}
    return tensors == set(policy.state_dict()) and not memory_keys(policy)


def traced(policy: TensorDictModuleBase) -> TensorDictModuleBase:
    """Return a policy for an evaluation, traced if it is one of tensors only."""
    if not is_tensors(policy):
        return policy
    return TracedPolicy(policy.in_keys, lambda rows: policy(rows)["action"])


def acted(policy: TensorDictModuleBase, entries: TensorDictBase, sampled: bool) -> TensorDictBase:
    """Return what a policy writes, with sampled or with deterministic actions."""
    with set_exploration_type(ExplorationType.RANDOM if sampled else ExplorationType.DETERMINISTIC):
        return policy(entries)


@dataclass(frozen=True, eq=False)
class Acting:
    """A policy in an env, and the rows on which it acts.

    Args:
        policy: writes the action. It is called as it is, see `traced`.
        sampled: whether it samples its actions.
        rows: on which it acts; None: on its equal part.
        whole: whether it is called with all rows of the env, so that its random numbers do not
            depend on those on which it acts.
    """

    policy: TensorDictModuleBase
    sampled: bool = False
    rows: slice | None = None
    whole: bool = False

    def act(self, entries: TensorDictBase, rows: slice) -> TensorDictBase:
        """Return what the policy writes for some rows of the entries of an env."""
        if self.whole:
            return acted(self.policy, entries.copy(), self.sampled)[rows]
        return acted(self.policy, entries[rows], self.sampled)


class OnRows(TensorDictModuleBase):
    """Policies side by side in one env, each on its own rows.

    Args:
        parts: in the order of their rows.
    """

    def __init__(self, parts: Sequence[Acting]) -> None:
        policies = [part.policy for part in parts]
        self.in_keys = list(dict.fromkeys(key for each in policies for key in each.in_keys))
        remembered = dict.fromkeys(key for each in policies for key in memory_keys(each))
        self.out_keys = ["action", *remembered]
        super().__init__()
        self.parts = list(parts)  # plain objects, so that the policies are no submodules

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the `action` of the policy of each row, and what policies remember."""
        entries = tensordict.select(*self.in_keys)
        size = len(entries) // len(self.parts)
        written = []
        for number, part in enumerate(self.parts):
            rows = part.rows or slice(number * size, (number + 1) * size)
            written.append(part.act(entries, rows))
        for key in self.out_keys:
            # What a policy remembers stays as it is on the rows of the others.
            own = [each[key] if key in each.keys(True) else each[key[1:]] for each in written]
            tensordict.set(key, torch.cat(own))
        return tensordict


class TracedPolicy(TensorDictModuleBase):
    """A policy with fixed weights and no other state, see `is_tensors`.

    Its operations are traced at the first call for a number of rows, once for each type of
    exploration, and repeated afterwards, which takes half of the time or less. Exploration noise
    that somebody has written is read.

    Args:
        in_keys: entries that it reads.
        act: returns the action for entries of rows.
    """

    def __init__(
        self, in_keys: Sequence[NestedKey], act: Callable[[TensorDictBase], Tensor]
    ) -> None:
        self.in_keys, self.out_keys = list(in_keys), ["action"]
        super().__init__()
        self.act = act
        self.traced: dict[Any, Callable[..., Sequence[Tensor]]] = {}

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the `action`."""
        keys = [*self.in_keys, NOISE] if NOISE in tensordict else self.in_keys
        # The traced operations are those for one layout in memory.
        entries = [tensordict[key].contiguous() for key in keys]
        kind = exploration_type(), len(entries[0]), len(keys)
        if kind not in self.traced:
            self.traced[kind] = record(partial(self._actions, keys), entries).forward
        return tensordict.set("action", self.traced[kind](*entries)[0])

    def _actions(self, keys: Sequence[NestedKey], *entries: Tensor) -> list[Tensor]:
        rows = TensorDict(dict(zip(keys, entries, strict=True)), [len(entries[0])])
        return [self.act(rows)]
