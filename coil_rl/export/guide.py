"""An exported policy as a guide."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.envs import TensorDictPrimer

from coil_rl.errors import UserError
from coil_rl.export.contract import ADVICE
from coil_rl.export.policy import ExportedPolicy
from coil_rl.transforms.action_space import ActionRange, ActionSpace, OwnForms
from coil_rl.transforms.guide_memory import primer_of
from coil_rl.transforms.hosted import ToldGuide


class ExportedGuide(ToldGuide):
    """Deterministic action of a policy in a file, for all rows at once.

    What the policy remembers is the memory of the guide, as entries of the data.

    Args:
        file: `policy.onnx` of `coil-export`, or its folder.
        threads: of onnxruntime.

    Raises:
        UserError: for a file that cannot be used, see `ExportedPolicy`, and for one whose own
            guide is outside; in an env for one of other entries or another action.
    """

    def __init__(self, file: str | os.PathLike[str], threads: int = 1) -> None:
        super().__init__()
        self.exported = ExportedPolicy(os.fspath(file), threads)
        contract = self.exported.contract
        names = [entry["name"] for entry in contract["inputs"]]
        if ADVICE in names:
            raise UserError(
                f"{self.exported.file} needs the action of its own guide, which is outside "
                f"({contract['guide']['reason']}); take the run itself: guide=learned "
                "guide.learned.run=RUN"
            )
        self.read: list[NestedKey] = [
            unravel_key(tuple(entry["key"])) for entry in contract["inputs"]
        ]
        self.memory = {f"exported_{entry['input']}": entry for entry in contract["state"]}
        self.in_keys = [*self.read, *self.memory]
        self.out_keys: list[NestedKey] = ["action", *(("next", name) for name in self.memory)]

    def meet(self, space: ActionSpace, own: OwnForms) -> None:
        """Check the action of an env.

        Raises:
            UserError: if the policy acts in another one.
        """
        exported = _range(self.exported.contract["outputs"][0])
        if not exported.same_as(space.range):
            raise self._unfit(f"its action goes {space.range}, not {exported}")

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action, and what is remembered."""
        flat = tensordict.select(*self.in_keys).reshape(-1)
        inputs = {}
        for entry, key in zip(self.exported.contract["inputs"], self.read, strict=True):
            if list(flat[key].shape[1:]) != entry["shape"]:
                raise self._unfit(f"{entry['name']} has the shape {list(flat[key].shape[1:])}")
            inputs[entry["name"]] = _array(flat[key], entry["dtype"])
        for name, entry in self.memory.items():
            inputs[entry["input"]] = _array(flat[name], entry["dtype"])
        for key, value in zip(self.out_keys, self.exported.session(inputs), strict=True):
            written = torch.from_numpy(value).to(flat.device or "cpu")
            tensordict.set(key, written.reshape(*tensordict.batch_size, *written.shape[1:]))
        return tensordict

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """Declare what is remembered."""
        first = self.exported.first_state()
        entries = self.memory.items()
        return primer_of({n: torch.from_numpy(first[each["input"]][0]) for n, each in entries})

    def _unfit(self, problem: str) -> UserError:
        title = self.exported.contract["env"]["title"]
        return UserError(
            f"{self.exported.file} is a policy for {title}, which this env is not: {problem}; give "
            "the env that its contract.json names"
        )


def _array(tensor: Tensor, dtype: str) -> NDArray[Any]:
    return tensor.cpu().numpy().astype(dtype)


def _range(action: Mapping[str, Any]) -> ActionRange:
    """Return the numbers that an action may have; None in its bounds stands for infinite ones."""
    if action.get("choices"):
        low = np.array(action["lowest"])
        return ActionRange(low, low + np.array(action["choices"]) - 1, whole=True)
    bounds, unknown = action.get("bounds") or {}, np.full(action["shape"], np.nan)
    # None becomes NaN.
    low, high = (np.array(bounds.get(side, unknown), dtype=float) for side in ("low", "high"))
    low, high = np.where(np.isnan(low), -np.inf, low), np.where(np.isnan(high), np.inf, high)
    return ActionRange(low, high, whole=False)
