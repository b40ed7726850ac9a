"""COIL: the actions that guides would take, as one more observation (paper section 3, equation 97)."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import TensorSpec
from torchrl.envs import Transform

from coil_rl.transforms.action_space import ActionSpace
from coil_rl.transforms.answers import Answers


class GuideActions(Transform):
    """Asks each guide what it would do and writes the answers next to the observation.

    The agent is free to use them: nothing ties its action to them. A guide is any TensorDictModule that reads what the
    env writes and writes an action; it runs without gradients, on its own copy of the data, so that nothing but its
    action gets through. If every guide says `pure = True`, that its action follows from what it reads of the same row
    and from nothing else, what they say of the states in which episodes begin is remembered.

    Where the env's actions are numbers of a finite set (`Categorical`), the advice is one-hot.

    Args:
        guides: the guides by name, in the order of the rows they write.
        action_key: the entry that the guides write.
        out_key: where the advice goes, [*batch, n_guides, A], in action units.

    Raises:
        TypeError: if the guides have no names.
        ValueError: without a guide, or if one does not write `action_key`.

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
        if not isinstance(guides, Mapping):
            raise TypeError(f"guides must be a table from name to guide, not {type(guides).__name__}")
        if not guides:
            raise ValueError("GuideActions needs at least one guide, none was given")
        for name, guide in guides.items():
            if action_key not in guide.out_keys:
                raise ValueError(f"guide {name!r} must write {action_key!r}; it writes {guide.out_keys}")
            if not name or "." in name or hasattr(nn.ModuleDict, name):
                raise ValueError(f"{name!r} cannot be the name of a guide: PyTorch keeps it for itself; take another")
        in_keys = dict.fromkeys(key for guide in guides.values() for key in guide.in_keys)
        super().__init__(in_keys=list(in_keys), out_keys=[out_key])
        self.guides = nn.ModuleDict(guides)
        self._reads = {name: guide.in_keys for name, guide in guides.items()}
        self.action_key = action_key
        self._answers = Answers() if all(getattr(guide, "pure", False) for guide in guides.values()) else None
        # Asking the env costs as much as a step, so it is asked once.
        self._space: ActionSpace | None = None

    @property
    def names(self) -> list[str]:
        """The guides' names, one per row of the advice."""
        return list(self.guides)

    def train(self, mode: bool = True) -> GuideActions:
        """Switch to training: the guides stay as they are when they are used."""
        super().train(mode)
        self.guides.eval()
        return self

    def get_extra_state(self) -> dict[str, list[str]]:
        """The guides' names: a policy that learned to read their rows must not get others'."""
        return {"names": self.names}

    def set_extra_state(self, state: dict[str, list[str]]) -> None:
        """Refuse a state of other guides, or of another order.

        Raises:
            ValueError: naming both.
        """
        if state["names"] != self.names:
            raise ValueError(f"the state is of the guides {', '.join(state['names'])}, not {', '.join(self.names)}")

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the advice on data that an env of this kind wrote before."""
        return self._call(tensordict)

    @torch.no_grad()
    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict.set(self.out_keys[0], self._advice(next_tensordict))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        mask = tensordict.get("_reset", None)
        if mask is None or mask.all():
            return self._call(tensordict_reset)
        # The other rows are thrown away, and in a large batch nearly every step resets a few.
        rows: tuple[Tensor, ...] = mask.reshape(tensordict.batch_size).nonzero(as_tuple=True)
        asked = tensordict_reset.select(*self.in_keys, strict=False)[rows]
        with torch.no_grad():
            advice = self._advice(asked) if self._answers is None else self._answers(asked, self._advice)
        everything = advice.new_zeros((*tensordict_reset.batch_size, *advice.shape[1:]))
        return tensordict_reset.set(self.out_keys[0], everything.index_put(rows, advice))

    def _advice(self, tensordict: TensorDictBase) -> Tensor:
        """[*batch, n_guides, A]."""
        space, rows = self.space, []
        for name, guide in self.guides.items():
            rows.append(space.vectors(guide(tensordict.select(*self._reads[name], strict=False))[self.action_key]))
        return torch.stack(rows, tensordict.batch_dims)

    @property
    def space(self) -> ActionSpace:
        """The env's actions.

        Raises:
            RuntimeError: outside an env.
        """
        if self._space is None:
            if self.parent is None:
                raise RuntimeError(
                    "GuideActions gives advice inside a TransformedEnv only: it needs the env's action spec"
                )
            self._space = ActionSpace(self.parent.full_action_spec[self.action_key], self.parent.batch_dims)
        return self._space

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the advice."""
        observation_spec[self.out_keys[0]] = self.space.advice_spec(self.parent.batch_size, len(self.guides))
        return observation_spec
