"""Advice: the actions of guides as an additional observation, as in COIL (paper section 3, equation 97)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import Composite
from torchrl.envs import EnvBase, Transform

from coil_rl.transforms.action_space import ActionSpace, ActionTransform, nested_key
from coil_rl.transforms.guide_memory import SUPPLIED, GuideMemory


class UnfitActionError(ValueError):
    """The action of a guide does not fit the env; `problem` says why."""

    def __init__(self, guide: str, problem: str) -> None:
        super().__init__(f"the action of guide {guide!r} {problem}")
        self.problem = problem


class Guides(TensorDictModuleBase):
    """Several guides as one module that writes their actions side by side.

    Args:
        guides: name to guide, in the order of the rows of the advice.
        action_key: entry written by each guide, [*batch, A].
        out_key: entry for the advice, [*batch, n_guides, A].
        trainable: require parameters and no memory in each guide.

    Guides that are no mapping are a `TypeError`; none, an invalid name, or a guide without
    `action_key` or parameters, or with a memory that is not as in `GuideMemory`, are a
    `ValueError`.
    """

    def __init__(
        self,
        guides: Mapping[str, TensorDictModuleBase],
        action_key: NestedKey = "action",
        out_key: NestedKey = "guide_action",
        trainable: bool = False,
    ) -> None:
        action_key, out_key = nested_key(action_key), nested_key(out_key)
        if not isinstance(guides, Mapping):
            raise TypeError(
                f"guides must be a mapping from name to guide, not {type(guides).__name__}"
            )
        if not guides:
            raise ValueError("at least one guide is required, none was given")
        for name, guide in guides.items():
            if action_key not in guide.out_keys:
                raise ValueError(
                    f"guide {name!r} must write {action_key!r}; it writes {guide.out_keys}"
                )
            if not name or "." in name or hasattr(nn.ModuleDict, name):
                raise ValueError(
                    f"{name!r} cannot be the name of a guide: PyTorch reserves it; use another name"
                )
            if trainable and next(guide.parameters(), None) is None:
                raise ValueError(
                    f"guide {name!r} has no parameters to train; imitate it with a network (coil-distill)"
                )
        self.memories = {
            name: memory
            for name, guide in guides.items()
            if (memory := GuideMemory(name, guide)).specs
        }
        if trainable and self.memories:
            raise ValueError(
                f"guide {next(iter(self.memories))!r} has a memory, and such a guide cannot be trained"
            )
        self.in_keys = list(
            dict.fromkeys(key for guide in guides.values() for key in guide.in_keys)
        )
        self.out_keys = [out_key]
        super().__init__()
        self.guides = nn.ModuleDict(guides)
        self.action_key = action_key
        self._in_keys_of = {name: guide.in_keys for name, guide in guides.items()}
        self._input_dtype: dict[str, torch.dtype] = {}

    @property
    def names(self) -> list[str]:
        """Names of the guides, one per row of the advice."""
        return list(self.guides)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the advice."""
        return tensordict.set(self.out_keys[0], self.advice(tensordict))

    def advice(
        self,
        tensordict: TensorDictBase,
        convert: Callable[[str, Tensor, torch.Size], Tensor] | None = None,
        memory: TensorDictBase | None = None,
    ) -> Tensor:
        """Return the advice [*batch, n_guides, A].

        Args:
            tensordict: observations; each guide gets a copy of its own entries.
            convert: applied to name, action and batch of each guide.
            memory: by guide; replaced by what the guides remember for the next step.
        """
        rows = []
        for name, guide in self.guides.items():
            data = tensordict.select(*self._in_keys_of[name], strict=False)
            if dtype := self._input_dtype.get(name):
                data = data.apply(
                    lambda value, to=dtype: value.to(to) if value.is_floating_point() else value
                )
            if memory is not None and name in self.memories:
                data = guide(data.update(memory[name]))
                memory.set(name, data["next"].select(*self.memories[name].specs))
            else:
                data = guide(data)
            action = data[self.action_key]
            rows.append(action if convert is None else convert(name, action, tensordict.batch_size))
        return torch.stack(rows, -2)

    def match_dtypes(self, tensordict: TensorDictBase) -> None:
        """Convert from here on what a guide reads to the dtype of its parameters, if they differ."""
        for name, guide in self.guides.items():
            dtypes = {
                parameter.dtype for parameter in guide.parameters() if parameter.is_floating_point()
            }
            read = tensordict.select(*self._in_keys_of[name], strict=False).values(True, True)
            if len(dtypes) == 1 and any(
                value.is_floating_point() and value.dtype not in dtypes for value in read
            ):
                self._input_dtype[name] = dtypes.pop()


class GuideCache:
    """Cache of advice by observation, for the first states of episodes.

    Episodes start in few states, and a lookup is much faster than a guide on one row. Beyond
    `max_rows` new rows are not cached.
    """

    def __init__(self, max_rows: int = 256) -> None:
        self.max_rows = max_rows
        self.index: dict[bytes, int] = {}
        self.advice: Tensor | None = None

    def __call__(self, data: TensorDictBase, advise: Callable[[TensorDictBase], Tensor]) -> Tensor:
        """Return `advise(data)`, [N, ...], from data [N]; `advise` is called on new rows only."""
        columns = [
            leaf.reshape(len(data), leaf.shape[1:].numel()).double()
            for leaf in data.values(True, True)
        ]
        keys = [row.tobytes() for row in torch.cat(columns, 1).cpu().numpy()]
        new: dict[bytes, int] = {}
        for row, key in enumerate(keys):
            if key not in self.index:
                new.setdefault(key, row)
        if len(self.index) + len(new) > self.max_rows:
            return advise(data)
        if new:
            advice = advise(data[list(new.values())])
            self.advice = advice if self.advice is None else torch.cat([self.advice, advice])
            self.index.update(zip(new, range(len(self.index), len(self.advice)), strict=True))
        return (
            advise(data) if self.advice is None else self.advice[[self.index[key] for key in keys]]
        )


class GuideActions(ActionTransform):
    """Write the action of each guide into the observation.

    The agent is free to use the advice. A guide is any TensorDictModule that reads observations of
    the env and writes an action. Guides run in evaluation mode, without gradients, on a copy of the
    data. If all guides have the attribute `pure = True` (the action is a deterministic function of
    the guide's input entries of the same row), the advice for the first states of episodes is
    cached. With discrete actions the advice is one-hot; a guide may write an index or a one-hot
    vector. Advice is clamped to the bounds of the action.

    A guide may have a memory: what it reads as `k` and writes as `("next", k)`, declared by its
    `make_tensordict_primer()`, as TorchRL's `LSTMModule` and `GRUModule` do. It is kept in the data
    as `("guide_state", NAME, k)` and begins anew with each episode. Guides may also read `is_init`
    [*batch, 1], whether this is the first step of an episode; `row` [*batch, 1], the number of the
    row; and `last_action` [*batch, A], the last action that the env was given, after all transforms
    of it, 0 in the first step (one-hot if discrete).

    Args:
        guides: name to guide, in the order of the rows of the advice.
        action_key: entry written by the guides, and the env's action.
        out_key: entry for the advice, [*batch, n_guides, A] in action units; with an action for
            each of several agents [*batch, n_agents, n_guides, A].

    Raises:
        TypeError: if `guides` is not a mapping.
        ValueError: without a guide, for an invalid name, or for a guide that does not write
            `action_key`; at the first step for an action of another shape, or one that is not
            finite.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from coil_rl.envs import ConeTrackEnv, shipped_tracks
        >>> from coil_rl.guides import SplineGuide
        >>> env = TransformedEnv(ConeTrackEnv(shipped_tracks("train")), GuideActions({"middle": SplineGuide()}))
        >>> env.reset()["guide_action"].shape
        torch.Size([64, 1, 1])
    """

    def __init__(
        self,
        guides: Mapping[str, TensorDictModuleBase],
        action_key: NestedKey = "action",
        out_key: NestedKey = "guide_action",
    ) -> None:
        module = Guides(guides, action_key, out_key)
        self.supplied = [key for key in SUPPLIED if key in module.in_keys]
        super().__init__(in_keys=module.in_keys, out_keys=module.out_keys)
        self.guides, self.action_key = module, module.action_key
        pure = (
            all(getattr(guide, "pure", False) for guide in guides.values()) and not self.needs_past
        )
        self._cache = GuideCache() if pure else None
        self._checked: set[str] = set()

    @cached_property
    def given_space(self) -> ActionSpace:
        """Action space of the env without any transforms."""
        env = self.parent.base_env
        return ActionSpace(env.full_action_spec[self.action_key], env.batch_dims)

    @cached_property
    def rows(self) -> Tensor:
        """Numbers of the rows of the env, [*batch, 1]."""
        batch = self.parent.batch_size
        return torch.arange(batch.numel(), device=self.parent.device).reshape(*batch, 1)

    @property
    def names(self) -> list[str]:
        """Names of the guides, one per row of the advice."""
        return self.guides.names

    @property
    def needs_past(self) -> bool:
        """Whether a guide depends on earlier steps."""
        return bool(self.supplied or self.guides.memories)

    def set_container(self, container: Transform | EnvBase) -> None:
        """Set the env, which may have other rows than an earlier one."""
        super().set_container(container)
        self.__dict__.pop("rows", None)
        self._checked = set()

    def train(self, mode: bool = True) -> GuideActions:
        """Set the training mode; guides stay in evaluation mode."""
        super().train(mode)
        self.guides.eval()
        return self

    def get_extra_state(self) -> dict[str, list[str]]:
        """Return the names of the guides."""
        return {"names": self.names}

    def set_extra_state(self, state: dict[str, list[str]]) -> None:
        """Raise a `ValueError` for a state of other guides, or of another order, on which a policy depends."""
        if state["names"] != self.names:
            raise ValueError(
                f"the state is of the guides {', '.join(state['names'])}, not {', '.join(self.names)}"
            )

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the advice for stored data; raises a `ValueError` if a guide depends on earlier steps."""
        if self.needs_past:
            problem = f"the guides {', '.join(self.names)} need the previous steps, which stored data do not have"
            raise ValueError(f"{problem}; use them in a TransformedEnv")
        return self._call(tensordict)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict.set(self.out_keys[0], self._advice(next_tensordict))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        if not self.needs_past:
            return self._call(next_tensordict)
        # The data of the step hold the action as the env got it, after the transforms.
        action = self.given_space.vectors(tensordict[self.action_key])
        data = next_tensordict.select(*self.in_keys, strict=False)
        memory = tensordict.select(*(("guide_state", name) for name in self.guides.memories))
        return self._write(
            next_tensordict, *self._advice_with_past(data, memory, self.rows, action)
        )

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        mask = tensordict.get("_reset", None)
        if mask is None or mask.all():
            if not self.needs_past:
                return self._call(tensordict_reset)
            data = tensordict_reset.select(*self.in_keys, strict=False)
            return self._write(tensordict_reset, *self._advice_with_past(data, None, self.rows))
        # TorchRL discards the other rows; in a large batch nearly every step resets a few rows.
        rows: tuple[Tensor, ...] = mask.reshape(tensordict.batch_size).nonzero(as_tuple=True)
        data, memory = tensordict_reset.select(*self.in_keys, strict=False)[rows], None
        if self.needs_past:
            advice, memory = self._advice_with_past(data, None, self.rows[rows])
        else:
            advice = self._advice(data) if self._cache is None else self._cache(data, self._advice)

        def full(part: Tensor) -> Tensor:
            return part.new_zeros((*tensordict_reset.batch_size, *part.shape[1:])).index_put(
                rows, part
            )

        if memory is not None:
            memory = memory.apply(full, batch_size=tensordict_reset.batch_size)
        return self._write(tensordict_reset, full(advice), memory)

    def _write(
        self, tensordict: TensorDictBase, advice: Tensor, memory: TensorDictBase | None
    ) -> TensorDictBase:
        if memory is not None:
            for name in self.guides.memories:
                tensordict.set(("guide_state", name), memory[name])
        return tensordict.set(self.out_keys[0], advice)

    @torch.no_grad()
    def _advice(self, tensordict: TensorDictBase, memory: TensorDictBase | None = None) -> Tensor:
        if not self._checked:
            self.guides.match_dtypes(tensordict)
        return self.guides.advice(tensordict, self._converted, memory)

    def _advice_with_past(
        self,
        data: TensorDictBase,
        memory: TensorDictBase | None,
        rows: Tensor,
        action: Tensor | None = None,
    ) -> tuple[Tensor, TensorDictBase]:
        """Return advice and memory; without a memory for the first step of episodes."""
        batch = data.batch_size
        state = TensorDict({}, batch, device=data.device)
        for name, own in self.guides.memories.items():
            state.set(
                name,
                own.start(batch, data.device) if memory is None else memory["guide_state", name],
            )
        if action is None:
            space = self.given_space
            action = rows.new_zeros((*batch, *space.agents, space.size), dtype=space.dtype)
        is_init = torch.full_like(rows, memory is None, dtype=torch.bool)
        supplied = {"is_init": is_init, "row": rows, "last_action": action}
        for key in self.supplied:
            if key not in data:  # an entry of the env comes first
                data.set(key, supplied[key])
        return self._advice(data, state), state

    def _converted(self, name: str, action: Tensor, batch: torch.Size) -> Tensor:
        try:
            if name not in self._checked:
                self.action_space.check_advice(action, batch)
                self._checked.add(name)
            return self.action_space.advice(action, batch)
        except ValueError as error:
            raise UnfitActionError(name, str(error)) from None

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the advice and the memory.

        Two guides of one name with a memory, or one in an env that resets its agents one by one,
        are a `ValueError`.
        """
        observation_spec[self.out_keys[0]] = self.action_space.advice_spec(
            self.parent.batch_size, len(self.names)
        )
        return self._add_memory(observation_spec)

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        """Add the memory, which is an input of steps."""
        if self.guides.memories:
            state = input_spec["full_state_spec"] or Composite(
                shape=input_spec.shape, device=input_spec.device
            )
            input_spec["full_state_spec"] = self._add_memory(state)
        return input_spec

    def _add_memory(self, spec: Composite) -> Composite:
        for name, memory in self.guides.memories.items():
            if ("guide_state", name) in spec.keys(True):
                raise ValueError(f"two guides {name!r} have a memory; give them different names")
            if "_reset" not in self.parent.reset_keys:
                raise ValueError(
                    f"guide {name!r} has a memory, but the env resets its agents one by one"
                )
            spec["guide_state", name] = memory.spec(self.parent.batch_size, self.parent.device)
        return spec
