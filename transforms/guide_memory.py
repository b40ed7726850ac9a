"""Memory of guides by TorchRL's convention, carried from step to step by the env's data."""

import torch
from tensordict import TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torchrl.data import Composite
from torchrl.envs import Compose
from torchrl.modules.utils import get_primers_from_module

SUPPLIED = ("is_init", "row", "last_action")  # what a guide may read besides the entries of the env


class GuideMemory:
    """What a guide reads as `k` and writes as `("next", k)`, declared by its `make_tensordict_primer()`.

    The `name` of the guide is for messages; a guide without a declaration has no memory. An entry
    that is not declared, or one without a fixed value at the start of an episode, is a
    `ValueError`.
    """

    def __init__(self, name: str, guide: TensorDictModuleBase) -> None:
        primers = get_primers_from_module(guide, warn=False)
        parts = primers.transforms if isinstance(primers, Compose) else [primers] if primers else []
        written = {
            unravel_key(key[1:])
            for key in guide.out_keys
            if isinstance(key, tuple) and key[0] == "next"
        }
        self.specs, self.first = {}, {}
        for primer in parts:
            if primer.random or primer.single_default_value:
                raise ValueError(
                    f"the memory of guide {name!r} must begin with a number or function for each entry"
                )
            row = (0,) * len(primer.primers.shape)
            for key, spec in primer.primers.items(True, True):
                if key in written:
                    self.specs[key], self.first[key] = (
                        spec[row] if row else spec,
                        primer.default_value[key],
                    )
        if undeclared := written - self.specs.keys():
            problem = f"guide {name!r} writes {sorted(map(str, undeclared))} for its next step"
            raise ValueError(
                f"{problem}, but nothing says how they begin; give it make_tensordict_primer()"
            )

    def spec(self, batch: torch.Size, device: torch.device | None) -> Composite:
        """Return the spec of the memory of all rows of an env, given their batch size and device."""
        rows = {key: row.to(device) if device else row for key, row in self.specs.items()}
        specs = {key: row.expand(*batch, *row.shape) for key, row in rows.items()}
        return Composite(specs, shape=batch, device=device)

    def start(self, batch: torch.Size, device: torch.device | None) -> TensorDictBase:
        """Return the memory at the start of episodes."""
        memory = TensorDict({}, batch, device=device)
        for key, spec in self.specs.items():
            first = self.first[key]
            value = (
                first()
                if callable(first)
                else torch.full(spec.shape, first, dtype=spec.dtype, device=device)
            )
            memory.set(key, value.expand(*batch, *spec.shape).clone())
        return memory
