"""Speed of PPO on single Gymnasium envs, beside Stable-Baselines3 with equal settings."""

from __future__ import annotations

import time
from argparse import Namespace
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import torch

from benchmarks.beside_sb3 import VALUES, normalised_env, our_learner, their_learner
from benchmarks.timing import Row, Stopwatch, median_ratio, medians
from coil_rl.run.rollout import Rollout

ENVS = ("Pendulum-v1", "CartPole-v1", "LunarLanderContinuous-v3")
Work = tuple[Callable[[], Any], Stopwatch]  # a batch and its updates, and the time of the latter


def measure_gymnasium(args: Namespace) -> list[Row]:
    """Return a row for each env and number of envs: frames per CPU second, eager, on one core.

    Both have the values of `VALUES["ppo"]`, with `args.gymnasium_steps` to a rollout. In every
    round each has its turn, and the ratios are medians over the rounds.
    """
    if find_spec("stable_baselines3") is None:
        reason = "Stable-Baselines3 is not installed: python -m pip install 'coil-rl[bench]'"
        return [{"not measured": reason}]
    rows = []
    for env_id in ENVS:
        for envs in args.gymnasium_envs:
            values = {**VALUES["ppo"], "envs": envs, "steps": args.gymnasium_steps}
            rows.append({"env": env_id, "envs": envs, **compared(args, env_id, values)})
    return rows


def compared(args: Namespace, env_id: str, values: dict[str, Any]) -> Row:
    """Return the speeds of both on an env, and the ratios of the whole and of its parts."""
    subjects = {"ours": ours(env_id, values), "sb3": theirs(env_id, values)}
    frames = values["envs"] * values["steps"]
    rates: dict[str, list[float]] = {name: [] for name in subjects}
    parts: dict[str, list[float]] = {}
    for work, _ in subjects.values():
        work()
    for _ in range(args.repeats):
        for name, (work, stopwatch) in subjects.items():
            stopwatch.seconds.clear()
            start = time.process_time()
            work()
            seconds = time.process_time() - start
            updates = stopwatch.seconds["updates"]
            rates[name].append(frames / seconds)
            parts.setdefault(f"{name} collection", []).append(frames / (seconds - updates))
            parts.setdefault(f"{name} update", []).append(frames / updates)
    row: Row = {f"{name} (frames/s)": rate for name, rate in medians(rates).items()}
    row["ratio"] = median_ratio(rates["ours"], rates["sb3"])
    for part in ("collection", "update"):
        row[f"ratio, {part}"] = median_ratio(parts[f"ours {part}"], parts[f"sb3 {part}"])
    return {**row, "rounds": rates}


def ours(env_id: str, values: dict[str, Any]) -> Work:
    """Return a batch and its updates of our learner."""
    torch.manual_seed(0)
    env = normalised_env(env_id, values["envs"])
    learner = our_learner("ppo", env, values, seed=0)
    rollout = Rollout(env, learner.policy, values["steps"], learner.keys)
    stopwatch = Stopwatch(time.process_time)
    stopwatch.wrap(learner, "update", "updates")
    return lambda: learner.update(rollout.collect()), stopwatch


def theirs(env_id: str, values: dict[str, Any]) -> Work:
    """Return a batch and its updates of the learner of Stable-Baselines3."""
    from stable_baselines3.common.env_util import make_vec_env

    # Its default, rgb_array, makes LunarLander slower and slower.
    envs = make_vec_env(env_id, values["envs"], seed=0, env_kwargs={"render_mode": None})
    model = their_learner("ppo", envs, values, seed=0)
    stopwatch = Stopwatch(time.process_time)
    stopwatch.wrap(model, "train", "updates")
    frames = values["envs"] * values["steps"]
    return lambda: model.learn(frames, reset_num_timesteps=False), stopwatch
