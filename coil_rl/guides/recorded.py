"""Actions from a file as a guide."""

import os

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.envs import TensorDictPrimer

from coil_rl.files import LARGEST_TABLE, read_text
from coil_rl.transforms.guide_memory import primer_of


class RecordedGuide(TensorDictModuleBase):
    """Actions from a CSV file by the number of the step, from the first step of every episode on.

    The last one is held after the end of the file. Recordings of a robot have a guide of their own.

    Args:
        file: a CSV of numbers, [T, A] in the env's unit, one line for each step, with commas
            between them; the first line may hold names. Another file is a `ValueError`.
    """

    in_keys, out_keys = ["recorded_step"], ["action", ("next", "recorded_step")]

    def __init__(self, file: str | os.PathLike[str]) -> None:
        super().__init__()
        self.actions: torch.Tensor = nn.Buffer(_read_actions(file), persistent=False)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action of the step, and the number of the next one."""
        step = tensordict["recorded_step"]
        action = self.actions[step.squeeze(-1).clamp(max=len(self.actions) - 1)]
        return tensordict.set("action", action).set(("next", "recorded_step"), step + 1)

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """Declare the number of the step as memory."""
        return primer_of({"recorded_step": torch.zeros(1, dtype=torch.int64)})


def _read_actions(file: str | os.PathLike[str]) -> torch.Tensor:
    """Return the actions of a CSV file, [T, A]."""
    name = os.fspath(file)
    try:
        text = read_text(file, LARGEST_TABLE).removeprefix("\ufeff")  # as Excel writes it
        rows = [line.split(",") for line in text.splitlines() if line.strip()]
        if rows and all(map(_is_name, rows[0])):
            del rows[0]
        actions = np.array(rows, dtype=np.float32)
    except (OSError, UnicodeError, ValueError) as error:
        raise ValueError(
            f"file={name} cannot be read as numbers with commas between them, as many in each "
            f"line ({error})"
        ) from error
    if not actions.size or not np.isfinite(actions).all():
        raise ValueError(f"file={name} must hold at least one line of finite numbers")
    return torch.from_numpy(actions)


def _is_name(text: str) -> bool:
    name = text.strip(' "')
    return name[:1].isalpha() and name.lower() not in ("nan", "inf", "infinity")
