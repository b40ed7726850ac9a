"""A policy behind its transforms as one function: from what an env writes to what it is given.

The function has the memory of all parts as an argument and as a result. It is the controller of a
run, what is exported, and the guide that a run is for another one.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, TypeAlias

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from torch import Tensor, nn
from torch.nn.parameter import is_lazy
from torchrl.envs import Compose, InitTracker, RewardSum, TensorDictPrimer, Transform
from torchrl.envs import TransformedEnv as Env

from coil_rl.errors import UserError
from coil_rl.transforms.disturbance import Disturbance
from coil_rl.transforms.guide_actions import GuideActions
from coil_rl.transforms.link import Link, State, write

Past: TypeAlias = list[State]  # of the links, in their order
BEFORE = "before"  # the data of the step before
# What the policy remembers, and where episodes begin, is said by `Remembered`. A machine has its
# own delays and noise, and pays no reward.
LEFT_OUT = (Disturbance, InitTracker, RewardSum, TensorDictPrimer)


class Chain(nn.Module):
    """Links and a policy, called in their order.

    Args:
        env: with transforms, in evaluation mode. It gives the specs and is never stepped.
        policy: for this env, with `in_keys` and `out_keys`.
        links: in place of those of the env; None: its transforms, see `links_of`.
    """

    def __init__(self, env: Env, policy: nn.Module, links: Iterable[Link] | None = None) -> None:
        super().__init__()
        links = links_of(env.transform) if links is None else links
        self._links: list[Link] = [*links, Remembered(env, policy)]
        self.links = nn.ModuleList(self._links)
        self.policy, self.action_key = policy, env.action_key
        # Transforms hold a weak reference to their env; the tuple keeps it from being a submodule.
        self._env = (env,)

    @property
    def reads(self) -> list[NestedKey]:
        """Entries of the env that are read, in its order."""
        (env,) = self._env
        parts: list[Any] = [*self.links, self.policy]
        read = {key for part in parts for key in part.in_keys}
        return [key for key in env.base_env.observation_spec.keys(True, True) if key in read]

    def first(self, data: TensorDictBase) -> Past:
        """Return the state before an episode, if that depends on nothing but the number of rows.

        Args:
            data: without entries, [*batch].
        """
        return [link.first(data) for link in self._links]

    def remembered(self, past: Past) -> dict[tuple[int, NestedKey], Tensor]:
        """Return what changes within an episode, by the number of the link and the key."""
        parts = enumerate(zip(self._links, past, strict=True))
        return {(n, key): own[key] for n, (link, own) in parts if not link.constant for key in own}

    def forward(self, data: TensorDictBase, past: Past | None) -> tuple[TensorDictBase, Past]:
        """Return the data with the action that the env is given, and the state for the next step.

        Args:
            data: what the env writes, [*batch]; all else is written into it.
            past: state after the step before; None: an episode begins.
        """
        links, states = self._links, Past()
        for number, link in enumerate(links):
            state = link.first(data) if past is None else past[number]
            states.append(link.observe(data, state))
            write(data, states[-1])
        data = self.policy(data)
        for number in reversed(range(len(links))):
            states[number] = links[number].act(data, states[number])
        pairs = zip(links, states, strict=True)
        return data, [link.sent(data, state) for link, state in pairs]


def links_of(transform: Transform, *, tensors: bool = False) -> Iterator[Link]:
    """Yield the transforms that have an effect on what a policy sees or does.

    Guides that demonstrate, and what reads their advice, have none: they were there to be imitated.

    Args:
        tensors: whether states must be tensors, so that a transform of somebody else cannot have
            one.
    """
    unwritten = set[NestedKey]()
    for link in _links_in(transform, tensors):
        if _demonstrates(link):
            unwritten.update(link.out_keys)
        elif not unwritten.intersection(link.in_keys):
            yield link


def _demonstrates(link: Link) -> bool:
    guides = link.guides.guides.values() if isinstance(link, GuideActions) else ()
    return bool(guides) and all(getattr(guide, "demonstrates", False) for guide in guides)


def _links_in(transform: Transform, tensors: bool) -> Iterator[Link]:
    """Yield the transforms that are no disturbances."""
    if isinstance(transform, Compose):
        for each in transform.transforms:
            yield from _links_in(each, tensors)
    elif not isinstance(transform, LEFT_OUT) and not _pays(transform):
        yield transform if isinstance(transform, Link) else Other(transform, tensors)


def _pays(transform: Transform) -> bool:
    """Return whether a transform changes nothing but the reward."""
    return bool(transform.out_keys) and {*transform.out_keys} <= {*transform.parent.reward_keys}


class Other(Link):
    """A transform of somebody else as a link.

    Args:
        transform: the transform.
        tensors: whether it must not remember anything, which is a `UserError`; else it gets the
            data of the step before.
    """

    def __init__(self, transform: Transform, tensors: bool) -> None:
        super().__init__(in_keys=list(transform.in_keys or ()), out_keys=[])
        self.transform, self.tensors = transform, tensors
        if tensors and self._remembers():
            raise UserError(
                f"{type(transform).__name__} remembers earlier steps in a way of its own, which "
                "neither a learned guide nor an exported policy can; train without it, such as "
                "with network=gru"
            )

    def _remembers(self) -> bool:
        """Return whether what the transform writes depends on the steps before."""
        spec = self.transform.parent.observation_spec
        calls = (spec.zero(), spec.one(), spec.zero())
        first, _, again = (self.transform._call(data) for data in calls)
        changed = any((again[key] != value).any() for key, value in first.items(True, True))
        return changed or getattr(self.transform, "needs_past", False)

    def observe(self, data: TensorDictBase, state: State) -> State:
        """Write what the transform writes in a step, or after a reset."""
        before: Any = state.get(BEFORE)
        if self.tensors:
            written = self.transform._call(data)
        elif before is None:
            self.transform._reset_env_preprocess(None)
            written = self.transform._reset(data.empty(), data)
        else:
            written = self.transform._step(before, data)
        data.update(written)
        return {}

    def act(self, data: TensorDictBase, state: State) -> State:
        """Write the action that the transform makes of it."""
        data.update(self.transform._inv_call(data))
        return state

    def sent(self, data: Any, state: State) -> State:
        """Keep the data of the step."""
        return {} if self.tensors else {BEFORE: data}


def restore(transform: Transform, state: dict[str, Any]) -> None:
    """Restore what `state_dict` of a transform returned."""
    for name, buffer in transform.named_buffers():
        if is_lazy(buffer):  # until the first reset, as that of CatFrames
            buffer.materialize(state[name].shape)
    transform.load_state_dict(state)


def memory_keys(policy: Any) -> list[tuple[str, ...]]:
    """Return the entries that a policy writes for its next step, `("next", ...)`.

    There are none without a memory.
    """
    return [key for key in policy.out_keys if isinstance(key, tuple) and key[0] == "next"]


class Remembered(Link):
    """What a policy remembers: what it reads as `k` and writes as `("next", k)`, and `is_init`.

    Args:
        env: of the policy; its primers say how the memory begins.
        policy: the policy.
    """

    def __init__(self, env: Env, policy: Any) -> None:
        super().__init__(in_keys=[], out_keys=[])
        names = [unravel_key(key[1:]) for key in memory_keys(policy)]
        self.keys: list[NestedKey] = [key for key in names if key in policy.in_keys]
        own = env.base_env.observation_spec.keys(True, True)
        self.marks = "is_init" in policy.in_keys and "is_init" not in own
        start = TensorDict({}, env.batch_size, device=env.device)
        for part in env.transform.modules():
            if isinstance(part, TensorDictPrimer):
                start = part._reset(start.empty(), start)
        self.start = {key: start[key][(0,) * env.batch_dims] for key in self.keys}

    def first(self, data: TensorDictBase, reset: TensorDictBase | None = None) -> State:
        """Return how the memory begins."""
        batch = data.batch_size
        state: State = {
            key: value.expand(*batch, *value.shape).clone() for key, value in self.start.items()
        }
        return state | self._mark(data, begins=True)

    def sent(self, data: TensorDictBase, state: State) -> State:
        """Return what the policy wrote for its next step."""
        after: State = {}
        for key in self.keys:
            after[key] = data["next", *((key,) if isinstance(key, str) else key)]
        return after | self._mark(data, begins=False)

    def _mark(self, data: TensorDictBase, *, begins: bool) -> State:
        shape = (*data.batch_size, 1)
        return {"is_init": torch.full(shape, begins, device=data.device)} if self.marks else {}
