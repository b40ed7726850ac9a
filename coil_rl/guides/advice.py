"""What guides say as a part of a policy, so that gradients reach them through whatever reads it."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import nn


class Advice(TensorDictModuleBase):
    """Asks each guide what it would do and writes the answers side by side: `GuideActions` inside a policy.

    Args:
        guides: the guides by name, in the order of the rows they write; each writes `action`, [*batch, A].
        out_key: where the advice goes, [*batch, n_guides, A].

    Raises:
        ValueError: without a guide, or for one without parameters.
    """

    def __init__(self, guides: Mapping[str, TensorDictModuleBase], out_key: NestedKey = "guide_action") -> None:
        for name, guide in guides.items():
            if not any(True for _ in guide.parameters()):
                raise ValueError(
                    f"guide {name!r} has no parameters, so that no gradient can improve it; "
                    "put a network in its place that imitates it (coil-distill)"
                )
        if not guides:
            raise ValueError("Advice needs at least one guide, none was given")
        self.in_keys = list(dict.fromkeys(key for guide in guides.values() for key in guide.in_keys))
        self.out_keys = [out_key]
        super().__init__()
        self.guides = nn.ModuleDict(guides)
        self._reads = {name: guide.in_keys for name, guide in guides.items()}

    @property
    def names(self) -> list[str]:
        """The guides' names, one per row of the advice."""
        return list(self.guides)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the advice."""
        rows = [guide(tensordict.select(*self._reads[name]))["action"] for name, guide in self.guides.items()]
        return tensordict.set(self.out_keys[0], torch.stack(rows, tensordict.batch_dims))
