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
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

MEASURES = ("reward", "lap_time", "smoothness", "completed", "crashed", "clearance")


@dataclass(frozen=True)
class Drive:
    """What a policy did.

    Attributes:
        episodes: one row per car: `track`, `reward` (sum), `steps`, `lap_time` s (mean of the completed laps, NaN
            without one), `laps`, `completed`, `crashed`, `smoothness` (mean |a - a_avg|) and `clearance` m (smallest).
            An env without `info` gives `reward` and `steps` only.
        lines: the positions of each car, [steps, 2] m.
    """

    episodes: list[dict[str, Any]]
    lines: list[NDArray[np.float64]]

    @property
    def mean_reward(self) -> float:
        """Of an episode."""
        return float(sum(episode["reward"] for episode in self.episodes) / len(self.episodes))

    def split(self, parts: int) -> list[Drive]:
        """As many drives, of equally many cars each, in their order."""
        size = len(self.episodes) // parts
        ends = range(size, len(self.episodes) + 1, size)
        return [Drive(self.episodes[end - size : end], self.lines[end - size : end]) for end in ends]


@torch.no_grad()
def drive(
    env: EnvBase,
    policy: TensorDictModuleBase,
    *,
    sampled: bool = False,
    names: Sequence[str] = (),
    tick: Callable[[], Any] | None = None,
) -> Drive:
    """One episode of every row of the env.

    Args:
        env: batched env, [B]; its transforms go into evaluation mode.
        policy: writes the action.
        sampled: draw actions instead of taking the deterministic one.
        names: of the tracks.
        tick: called every step.
    """
    history: list[dict[str, Tensor]] = []
    carrier = env.eval().reset()
    running = torch.ones_like(env.full_done_spec["done"].zero())
    mode = ExplorationType.RANDOM if sampled else ExplorationType.DETERMINISTIC
    with set_exploration_type(mode):
        while True:
            step = env.step(policy(carrier))
            history.append(_notes(step["next"]) | {"running": running})
            running = running & ~step["next", "done"]
            # To ask costs a wait for the device.
            if len(history) % 8 == 0 and not running.any():
                break
            carrier = step_mdp(step)
            if tick is not None:
                tick()
    notes = {key: torch.stack([row[key] for row in history]).squeeze(-1).cpu().double().numpy() for key in history[0]}
    return _measure(notes, names)


def _notes(after: TensorDictBase) -> dict[str, Tensor]:
    notes = {"reward": after["reward"]}
    if "info" in after:
        info = after["info"]
        notes |= {key: info[key] for key in ("track", "lap_time", "crashed", "clearance", "smoothness", "pose")}
        notes["finished"] = after["terminated"] & ~info["crashed"]
    return notes


def _measure(notes: dict[str, NDArray[np.float64]], names: Sequence[str]) -> Drive:
    running = notes["running"].astype(bool)
    episodes, lines = [], []
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
        episodes.append(row)
    return Drive(episodes, lines)


def summarise(episodes: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Means per track in the order they come, then the mean over tracks as the row `mean`.

    `completed` and `crashed` become shares, `lap_time` is over the episodes that have one, and `clearance` is the
    smallest of all.
    """
    tracks = list(dict.fromkeys(episode["track"] for episode in episodes))
    rows = [_mean(track, [e for e in episodes if e["track"] == track]) for track in tracks]
    return [*rows, _mean("mean", rows)]


def _mean(track: str, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    columns = {key: np.array([row[key] for row in rows], dtype=float) for key in MEASURES}
    measured = columns["lap_time"][~np.isnan(columns["lap_time"])]
    means = {key: float(values.mean()) for key, values in columns.items()}
    means |= {"lap_time": float(measured.mean()) if len(measured) else float("nan")}
    return {"track": track, **means, "clearance": float(columns["clearance"].min())}
