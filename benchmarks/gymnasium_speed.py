"""Speed of PPO on single Gymnasium envs, beside Stable-Baselines3 with equal settings."""

from __future__ import annotations

import time
from argparse import Namespace
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

from benchmarks.beside_sb3 import VALUES, our_training, their_training
from benchmarks.timing import Row, Stopwatch, median_ratio, medians

ENVS = ("Pendulum-v1", "CartPole-v1", "LunarLanderContinuous-v3")


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
    learner, rollout, own = our_training("ppo", env_id, values, 0)
    model, their = their_training("ppo", env_id, values, 0)
    frames = values["envs"] * values["steps"]
    subjects: dict[str, tuple[Callable[[], Any], Stopwatch]] = {
        "ours": (lambda: learner.update(rollout.collect()), own),
        "sb3": (lambda: model.learn(frames, reset_num_timesteps=False), their),
    }
    rates: dict[str, list[float]] = {}
    for work, _ in subjects.values():
        work()
    for _ in range(args.repeats):
        for name, (work, stopwatch) in subjects.items():
            stopwatch.seconds.clear()
            start = time.process_time()
            work()
            seconds = time.process_time() - start
            updates = stopwatch.seconds["updates"]
            rates.setdefault(name, []).append(frames / seconds)
            rates.setdefault(f"{name}, collection", []).append(frames / (seconds - updates))
            rates.setdefault(f"{name}, update", []).append(frames / updates)
    median = medians(rates)
    row: Row = {f"{name} (frames/s)": median[name] for name in subjects}
    for part in ("", ", collection", ", update"):
        row[f"ratio{part}"] = median_ratio(rates[f"ours{part}"], rates[f"sb3{part}"])
    return {**row, "rounds": {name: rates[name] for name in subjects}}
