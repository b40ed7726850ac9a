"""Guides that are told about their env, among them those that run the code of somebody else."""

import importlib
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from coil_rl.transforms.action_space import ActionSpace, OwnForms


def guide_of(thing: Any) -> TensorDictModuleBase:
    """Return a TensorDictModule itself, and anything else as a `ControllerGuide`."""
    if isinstance(thing, TensorDictModuleBase):
        return thing
    # By its public name, as nothing here knows other people's code.
    guide: TensorDictModuleBase = importlib.import_module("coil_rl").ControllerGuide(thing)
    return guide


class ToldGuide(TensorDictModuleBase):
    """A guide that is told which actions there are, and how its env numbers what it shows."""

    def meet(self, space: ActionSpace, own: OwnForms) -> None:
        """Take what an env says about itself.

        Args:
            own: what converts entries from the form of networks to that of the env.
        """


class HostedGuide(ToldGuide):
    """A guide that runs the code of somebody else, whose actions are checked in every step.

    Attributes:
        by_row: whether there is one object for each row. It is not asked after the end of an
            episode: rows that have ended keep their last advice.
    """

    by_row = False

    def unfit(
        self, action: Tensor, batch: torch.Size, space: ActionSpace, problem: str
    ) -> Exception | None:
        """Return the error for an action that does not fit the env, as it was returned.

        None leaves the sentence to whoever asks the guide.

        Args:
            problem: says why, as the end of a sentence.
        """
        return None
