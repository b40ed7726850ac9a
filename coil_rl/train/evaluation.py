"""Drives a policy until every row of an env has finished one episode, and measures how it went."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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

MEASURES = ("reward", "lap_time", "smoothness", "completed", "crashed", "clearance")
PER_STEP = "per_step_"  # and the name of a task


@dataclass(frozen=True)
class EvaluationResult:
    """What a policy did.

    Attributes:
        episodes: one row per car: `track`, `reward` (sum), `steps`, `lap_time` s (mean of the completed laps, NaN
            without one), `laps`, `completed`, `crashed`, `smoothness` (mean |a - a_avg|) and `clearance` m (smallest).
            An env without `info` gives `reward` and `steps` only, one that says under `info` in which `task` a step was
            paid also `steps_TASK` and `reward_TASK`, the parts that fell to each.
        lines: the positions of each car, [steps, 2] m.
        smoothness: |a - a_avg| of each car at each of these, [steps].
    """

    episodes: list[dict[str, Any]]
    lines: list[NDArray[np.float64]]
    smoothness: list[NDArray[np.float64]]

    @property
    def mean_reward(self) -> float:
        """Of an episode."""
        return float(sum(episode["reward"] for episode in self.episodes) / len(self.episodes))

    def split(self, parts: int) -> list[EvaluationResult]:
        """As many drives, of equally many cars each, in their order."""
        size = len(self.episodes) // parts
        return [self[end - size : end] for end in range(size, len(self.episodes) + 1, size)]

    def __getitem__(self, cars: slice) -> EvaluationResult:
        """The drive of some cars."""
        return EvaluationResult(self.episodes[cars], self.lines[cars], self.smoothness[cars])


@torch.no_grad()
def evaluate_policy(
    env: EnvBase,
    policy: TensorDictModuleBase,
    *,
    sampled: bool | Tensor = False,
    names: Sequence[str] = (),
    tick: Callable[[], Any] | None = None,
) -> EvaluationResult:
    """One episode of every row of the env.

    Args:
        env: batched env, [B]; its transforms go into evaluation mode.
        policy: writes the action.
        sampled: draw actions instead of taking the deterministic one; bool [B] for which rows.
        names: of the tracks.
        tick: called every step.
    """
    history: list[dict[str, Tensor]] = []
    carrier = env.eval().reset()
    running = torch.ones_like(env.full_done_spec["done"].zero())
    while True:
        step = env.step(_act(policy, carrier, sampled))
        history.append(_notes(step["next"]) | {"running": running})
        running = running & ~step["next", "done"]
        # To ask costs a wait for the device.
        if len(history) % 8 == 0 and not running.any():
            break
        carrier = env.step_mdp(step)
        if tick is not None:
            tick()
    notes = {key: torch.stack([row[key] for row in history]).squeeze(-1).cpu().double().numpy() for key in history[0]}
    return _measure(notes, names)


def _act(policy: TensorDictModuleBase, carrier: TensorDictBase, sampled: bool | Tensor) -> TensorDictBase:
    if isinstance(sampled, Tensor):
        drawn = _act(policy, carrier, True)["action"]
        taken = _act(policy, carrier, False)
        return taken.set("action", torch.where(expand_as_right(sampled, drawn), drawn, taken["action"]))
    with set_exploration_type(ExplorationType.RANDOM if sampled else ExplorationType.DETERMINISTIC):
        return policy(carrier)


def _notes(after: TensorDictBase) -> dict[str, Tensor]:
    notes = {"reward": after["reward"]}
    if "info" in after:
        info = after["info"]
        notes |= {key: info[key] for key in ("track", "lap_time", "crashed", "clearance", "smoothness", "pose")}
        notes["finished"] = after["terminated"] & ~info["crashed"]
        if "task" in info:
            notes |= {f"steps_{name}": paid for name, paid in info["task"].items()}
    return notes


def _measure(notes: dict[str, NDArray[np.float64]], names: Sequence[str]) -> EvaluationResult:
    running = notes["running"].astype(bool)
    episodes, lines, smoothness = [], [], []
    for car, on in enumerate(running.T):
        row: dict[str, Any] = {"reward": notes["reward"][on, car].sum(), "steps": int(on.sum())}
        if "track" in notes:
            track = int(notes["track"][0, car])
            laps = notes["lap_time"][on, car]
            laps = laps[laps > 0]
            row |= {
                "track": names[track] if names else str(track),
                "laps": len(laps),
                "lap_time": float(laps.mean()) if len(laps) else float("nan"),
                "completed": bool(notes["finished"][on, car].any()),
                "crashed": bool(notes["crashed"][on, car].any()),
                "smoothness": float(notes["smoothness"][on, car].mean()),
                "clearance": float(notes["clearance"][on, car].min()),
            }
            lines.append(notes["pose"][on, car, :2])
            smoothness.append(notes["smoothness"][on, car])
            for key in notes:
                if key.startswith("steps_"):
                    paid = notes[key][on, car]
                    row |= {key: int(paid.sum()), f"reward_{key[6:]}": (paid * notes["reward"][on, car]).sum()}
        episodes.append(row)
    return EvaluationResult(episodes, lines, smoothness)


def summarise(episodes: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Means per track in the order they come, then the mean over tracks as the row `mean`.

    `completed` and `crashed` become shares, `lap_time` is over the episodes that have one, and `clearance` is the
    smallest of all. Where there are tasks, `per_step_TASK` is the reward of a step in it, over all steps of a track.
    """
    tracks = {episode["track"]: [e for e in episodes if e["track"] == episode["track"]] for episode in episodes}
    rows = [_mean(track, alike) | _per_step(alike) for track, alike in tracks.items()]
    tasks = {key: _mean_of_known([row[key] for row in rows]) for key in rows[0] if key.startswith(PER_STEP)}
    return [*rows, _mean("mean", rows) | tasks]


def _per_step(episodes: Sequence[dict[str, Any]]) -> dict[str, float]:
    tasks = [key.removeprefix("steps_") for key in episodes[0] if key.startswith("steps_")]
    steps = {task: sum(row[f"steps_{task}"] for row in episodes) for task in tasks}
    paid = {task: sum(row[f"reward_{task}"] for row in episodes) for task in tasks}
    return {f"{PER_STEP}{task}": paid[task] / steps[task] if steps[task] else float("nan") for task in tasks}


def _mean_of_known(values: Sequence[float]) -> float:
    known = [value for value in values if not np.isnan(value)]
    return float(np.mean(known)) if known else float("nan")


def _mean(track: str, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    columns = {key: np.array([row[key] for row in rows], dtype=float) for key in MEASURES}
    means = {key: float(values.mean()) for key, values in columns.items()}
    means |= {"lap_time": _mean_of_known([row["lap_time"] for row in rows])}
    return {"track": track, **means, "clearance": float(columns["clearance"].min())}
