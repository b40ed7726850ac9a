"""What a step is worth by the paper's reward (4.1.1), in every world with cones."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import reduce
from typing import NamedTuple

import torch
from torch import Tensor

from coil_rl.envs.constants import constant

HISTORY = 20
REWARD_TERMS = ("finish", "crash", "cone", "smooth", "alive")


class Reward(NamedTuple):
    """Weights of the reward (paper 4.1.1).

    Attributes:
        finish: paid for a completed lap.
        second: paid per second of its lap time.
        crash: paid instead of everything else in the step of a crash.
        cone: paid for each side on which a cone comes into sight.
        smooth: paid per unit of |a - mean of the last 20 actions|.
        alive: paid every step.
    """

    finish: float = 70.0
    second: float = -0.8
    crash: float = -100.0
    cone: float = 2.5
    smooth: float = -0.1
    alive: float = 0.001


class Outcome(NamedTuple):
    """What a step brought each car, [B] unless said otherwise.

    Attributes:
        action: that was taken.
        roughness: |a - mean of the last 20 actions|.
        lap_time: s, of the lap just completed, else 0.
        finished: whether one was.
        discovered: on how many sides a cone came into sight.
        to_boundaries: [2, B] m, to the left and to the right one.
        crashed: whether it did.
        alive: 1 unless it did.
    """

    action: Tensor
    roughness: Tensor
    lap_time: Tensor
    finished: Tensor
    discovered: Tensor
    to_boundaries: Tensor
    crashed: Tensor
    alive: Tensor


def pay(outcome: Outcome, weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The terms of the paper's reward (4.1.1), [B] each.

    Args:
        outcome: of the step.
        weights: see `Reward`; each a number, or [B].
    """
    alive = outcome.alive
    return {
        "finish": torch.addcmul(outcome.finished * weights["finish"], outcome.lap_time, weights["second"]) * alive,
        "crash": outcome.crashed * weights["crash"],
        "cone": outcome.discovered * weights["cone"] * alive,
        "smooth": outcome.roughness * weights["smooth"] * alive,
        "alive": weights["alive"] * alive,
    }


def check_weights(name: str, weights: Mapping[str, float], known: Sequence[str]) -> None:
    """Refuse weights of a reward that do not exist or are no numbers to learn from.

    Raises:
        ValueError: naming the weight.
    """
    unknown = set(weights) - set(known)
    if unknown:
        raise ValueError(f"{name} has no weight {sorted(unknown)}; it has {', '.join(known)}")
    for key, value in weights.items():
        if not abs(value) <= 1e6:
            raise ValueError(f"{name}.{key}={value} must be between -1e6 and 1e6")


def recent_mean(history: Tensor) -> Tensor:
    """Mean of the last actions [20, B], newest first, weighted exp(-0.1 k), in a fixed order of summation."""
    weights = [math.exp(-0.1 * k) for k in range(HISTORY)]
    fours = (history * constant(tuple(weight / sum(weights) for weight in weights), history)).view(2, 2, 5, -1)
    pairs = torch.add(*fours.unbind(0))
    return reduce(torch.add, torch.add(*pairs.unbind(0)).unbind(0))
