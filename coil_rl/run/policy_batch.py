"""Faster evaluation of policies.

Several act in one batch, and their operations are traced once and repeated.
"""

import copy
from collections.abc import Callable, Container, Sequence
from functools import partial
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
    TensorDictSequential,
)
from tensordict.utils import expand_as_right
from torch import Tensor
from torch._ops import OpOverload
from torch.fx import GraphModule, Node
from torch.fx.node import map_arg
from torchrl.envs.utils import ExplorationType, exploration_type, set_exploration_type

from coil_rl.compiled import record
from coil_rl.learners.policy import NOISE


def policy_batch(
    policy: TensorDictModuleBase, states: Sequence[dict[str, Any]]
) -> TensorDictModuleBase:
    """Return a policy for rows [S * C] that acts in state s, one of S, on rows s C to (s + 1) C."""
    return StackedPolicies(policy, states) if is_tensors(policy) else PoliciesInTurn(policy, states)


def is_tensors(policy: TensorDictModuleBase) -> bool:
    """Return whether a policy has no state but its parameters and buffers.

    It has no memory within an episode, either.
    """
    # A part that stands in two places has two names, as in the state.
    parameters = policy.named_parameters(remove_duplicate=False)
    buffers = policy.named_buffers(remove_duplicate=False)
    tensors = {name for name, _ in [*parameters, *buffers]}
    return tensors == set(policy.state_dict()) and not memory_keys(policy)


def memory_keys(policy: TensorDictModuleBase) -> list[NestedKey]:
    """Return the entries that a policy writes for its next step, `("next", ...)`.

    There are none without a memory.
    """
    return [key for key in policy.out_keys if isinstance(key, tuple) and key[0] == "next"]


def traced(policy: TensorDictModuleBase) -> TensorDictModuleBase:
    """Return a policy for an evaluation, traced if it is one of tensors only."""
    return TracedPolicy(policy) if is_tensors(policy) else policy


class PartlySampled(TensorDictModuleBase):
    """A policy that samples its actions in some rows, and takes the deterministic ones in others.

    Its network is computed once for both.

    Args:
        policy: whose last module draws the action.
        sampled: [B], whether the actions of each row are sampled.
    """

    def __init__(self, policy: ProbabilisticTensorDictSequential, sampled: Tensor) -> None:
        self.in_keys, self.out_keys = list(policy.in_keys), list(policy.out_keys)
        super().__init__()
        *modules, self.last = policy.module
        self.network, self.sampled = TensorDictSequential(*modules), sampled

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        tensordict = self.network(tensordict)
        with set_exploration_type(ExplorationType.RANDOM):
            drawn = self.last(tensordict)["action"]
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            chosen = self.last(tensordict)["action"]
        rows = expand_as_right(self.sampled, drawn)
        return tensordict.set("action", torch.where(rows, drawn, chosen))


@torch.no_grad()
def compute_constants(graph: GraphModule) -> None:
    """Compute the operations of a graph that depend on its constants only, once for all calls.

    Their numbers are the same to the bit. A graph that changes a tensor in place stays as it is.

    Args:
        graph: as traced by `coil_rl.compiled.record`, whose weights do not change.
    """
    nodes: Any = graph.graph.nodes
    if any(_is_operation(node) and node.target._schema.is_mutable for node in nodes):
        return
    known: dict[Node, Any] = {}
    for node in nodes:
        if node.op == "get_attr":
            known[node] = getattr(graph, node.target)
        elif _is_operation(node) and _is_constant(node, known):
            args, kwargs = map_arg((node.args, node.kwargs), known.__getitem__)
            known[node] = node.target(*args, **kwargs)
    for node in list(known):
        if node.op == "get_attr" or known.keys() >= node.users.keys():
            continue
        name = f"computed_{node.name}"
        graph.register_buffer(name, known[node])
        with graph.graph.inserting_before(node):
            node.replace_all_uses_with(graph.graph.get_attr(name))
    graph.graph.eliminate_dead_code()
    graph.recompile()


def _is_operation(node: Any) -> bool:
    """Return whether a node of a graph calls an operation of PyTorch."""
    return node.op == "call_function" and isinstance(node.target, OpOverload)


def _is_constant(node: Any, known: Container[Node]) -> bool:
    """Return whether an operation returns the same tensor in every call of the graph.

    Its inputs are known tensors, and it draws no random numbers.
    """
    inputs, results = node.all_input_nodes, node.target._schema.returns
    return (
        bool(inputs)
        and all(each in known for each in inputs)
        and [str(result.type) for result in results] == ["Tensor"]
        and torch.Tag.nondeterministic_seeded not in node.target.tags
    )


class TracedPolicy(TensorDictModuleBase):
    """A policy with fixed weights and no other state, see `is_tensors`.

    Its operations are traced at the first call for a number of rows, once for each type of
    exploration, and repeated afterwards, which takes half of the time or less. What depends on the
    weights only is computed once. Exploration noise that somebody has written is read.
    """

    def __init__(self, policy: TensorDictModuleBase) -> None:
        self.in_keys, self.out_keys = list(policy.in_keys), ["action"]
        super().__init__()
        self._policy = (policy,)  # a tuple, so that it is no submodule
        self.traced: dict[Any, Callable[..., Sequence[Tensor]]] = {}

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the `action`."""
        keys = [*self.in_keys, NOISE] if NOISE in tensordict else self.in_keys
        # The traced operations are those for one layout in memory.
        entries = [tensordict[key].contiguous() for key in keys]
        kind = exploration_type(), len(entries[0]), len(keys)
        if kind not in self.traced:
            graph = record(partial(self._actions, keys), entries)
            compute_constants(graph)
            self.traced[kind] = graph.forward
        return tensordict.set("action", self.traced[kind](*entries)[0])

    def _actions(self, keys: Sequence[NestedKey], *entries: Tensor) -> list[Tensor]:
        rows = TensorDict(dict(zip(keys, entries, strict=True)), [len(entries[0])])
        return [self._act(rows)]

    def _act(self, rows: TensorDictBase) -> Tensor:
        (policy,) = self._policy
        action: Tensor = policy(rows)["action"]
        return action


class StackedPolicies(TracedPolicy):
    """Copies of a policy with different weights, computed in one batch.

    Each acts on its own part of the rows.
    """

    def __init__(self, policy: TensorDictModuleBase, states: Sequence[dict[str, Any]]) -> None:
        super().__init__(copy.deepcopy(policy))
        policies = PoliciesInTurn(policy, states).policies
        self.states = torch.stack([TensorDict.from_module(each) for each in policies]).detach()

    def _act(self, rows: TensorDictBase) -> Tensor:
        actions: Tensor = torch.vmap(self._act_in)(self.states, rows.view(len(self.states), -1))
        return actions.flatten(0, 1)

    def _act_in(self, state: TensorDictBase, rows: TensorDictBase) -> Tensor:
        with state.to_module(self._policy[0]):
            return super()._act(rows)


class PoliciesInTurn(TensorDictModuleBase):
    """Copies of any policy with different states, called in turn.

    Each acts on its own part of the rows.
    """

    def __init__(self, policy: TensorDictModuleBase, states: Sequence[dict[str, Any]]) -> None:
        super().__init__()
        self.in_keys, self.out_keys = list(policy.in_keys), ["action", *memory_keys(policy)]
        self.policies = torch.nn.ModuleList(copy.deepcopy(policy) for _ in states)
        for each, state in zip(self.policies, states, strict=True):
            each.load_state_dict(state)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the `action` of the policy of each row, and what that policy remembers."""
        parts = tensordict.select(*self.in_keys).chunk(len(self.policies))
        parts = [policy(part) for policy, part in zip(self.policies, parts, strict=True)]
        for key in self.out_keys:
            tensordict.set(key, torch.cat([part[key] for part in parts]))
        return tensordict


class PoliciesBeside(TensorDictModuleBase):
    """Any policies without a memory, side by side.

    Each acts on its own part of the rows.

    Args:
        policies: each acts on an equal part of the rows, in their order. They are called as they
            are, see `traced`.
        sampled: whether each samples its actions.
    """

    def __init__(self, policies: Sequence[TensorDictModuleBase], sampled: Sequence[bool]) -> None:
        super().__init__()
        keys = [key for policy in policies for key in policy.in_keys]
        self.in_keys, self.out_keys = list(dict.fromkeys(keys)), ["action"]
        # A list, so that they are no submodules.
        self.policies = list(policies)
        kinds = {True: ExplorationType.RANDOM, False: ExplorationType.DETERMINISTIC}
        self.kinds = [kinds[each] for each in sampled]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the `action` of the policy of each row."""
        parts = tensordict.select(*self.in_keys).chunk(len(self.policies))
        actions = []
        for policy, part, kind in zip(self.policies, parts, self.kinds, strict=True):
            with set_exploration_type(kind):
                actions.append(policy(part)["action"])
        return tensordict.set("action", torch.cat(actions))
