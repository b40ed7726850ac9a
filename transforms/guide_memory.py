"""Memory of guides by TorchRL's convention, carried from step to step by the env's data.

As the memory is in the data, a guide is a function without a state of its own: it works for any
number of rows, and a restored env restores its guides.
"""

from collections.abc import Mapping
from functools import partial

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.data import TensorSpec, Unbounded
from torchrl.envs import Compose, TensorDictPrimer
from torchrl.modules.utils import get_primers_from_module

from coil_rl.transforms.link import State

SUPPLIED = ("is_init", "row", "last_action")  # what a guide may read besides the entries of the env


class GuideMemory:
    """What a guide reads as `k` and writes as `("next", k)`.

    The guide declares it by its `make_tensordict_primer()`; a guide without a declaration has no
    memory.

    Args:
        name: of the guide, for messages.
        guide: the guide.

    Raises:
        ValueError: for an entry that is not declared, or one without a fixed value at the start of
            an episode.
    """

    def __init__(self, name: str, guide: TensorDictModuleBase) -> None:
        primers = get_primers_from_module(guide, warn=False)
        if isinstance(primers, Compose):
            parts = list(primers.transforms)
        else:
            parts = [primers] if primers else []
        nested = [key for key in guide.out_keys if isinstance(key, tuple)]
        written = {unravel_key(key[1:]) for key in nested if key[0] == "next"}
        self.name = name
        self.specs, self.first = {}, {}
        for primer in parts:
            if primer.random or primer.single_default_value:
                raise ValueError(
                    f"the memory of guide {name!r} must begin with a number or function for each "
                    "entry"
                )
            row = (0,) * len(primer.primers.shape)
            for key, spec in primer.primers.items(True, True):
                if key in written:
                    self.specs[key] = spec[row] if row else spec
                    self.first[key] = primer.default_value[key]
        undeclared = written - self.specs.keys()
        if undeclared:
            raise ValueError(
                f"guide {name!r} writes {sorted(map(str, undeclared))} for its next step, but "
                "nothing says how they begin; give it make_tensordict_primer()"
            )

    def key(self, key: NestedKey) -> NestedKey:
        """Return under which key an entry of the memory is in the data of an env."""
        return ("guide_state", self.name, *((key,) if isinstance(key, str) else key))

    def spec(self, batch: torch.Size, device: torch.device | None) -> dict[NestedKey, TensorSpec]:
        """Return the specs of the memory of all rows of an env, by their batch size and device."""
        rows = {key: row.to(device) if device else row for key, row in self.specs.items()}
        return {self.key(key): row.expand(*batch, *row.shape) for key, row in rows.items()}

    def start(self, batch: torch.Size, device: torch.device | None) -> State:
        """Return the memory at the start of episodes."""
        memory: State = {}
        for key, spec in self.specs.items():
            first = self.first[key]
            if callable(first):
                value = first().to(device or "cpu")
            else:
                value = torch.full(spec.shape, first, dtype=spec.dtype, device=device)
            memory[self.key(key)] = value.expand(*batch, *spec.shape).clone()
        return memory

    def given_to(self, data: TensorDictBase, memory: State) -> TensorDictBase:
        """Write what the guide reads of its memory."""
        for key in self.specs:
            data.set(key, memory[self.key(key)])
        return data

    def kept(self, data: TensorDictBase, memory: State) -> None:
        """Replace the memory by what the guide has written for its next step."""
        for key in self.specs:
            memory[self.key(key)] = data["next", key]


def primer_of(start: Mapping[str, Tensor]) -> TensorDictPrimer:
    """Return the declaration of a memory.

    Args:
        start: what a row remembers at the start of an episode, by the name of the entry.
    """
    specs = {name: Unbounded(row.shape, dtype=row.dtype) for name, row in start.items()}
    first = {name: partial(torch.clone, row) for name, row in start.items()}
    return TensorDictPrimer(specs, default_value=first, expand_specs=True)
