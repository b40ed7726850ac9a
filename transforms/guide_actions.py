"""Advice: the actions of guides as an additional observation, as in COIL (paper section 3, equation 97)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import TensorSpec
from torchrl.envs import Transform

from coil_rl.transforms.action_space import ActionSpace


class Guides(TensorDictModuleBase):
    """Several guides as one module that writes their actions side by side.

    Args:
        guides: name to guide, in the order of the rows of the advice.
        action_key: entry written by each guide, [*batch, A].
        out_key: entry for the advice, [*batch, n_guides, A].
        trainable: require parameters in each guide.

    Raises:
        TypeError: if `guides` is not a mapping.
        ValueError: without a guide, for an invalid name, or for a guide without `action_key` or parameters.
    """

    def __init__(
        self,
        guides: Mapping[str, TensorDictModuleBase],
        action_key: NestedKey = "action",
        out_key: NestedKey = "guide_action",
        trainable: bool = False,
    ) -> None:
        if not isinstance(guides, Mapping):
            raise TypeError(f"guides must be a mapping from name to guide, not {type(guides).__name__}")
        if not guides:
            raise ValueError("at least one guide is required, none was given")
        for name, guide in guides.items():
            if action_key not in guide.out_keys:
                raise ValueError(f"guide {name!r} must write {action_key!r}; it writes {guide.out_keys}")
            if not name or "." in name or hasattr(nn.ModuleDict, name):
                raise ValueError(f"{name!r} cannot be the name of a guide: PyTorch reserves it; use another name")
            if trainable and next(guide.parameters(), None) is None:
                raise ValueError(f"guide {name!r} has no parameters to train; imitate it with a network (coil-distill)")
        self.in_keys = list(dict.fromkeys(key for guide in guides.values() for key in guide.in_keys))
        self.out_keys = [out_key]
        super().__init__()
        self.guides = nn.ModuleDict(guides)
        self.action_key = action_key
        self._in_keys_of = {name: guide.in_keys for name, guide in guides.items()}

    @property
    def names(self) -> list[str]:
        """Names of the guides, one per row of the advice."""
        return list(self.guides)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the advice."""
        return tensordict.set(self.out_keys[0], self.advice(tensordict))

    def advice(self, tensordict: TensorDictBase, convert: Callable[[Tensor], Tensor] | None = None) -> Tensor:
        """Return the advice [*batch, n_guides, A].

        Args:
            tensordict: observations; each guide gets a copy of its own entries.
            convert: applied to the action of each guide.
        """
        rows = []
        for name, guide in self.guides.items():
            action = guide(tensordict.select(*self._in_keys_of[name], strict=False))[self.action_key]
            rows.append(action if convert is None else convert(action))
        return torch.stack(rows, tensordict.batch_dims)


class GuideCache:
    """Cache of advice by observation, for the first states of episodes.

    Episodes start in few states, and a lookup is much faster than a guide on one row. Beyond `max_rows` new rows are
    not cached.
    """

    def __init__(self, max_rows: int = 256) -> None:
        self.max_rows = max_rows
        self.index: dict[bytes, int] = {}
        self.advice: Tensor | None = None

    def __call__(self, data: TensorDictBase, advise: Callable[[TensorDictBase], Tensor]) -> Tensor:
        """Return `advise(data)`, [N, ...], from data [N]; `advise` is called on new rows only."""
        columns = [leaf.reshape(len(data), leaf.shape[1:].numel()).double() for leaf in data.values(True, True)]
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
        return advise(data) if self.advice is None else self.advice[[self.index[key] for key in keys]]


class GuideActions(Transform):
    """Write the action of each guide into the observation.

    The agent is free to use the advice. A guide is any TensorDictModule that reads observations of the env and writes
    an action. Guides run in evaluation mode, without gradients, on a copy of the data. If all guides have the attribute
    `pure = True` (the action is a deterministic function of the guide's input entries of the same row), the advice for
    the first states of episodes is cached. With discrete actions (`Categorical`) the advice is one-hot.

    Args:
        guides: name to guide, in the order of the rows of the advice.
        action_key: entry written by the guides.
        out_key: entry for the advice, [*batch, n_guides, A] in action units.

    Raises:
        TypeError: if `guides` is not a mapping.
        ValueError: without a guide, for an invalid name, or for a guide that does not write `action_key`.

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
        super().__init__(in_keys=module.in_keys, out_keys=module.out_keys)
        self.guides, self.action_key = module, action_key
        self._cache = GuideCache() if all(getattr(guide, "pure", False) for guide in guides.values()) else None

    @cached_property
    def action_space(self) -> ActionSpace:
        """Action space of the env; RuntimeError outside an env."""
        return ActionSpace.of_parent(self, self.action_key)

    @property
    def names(self) -> list[str]:
        """Names of the guides, one per row of the advice."""
        return self.guides.names

    def train(self, mode: bool = True) -> GuideActions:
        """Set the training mode; guides stay in evaluation mode."""
        super().train(mode)
        self.guides.eval()
        return self

    def get_extra_state(self) -> dict[str, list[str]]:
        """Return the names of the guides."""
        return {"names": self.names}

    def set_extra_state(self, state: dict[str, list[str]]) -> None:
        """Compare the names of the guides: a policy depends on their order.

        Raises:
            ValueError: for a state of other guides, or of another order.
        """
        if state["names"] != self.names:
            raise ValueError(f"the state is of the guides {', '.join(state['names'])}, not {', '.join(self.names)}")

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the advice for stored data of the same env."""
        return self._call(tensordict)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict.set(self.out_keys[0], self._advice(next_tensordict))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        mask = tensordict.get("_reset", None)
        if mask is None or mask.all():
            return self._call(tensordict_reset)
        # TorchRL discards the other rows; in a large batch nearly every step resets a few rows.
        rows: tuple[Tensor, ...] = mask.reshape(tensordict.batch_size).nonzero(as_tuple=True)
        data = tensordict_reset.select(*self.in_keys, strict=False)[rows]
        advice = self._advice(data) if self._cache is None else self._cache(data, self._advice)
        full = advice.new_zeros((*tensordict_reset.batch_size, *advice.shape[1:]))
        return tensordict_reset.set(self.out_keys[0], full.index_put(rows, advice))

    @torch.no_grad()
    def _advice(self, tensordict: TensorDictBase) -> Tensor:
        return self.guides.advice(tensordict, self.action_space.vectors)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the advice."""
        observation_spec[self.out_keys[0]] = self.action_space.advice_spec(
            self.parent.batch_size, len(self.guides.names)
        )
        return observation_spec
