"""Evaluation of policies: one episode on every row of an env, its measures, and their means."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import expand_as_right
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from coil_rl.report.runs import MEASURES, PER_STEP

INFO = ("track", "lap_time", "crashed", "clearance", "smoothness", "pose")  # entries of `info` that are evaluated


@dataclass(frozen=True)
class EvaluationResult:
    """Episodes of a policy, one per car.

    Attributes:
        episodes: `track`, `reward` (sum), `steps`, `lap_time` s (mean of the completed laps, NaN without one), `laps`,
            `completed`, `crashed`, `smoothness` (mean |a - a_avg|) and `clearance` m (minimum). An env without `info`
            gives `reward` and `steps` only, one with tasks (`info`, `task`) also `steps_TASK` and `reward_TASK`.
        lines: positions of each car, [steps, 2] m.
        smoothness: |a - a_avg| of each car, [steps].
        rate: control steps per second, the attribute `rate` of the env; NaN for an env without it.
    """

    episodes: list[dict[str, Any]]
    lines: list[NDArray[np.float64]]
    smoothness: list[NDArray[np.float64]]
    rate: float

    @property
    def mean_reward(self) -> float:
        """Mean of the episodes."""
        return float(sum(episode["reward"] for episode in self.episodes) / len(self.episodes))

    def split(self, parts: int) -> list[EvaluationResult]:
        """Return consecutive parts of equally many cars."""
        size = len(self.episodes) // parts
        return [self[end - size : end] for end in range(size, len(self.episodes) + 1, size)]

    def __getitem__(self, cars: slice) -> EvaluationResult:
        """Return the episodes of some cars."""
        return EvaluationResult(self.episodes[cars], self.lines[cars], self.smoothness[cars], self.rate)


@torch.no_grad()
def evaluate_policy(
    env: EnvBase,
    policy: TensorDictModuleBase,
    *,
    sampled: bool | Tensor = False,
    names: Sequence[str] = (),
    tick: Callable[[], Any] | None = None,
) -> EvaluationResult:
    """Run one episode on every row of an env [B], with its transforms in evaluation mode.

    Args:
        env: batched env.
        policy: writes the action.
        sampled: whether to sample actions instead of taking the deterministic ones; bool, or [B] for each row.
        names: of the tracks.
        tick: called after every step.
    """
    history = [
        _record(after) | {"running": running} for after, running in episodes(env, policy, sampled=sampled, tick=tick)
    ]
    steps = {key: torch.stack([row[key] for row in history]).squeeze(-1).cpu().double().numpy() for key in history[0]}
    return _measure(steps, names, getattr(env, "rate", float("nan")))


def episodes(
    env: EnvBase,
    policy: TensorDictModuleBase,
    *,
    sampled: bool | Tensor = False,
    tick: Callable[[], Any] | None = None,
) -> Iterator[tuple[TensorDictBase, Tensor]]:
    """Yield the entries after each step of one episode on every row, and whether the row was still in it, [B, 1].

    Arguments as for `evaluate_policy`.
    """
    carrier = env.eval().reset()
    running = torch.ones_like(env.full_done_spec["done"].zero())
    for count in itertools.count(1):
        step = env.step(_act(policy, carrier, sampled))
        yield step["next"], running
        running = running & ~step["next", "done"]
        # The test waits for the device.
        if count % 8 == 0 and not running.any():
            return
        carrier = env.step_mdp(step)
        if tick is not None:
            tick()


def _act(policy: TensorDictModuleBase, carrier: TensorDictBase, sampled: bool | Tensor) -> TensorDictBase:
    if isinstance(sampled, Tensor):
        drawn = _act(policy, carrier, True)["action"]
        deterministic = _act(policy, carrier, False)
        return deterministic.set("action", torch.where(expand_as_right(sampled, drawn), drawn, deterministic["action"]))
    with set_exploration_type(ExplorationType.RANDOM if sampled else ExplorationType.DETERMINISTIC):
        return policy(carrier)


def _record(after: TensorDictBase) -> dict[str, Tensor]:
    record = {"reward": after["reward"]}
    if "info" in after:
        info = after["info"]
        record |= {key: info[key] for key in INFO}
        record["finished"] = after["terminated"] & ~info["crashed"]
        if "task" in info:
            record |= {f"steps_{name}": active for name, active in info["task"].items()}
    return record


def _measure(steps: dict[str, NDArray[np.float64]], names: Sequence[str], rate: float) -> EvaluationResult:
    episodes, lines, smoothness = [], [], []
    for car, running in enumerate(steps["running"].astype(bool).T):
        own = {key: values[running, car] for key, values in steps.items()}
        row: dict[str, Any] = {"reward": own["reward"].sum(), "steps": int(running.sum())}
        if "track" in own:
            track = int(own["track"][0])
            laps = own["lap_time"][own["lap_time"] > 0]
            row |= {
                "track": names[track] if names else str(track),
                "laps": len(laps),
                "lap_time": float(laps.mean()) if len(laps) else float("nan"),
                "completed": bool(own["finished"].any()),
                "crashed": bool(own["crashed"].any()),
                "smoothness": float(own["smoothness"].mean()),
                "clearance": float(own["clearance"].min()),
            }
            lines.append(own["pose"][:, :2])
            smoothness.append(own["smoothness"])
            for key, active in own.items():
                if key.startswith("steps_"):
                    row |= {key: int(active.sum()), f"reward_{key[6:]}": (active * own["reward"]).sum()}
        episodes.append(row)
    return EvaluationResult(episodes, lines, smoothness, rate)


def summarise(episodes: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the means of each track in the order of the episodes, then their mean as the track `mean`.

    `completed` and `crashed` become shares, `lap_time` is the mean of the episodes that have one, and `clearance` the
    minimum. With tasks, `per_step_TASK` is the mean reward of a step in a task, over all steps on a track.
    """
    tracks = {episode["track"]: [e for e in episodes if e["track"] == episode["track"]] for episode in episodes}
    rows = [_mean(track, group) | _per_step(group) for track, group in tracks.items()]
    tasks = {key: _nan_mean([row[key] for row in rows]) for key in rows[0] if key.startswith(PER_STEP)}
    return [*rows, _mean("mean", rows) | tasks]


def _per_step(episodes: Sequence[dict[str, Any]]) -> dict[str, float]:
    means = {}
    for task in (key.removeprefix("steps_") for key in episodes[0] if key.startswith("steps_")):
        steps, reward = (sum(row[f"{key}_{task}"] for row in episodes) for key in ("steps", "reward"))
        means[f"{PER_STEP}{task}"] = reward / steps if steps else float("nan")
    return means


def _nan_mean(values: Sequence[float]) -> float:
    numbers = [value for value in values if not np.isnan(value)]
    return float(np.mean(numbers)) if numbers else float("nan")


def _mean(track: str, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    columns = {key: np.array([row[key] for row in rows], dtype=float) for key in MEASURES}
    means = {key: float(values.mean()) for key, values in columns.items()}
    means |= {"lap_time": _nan_mean([row["lap_time"] for row in rows])}
    return {"track": track, **means, "clearance": float(columns["clearance"].min())}
