"""The reward of the cone worlds (paper 4.1.1)."""

import math
from collections.abc import Mapping, Sequence
from functools import reduce
from typing import NamedTuple

import torch
from torch import Tensor

from coil_rl.envs.constants import constant

HISTORY = 20
TERMS = ("finish", "crash", "cone", "smooth", "alive")


class RewardWeights(NamedTuple):
    """Weights of the reward (paper 4.1.1)."""

    finish: float = 70.0  # for a completed lap
    second: float = -0.8  # per second of its lap time
    crash: float = -100.0  # in the step of a crash, instead of all other terms
    cone: float = 2.5  # for each side with a newly visible cone
    smooth: float = -0.1  # per unit of roughness
    alive: float = 0.001  # for each step


class Outcome(NamedTuple):
    """Quantities of a step that the reward depends on, [B] unless noted."""

    action: Tensor
    roughness: Tensor  # |a - mean of the last 20 actions|
    lap_time: Tensor  # s, of the lap just completed, else 0
    finished: Tensor  # whether a lap was completed
    discovered: Tensor  # number of sides with a newly visible cone
    to_boundaries: Tensor  # [2, B] m, distances to the left and the right boundary
    crashed: Tensor
    alive: Tensor  # 0 after a crash, else 1


def weighted_terms(outcome: Outcome, weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the terms of the paper's reward (4.1.1), [B] each, for weights that are scalars or [B]."""
    alive = outcome.alive
    return {
        "finish": torch.addcmul(
            outcome.finished * weights["finish"], outcome.lap_time, weights["second"]
        )
        * alive,
        "crash": outcome.crashed * weights["crash"],
        "cone": outcome.discovered * weights["cone"] * alive,
        "smooth": outcome.roughness * weights["smooth"] * alive,
        "alive": weights["alive"] * alive,
    }


def check_weights(name: str, weights: Mapping[str, float], known: Sequence[str]) -> None:
    """Raise ValueError for unknown weights and for values outside [-1e6, 1e6]."""
    unknown = set(weights) - set(known)
    if unknown:
        raise ValueError(f"{name} has no weight {sorted(unknown)}; it has {', '.join(known)}")
    for key, value in weights.items():
        if not abs(value) <= 1e6:
            raise ValueError(f"{name}.{key}={value} must be between -1e6 and 1e6")


def recent_mean(history: Tensor) -> Tensor:
    """Return the mean of the last actions [20, B], newest first, weighted by exp(-0.1 k); fixed summation order."""
    weights = [math.exp(-0.1 * k) for k in range(HISTORY)]
    fours = (history * constant(tuple(weight / sum(weights) for weight in weights), history)).view(
        2, 2, 5, -1
    )
    pairs = torch.add(*fours.unbind(0))
    return reduce(torch.add, torch.add(*pairs.unbind(0)).unbind(0))
