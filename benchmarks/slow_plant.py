"""Speed of an env whose step takes 2 ms, in one process and in one for each core."""

from __future__ import annotations

import os
import time
from argparse import Namespace
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from torchrl.envs import Compose, EnvBase, RewardSum, TransformedEnv

from benchmarks.timing import Row, Work, measure, median_ratio, medians
from coil_rl.foreign.gymnasium_env import GymnasiumEnv
from coil_rl.learners import PPO
from coil_rl.run.rollout import Rollout

SECONDS = 2e-3  # of a step
ROWS, STEPS = 8, 40


class SlowPlant(gymnasium.Env[Any, Any]):
    """A plant that does nothing, and keeps its core busy for `SECONDS` at each step."""

    observation_space = Box(-1, 1, (3,), np.float32)
    action_space = Box(-1, 1, (1,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(3, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take a step."""
        end = time.perf_counter() + SECONDS
        while time.perf_counter() < end:
            pass
        self.steps += 1
        return np.zeros(3, np.float32), 0.0, False, self.steps >= 1_000, {}


def measure_workers(args: Namespace) -> list[Row]:
    """Return a row for steps of the env, for TorchRL's rollouts and for batches of a training.

    The clock is that of the wall, so the machine should have nothing else to do.
    """
    cores = len(os.sched_getaffinity(0))
    if cores < 2:
        return [{"not measured": "there is one core"}]
    alone, spread = works(0), works(cores)
    rows: list[Row] = []
    for name in alone:
        rates = measure(args, {"one process": alone[name], "spread": spread[name]})
        row: Row = {"subject": name, "rows": ROWS, "processes": cores}
        row |= {f"{each} (frames/s)": rate for each, rate in medians(rates).items()}
        ratio = median_ratio(rates["spread"], rates["one process"])
        rows.append({**row, "ratio": ratio, "ratio / cores": ratio / cores})
    return rows


def works(workers: int) -> dict[str, Work]:
    """Return the functions that are timed by name: a step, a rollout, a batch."""
    env: EnvBase = GymnasiumEnv(SlowPlant, ROWS, workers=workers, seed=0)
    action = env.rand_action(env.reset())
    whole = TransformedEnv(
        GymnasiumEnv(SlowPlant, ROWS, workers=workers, seed=0), Compose(RewardSum())
    )
    learner = PPO(whole, minibatches=2)
    batches = Rollout(whole, learner.policy, STEPS, learner.keys)

    def step() -> int:
        env._step(action)
        return ROWS

    def rollout() -> int:
        env.rollout(STEPS, break_when_any_done=False)
        return ROWS * STEPS

    def collect() -> int:
        batches.collect()
        return ROWS * STEPS

    return {"a step of the env": step, "env.rollout": rollout, "batches of a training": collect}
