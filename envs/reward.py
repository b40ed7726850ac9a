"""The reward of the cone worlds (paper 4.1.1).

The cone world, the driving tasks and the simulated robot share it: an env fills in the `Outcome` of
its step, and `weighted_terms` turns that into the terms whose sum is the reward. The terms are kept
apart until the end, because they are also written under `info` for the analysis of a run.
"""

import math
from collections.abc import Mapping, Sequence
from functools import reduce
from typing import NamedTuple

import torch
from torch import Tensor

from coil_rl.envs.constants import constant

HISTORY = 20  # actions that the mean of the roughness is taken over
TERMS = ("finish", "crash", "cone", "smooth", "alive")


class RewardWeights(NamedTuple):
    """Weights of the reward (paper 4.1.1).

    Attributes:
        finish: for a completed lap.
        second: per second of the time of a completed lap.
        crash: in the step of a crash, instead of all other terms.
        cone: for each side with a newly visible cone.
        smooth: per unit of roughness, |a - mean of the last 20 actions|.
        alive: for each step.
    """

    finish: float = 70.0
    second: float = -0.8
    crash: float = -100.0
    cone: float = 2.5
    smooth: float = -0.1
    alive: float = 0.001


class Outcome(NamedTuple):
    """What happened in a step, as far as the reward depends on it.

    Attributes:
        action: [B], fraction of the greatest steering angle.
        roughness: [B], |a - mean of the last 20 actions|.
        lap_time: [B] s, of the lap just completed, else 0.
        finished: [B], whether a lap was completed.
        discovered: [B], number of sides with a newly visible cone.
        to_boundaries: [2, B] m, distances to the left and the right boundary.
        crashed: [B], whether the car crashed.
        alive: [B], 0 after a crash, else 1.
    """

    action: Tensor
    roughness: Tensor
    lap_time: Tensor
    finished: Tensor
    discovered: Tensor
    to_boundaries: Tensor
    crashed: Tensor
    alive: Tensor


def weighted_terms(outcome: Outcome, weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the terms of the paper's reward (4.1.1), [B] each; the reward is their sum.

    Args:
        outcome: what happened in the step.
        weights: by the names of `RewardWeights`, scalars or [B].
    """
    alive = outcome.alive
    bonus = outcome.finished * weights["finish"]
    return {
        "finish": torch.addcmul(bonus, outcome.lap_time, weights["second"]) * alive,
        "crash": outcome.crashed * weights["crash"],
        "cone": outcome.discovered * weights["cone"] * alive,
        "smooth": outcome.roughness * weights["smooth"] * alive,
        "alive": weights["alive"] * alive,
    }


def check_weights(name: str, weights: Mapping[str, float], known: Sequence[str]) -> None:
    """Raise a `ValueError` for unknown weights and for values outside [-1e6, 1e6].

    Args:
        name: of the argument that holds the weights, for the message.
        weights: the weights by name.
    """
    unknown = set(weights) - set(known)
    if unknown:
        raise ValueError(f"{name} has no weight {sorted(unknown)}; it has {', '.join(known)}")
    for key, value in weights.items():
        if not abs(value) <= 1e6:
            raise ValueError(f"{name}.{key}={value} must be between -1e6 and 1e6")


def recent_mean(history: Tensor) -> Tensor:
    """Return the mean of the last actions, weighted by exp(-0.1 k) for the action k steps ago: [B].

    Args:
        history: [20, B], the actions, newest first.
    """
    weights = [math.exp(-0.1 * k) for k in range(HISTORY)]
    shares = constant(tuple(weight / sum(weights) for weight in weights), history)
    # The order of the sum is fixed, while that of `Tensor.sum` depends on the batch size.
    fours = (history * shares).view(2, 2, 5, -1)
    pairs = torch.add(*fours.unbind(0))
    return reduce(torch.add, torch.add(*pairs.unbind(0)).unbind(0))
