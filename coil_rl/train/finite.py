"""Finds the first number that is none, before a run learns from it or keeps it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase

from coil_rl.errors import UserError


def check_batch(batch: TensorDictBase, steps: int = 0) -> None:
    """Refuse a batch in which an entry is NaN or infinite; on a good one the device is waited for once.

    Args:
        batch: [*B, T] consecutive steps of B cars.
        steps: that each car drove before this batch.

    Raises:
        UserError: naming the entry that was the first to be so, the step (counted from 1) and the car (from 0).
    """
    floats = {key: value for key, value in batch.items(True, True) if value.is_floating_point()}
    if not floats or torch.stack([value.isfinite().all() for value in floats.values()]).all():
        return
    found = []
    for order, (key, value) in enumerate(floats.items()):
        if value.isfinite().all():
            continue
        rows = value.reshape(batch.shape[:-1].numel(), batch.shape[-1], -1)
        t, car = (~rows.isfinite()).any(-1).T.nonzero()[0].tolist()
        numbers = rows[car, t]
        path = (key,) if isinstance(key, str) else key
        # What a step begins with comes before what it ends with.
        place = (t, path[0] == "next", order)
        found.append((place, car, float(numbers[~numbers.isfinite()][0]), "/".join(path)))
    (t, _, _), car, number, name = min(found)
    raise UserError(f"{name} is {number} at step {steps + t + 1} of car {car}")


def check_losses(values: Mapping[str, float], update: int) -> None:
    """Refuse what an update reports if a number in it is NaN or infinite.

    Raises:
        UserError: naming it and the update.
    """
    for name, value in values.items():
        if not math.isfinite(value):
            raise UserError(f"{name} is {value} in update {update}")


def check_state(state: Any, update: int, name: str = "learner") -> None:
    """Refuse a state with NaN in one of its tensors, down to any depth; a bound may well be infinite.

    Raises:
        UserError: naming the tensor and the update it comes from.
    """
    if isinstance(state, Mapping):
        for key, value in state.items():
            check_state(value, update, f"{name}/{key}")
    elif isinstance(state, torch.Tensor) and state.is_floating_point() and state.isnan().any():
        raise UserError(f"{name} is nan after update {update}")
