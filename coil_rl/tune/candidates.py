"""Several guides as one, each on its own part of the rows: those that a search compares."""

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn

from coil_rl.transforms.action_space import ActionSpace, OwnForms
from coil_rl.transforms.hosted import HostedGuide, ToldGuide


class Candidates(HostedGuide):
    """Guide that acts by one of several guides of one kind in each part of the rows.

    The rows are divided evenly: of [B] rows the first B / N are those of the first of N guides.

    Args:
        guides: of one class, with the same entries.
    """

    def __init__(self, guides: Sequence[TensorDictModuleBase]) -> None:
        first = guides[0]
        self.in_keys: list[NestedKey] = list(first.in_keys)
        self.out_keys: list[NestedKey] = list(first.out_keys)
        super().__init__()
        self.known: tuple[ActionSpace, OwnForms] | None = None  # of the env
        self.guides = nn.ModuleList(guides)
        self.share = 0  # number of rows of each guide, known at the start of episodes

    @property
    def by_row(self) -> bool:  # type: ignore[override]
        """Whether there is one object for each row, see `Guides`."""
        return all(isinstance(guide, HostedGuide) and guide.by_row for guide in self.guides)

    def replace(self, guides: Sequence[TensorDictModuleBase]) -> None:
        """Act by other guides of the same class from here on, in new episodes.

        Args:
            guides: perhaps of another number.
        """
        self.guides = nn.ModuleList(guides)
        if self.known is not None:
            self.meet(*self.known)

    def meet(self, space: ActionSpace, own: OwnForms) -> None:
        """Tell the guides that ask for it about their env."""
        self.known = space, own
        for guide in self.guides:
            if isinstance(guide, ToldGuide):
                guide.meet(space, own)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the actions, and what the guides remember for their next step."""
        split = zip(self.guides, tensordict.split(self._sizes(tensordict)), strict=True)
        parts = [guide(part) for guide, part in split if len(part)]
        for key in self.out_keys:
            tensordict.set(key, torch.cat([part[key] for part in parts]))
        return tensordict

    def _sizes(self, tensordict: TensorDictBase) -> list[int]:
        """Return the number of rows of each guide; some may have left, see `Guides`."""
        count = len(self.guides)
        if not self.by_row:
            return [len(tensordict) // count] * count
        if tensordict["is_init"].all():
            self.share = len(tensordict) // count
        sizes: list[int] = (
            (tensordict["row"].flatten() // self.share).bincount(minlength=count).tolist()
        )
        return sizes
