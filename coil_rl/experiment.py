"""The loop of a run: collect, update, log, keep the best policy, checkpoint."""

from __future__ import annotations

import csv
import math
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from tqdm import tqdm

from coil_rl import checkpoint
from coil_rl.rollout import Rollout


class Learner(Protocol):
    """What turns batches into a better policy."""

    policy: TensorDictModuleBase

    def update(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        """Learn from a batch [B, T]; returns what is worth logging."""

    def state_dict(self) -> dict[str, Any]:
        """Everything the next update depends on besides its batch."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over a state of `state_dict`."""


class Experiment:
    """One training run in one folder.

    It leaves there `metrics.csv` (one row an update), `checkpoint.pt` (everything a later process needs to go on),
    `policy_best.pt` and `policy_last.pt`.

    Args:
        learner: learns.
        rollout: collects; its env must write `episode_reward` (TorchRL's RewardSum).
        frames: length of the run; the last batch may go beyond it.
        folder: exists.
        logger: any TorchRL logger, besides the CSV.
        watch: name to key of entries logged as means over finished episodes ("episode") or over all steps ("step").
        checkpoint_every: updates between two checkpoints.
    """

    EPISODES = 100  # the return is a mean over so many finished episodes

    def __init__(
        self,
        learner: Learner,
        rollout: Rollout,
        frames: int,
        folder: Path,
        *,
        logger: Any | None = None,
        watch: Mapping[str, Mapping[str, Sequence[str]]] | None = None,
        checkpoint_every: int = 10,
    ) -> None:
        self.learner, self.rollout, self.frames, self.folder = learner, rollout, frames, folder
        self.logger, self.checkpoint_every = logger, checkpoint_every
        watch = watch or {}
        self.watch_episode = {name: ("next", *key) for name, key in watch.get("episode", {}).items()}
        self.watch_step = {name: ("next", *key) for name, key in watch.get("step", {}).items()}
        self.updates = 0
        self.best = -math.inf
        self.returns: deque[float] = deque(maxlen=self.EPISODES)

    def run(self, guide_return: float | None = None) -> list[dict[str, float]]:
        """Train to the end and return the rows of `metrics.csv`.

        Args:
            guide_return: shown beside the agent's, to compare.
        """
        rows: list[dict[str, float]] = []
        updates = math.ceil(self.frames / self.rollout.frames)
        with tqdm(total=updates * self.rollout.frames, unit="frame", unit_scale=True, desc="train") as bar:
            while self.updates < updates:
                rows.append(self.update(self.updates / updates))
                bar.update(self.rollout.frames)
                shown = {"return": f"{rows[-1]['train/return']:.0f}"}
                if guide_return is not None:
                    shown["guide"] = f"{guide_return:.0f}"
                bar.set_postfix(shown)
                self._write_row(rows[-1])
                if self.updates % self.checkpoint_every == 0 or self.updates == updates:
                    checkpoint.save(self.state_dict(), self.folder / "checkpoint.pt")
        checkpoint.save(self.learner.policy.state_dict(), self.folder / "policy_last.pt")
        if not (self.folder / "policy_best.pt").exists():
            checkpoint.save(self.learner.policy.state_dict(), self.folder / "policy_best.pt")
        return rows

    def update(self, progress: float) -> dict[str, float]:
        """Collect one batch and learn from it; returns the row for the log."""
        batch = self.rollout.collect()
        row = self._describe(batch)
        if len(self.returns) == self.EPISODES and row["train/return"] > self.best:
            # The policy that collected this batch, not the one that learned from it.
            self.best = row["train/return"]
            checkpoint.save(self.learner.policy.state_dict(), self.folder / "policy_best.pt")
        row |= {f"learner/{name}": value for name, value in self.learner.update(batch, progress).items()}
        self.updates += 1
        return {"frames": self.updates * self.rollout.frames, **row}

    def _describe(self, batch: TensorDictBase) -> dict[str, float]:
        after = batch["next"]
        done = after["done"]
        self.returns.extend(after["episode_reward"][done].tolist())
        row = {
            "train/return": sum(self.returns) / len(self.returns) if self.returns else math.nan,
            "train/episodes": float(done.sum()),
            "train/reward": float(after["reward"].mean()),
        }
        for name, key in self.watch_episode.items():
            row[f"train/{name}"] = float(batch[key][done].float().mean()) if row["train/episodes"] else math.nan
        for name, key in self.watch_step.items():
            row[f"train/{name}"] = float(batch[key].float().mean())
        return row

    def _write_row(self, row: dict[str, float]) -> None:
        path = self.folder / "metrics.csv"
        first = not path.exists()
        with path.open("a", newline="") as file:
            writer = csv.DictWriter(file, list(row))
            if first:
                writer.writeheader()
            writer.writerow(row)
        if self.logger is not None:
            for name, value in row.items():
                self.logger.log_scalar(name, value, step=int(row["frames"]))

    def state_dict(self) -> dict[str, Any]:
        """Everything the rest of the run depends on."""
        return {
            "learner": self.learner.state_dict(),
            "rollout": self.rollout.state_dict(),
            "updates": self.updates,
            "best": self.best,
            "returns": list(self.returns),
            "torch_rng": torch.get_rng_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from a state of `state_dict`."""
        self.learner.load_state_dict(state["learner"])
        self.rollout.load_state_dict(state["rollout"])
        self.updates, self.best = state["updates"], state["best"]
        self.returns = deque(state["returns"], maxlen=self.EPISODES)
        torch.set_rng_state(state["torch_rng"])


def watched_keys(watch: Mapping[str, Mapping[str, Sequence[str]]]) -> list[NestedKey]:
    """The entries that a rollout must keep for `Experiment`."""
    return [tuple(key) for group in watch.values() for key in group.values()]
