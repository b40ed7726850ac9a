"""The loop of a run: collect, update, log, keep the best policy, checkpoint."""

from __future__ import annotations

import math
import sys
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar, Protocol

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torchrl.envs import EnvBase
from tqdm import tqdm

from coil_rl.errors import UserError
from coil_rl.train import checkpoint
from coil_rl.train.finite import check_losses, check_state
from coil_rl.train.metrics import Metrics
from coil_rl.train.rollout import Rollout


class Learner(Protocol):
    """Update of a policy from batches.

    Attributes:
        kind: "agent" (learns from rewards), "imitation" (from a guide's actions) or "guides" (trains guides too).
        policy: the policy that collects the batches.
    """

    kind: ClassVar[str]
    policy: TensorDictModuleBase

    def update(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        """Learn from a batch [B, T]; returns what is worth logging."""

    def state_dict(self) -> dict[str, Any]:
        """Everything the next update depends on besides its batch."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over a state of `state_dict`."""


class Probe(Protocol):
    """What is measured now and then, because it takes long.

    Attributes:
        each_phase: whether it is measured each time that the learner says `guides_changed`.
    """

    each_phase: bool

    @property
    def unknown(self) -> dict[str, float]:
        """NaN under each name that a call gives."""

    def __call__(self) -> dict[str, float]:
        """Measure."""


class Experiment:
    """One training run in one folder.

    It leaves there `metrics.csv` (one row an update), `checkpoint.pt` (everything a later process needs to go on),
    `checkpoint_previous.pt` (the one before it), `policy_best.pt` and `policy_last.pt`. After `resume` in a new process
    it ends on a CPU with the same files, to the bit, wherever the process before it was killed.

    Args:
        learner: learns.
        rollout: collects; its env must write `episode_reward` (TorchRL's RewardSum). Where something is added to the
            reward for learning only, the env must write the task's as `task_reward`.
        frames: length of the run; the last batch may go beyond it.
        folder: exists.
        logger: any TorchRL logger, besides the CSV.
        watch: name to key of entries logged as means over finished episodes ("episode") or over all steps ("step").
        checkpoint_every: updates between two checkpoints.
        probe: looks at what learns besides the agent before the first update, at the end and, if it asks for it, when
            the learner says `guides_changed`.
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
        probe: Probe | None = None,
    ) -> None:
        self.learner, self.rollout, self.frames, self.folder = learner, rollout, frames, folder
        self.metrics, self.checkpoint_every = Metrics(folder / "metrics.csv", logger), checkpoint_every
        self.probe = probe
        watch = watch or {}
        self.watch_episode = {name: ("next", *key) for name, key in watch.get("episode", {}).items()}
        self.watch_step = {name: ("next", *key) for name, key in watch.get("step", {}).items()}
        self.updates = 0
        self.best = -math.inf
        self.returns: deque[float] = deque(maxlen=self.EPISODES)
        self.rows: list[dict[str, float]] = []

    def resume(self) -> None:
        """Go on where the folder's last whole checkpoint was written, or from the beginning if there is none.

        Raises:
            UserError: if no checkpoint there can be used, or rows of `metrics.csv` are gone.
        """
        state = checkpoint.load_newest(self.folder)
        if state is not None:
            self.load_state_dict(state)
        self.rows = self.metrics.keep(self.updates)
        where = f"after update {self.updates}" if self.updates else "from the beginning: there is no checkpoint yet"
        print(f"{self.folder} goes on {where}", file=sys.stderr)

    def run(self, guide_return: float | None = None) -> list[dict[str, float]]:
        """Train to the end and return the rows of `metrics.csv`.

        Args:
            guide_return: shown beside the agent's, to compare.

        Raises:
            UserError: at the first number from the env, the losses or the weights that is NaN.
        """
        updates, frames = math.ceil(self.frames / self.rollout.frames), self.rollout.frames
        with tqdm(
            total=updates * frames, initial=self.updates * frames, unit="frame", unit_scale=True, desc="train"
        ) as bar:
            while self.updates < updates:
                before = self._probed(self.updates == 0)
                row = self.update(self.updates / updates)
                changed = self.probe is not None and self.probe.each_phase and row["learner/guides_changed"]
                after = self._probed(self.updates == updates or bool(changed))
                row |= {name: before[name] if math.isnan(value) else value for name, value in after.items()}
                self.rows.append(row)
                self.metrics.append(row)
                bar.update(frames)
                shown = {"return": f"{row['train/return']:.0f}"}
                if guide_return is not None:
                    shown["guide"] = f"{guide_return:.0f}"
                bar.set_postfix(shown)
                if self.updates % self.checkpoint_every == 0 or self.updates == updates:
                    self._save()
        policy = self.learner.policy.state_dict()
        checkpoint.save(policy, self.folder / "policy_last.pt")
        if self.best == -math.inf:
            checkpoint.save(policy, self.folder / "policy_best.pt")
        return self.rows

    def update(self, progress: float) -> dict[str, float]:
        """Collect one batch and learn from it; returns the row for the log."""
        with self._saying_how_to_go_on():
            batch = self.rollout.collect(progress)
        row = self._describe(batch)
        if len(self.returns) == self.EPISODES and row["train/return"] > self.best:
            # The policy that collected this batch, not the one that learned from it.
            self.best = row["train/return"]
            checkpoint.save(self.learner.policy.state_dict(), self.folder / "policy_best.pt")
        learned = {f"learner/{name}": value for name, value in self.learner.update(batch, progress).items()}
        self.updates += 1
        with self._saying_how_to_go_on():
            check_losses(learned, self.updates)
        return {"frames": self.updates * self.rollout.frames, **row, **learned}

    def _probed(self, due: bool) -> dict[str, float]:
        if self.probe is None:
            return {}
        return self.probe() if due else self.probe.unknown

    @contextmanager
    def _saying_how_to_go_on(self) -> Iterator[None]:
        try:
            yield
        except UserError as error:
            raise UserError(
                f"{error}; the last good checkpoint is kept: mend the cause and go on with "
                f"coil-train resume={self.folder}, or train again with other values"
            ) from error

    def _save(self) -> None:
        state = self.state_dict()
        with self._saying_how_to_go_on():
            check_state(state["learner"], self.updates)
        self.metrics.flush()
        checkpoint.save_newest(state, self.folder)

    def _describe(self, batch: TensorDictBase) -> dict[str, float]:
        after = batch["next"]
        done = after["done"]
        self.returns.extend(after["episode_reward"][done].tolist())
        row = {
            "train/return": sum(self.returns) / len(self.returns) if self.returns else math.nan,
            "train/episodes": float(done.sum()),
            "train/reward": float(after["task_reward" if "task_reward" in after else "reward"].mean()),
        }
        for name, key in self.watch_episode.items():
            row[f"train/{name}"] = float(batch[key][done].float().mean()) if row["train/episodes"] else math.nan
        for name, key in self.watch_step.items():
            row[f"train/{name}"] = float(batch[key].float().mean())
        return row

    def state_dict(self) -> dict[str, Any]:
        """Everything the rest of the run depends on."""
        return {
            "learner": self.learner.state_dict(),
            "rollout": self.rollout.state_dict(),
            "updates": self.updates,
            "best": self.best,
            "returns": list(self.returns),
            "torch_rng": torch.get_rng_state(),
            "cuda_rng": torch.cuda.get_rng_state_all() if torch.cuda.is_initialized() else [],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from a state of `state_dict`."""
        self.learner.load_state_dict(state["learner"])
        self.rollout.load_state_dict(state["rollout"])
        self.updates, self.best = state["updates"], state["best"]
        self.returns = deque(state["returns"], maxlen=self.EPISODES)
        torch.set_rng_state(state["torch_rng"])
        if state["cuda_rng"]:
            torch.cuda.set_rng_state_all(state["cuda_rng"])


def watched_keys(env: EnvBase, watch: Mapping[str, Mapping[str, Sequence[str]]]) -> list[NestedKey]:
    """The entries that a rollout must keep for `Experiment`, besides those of the learner."""
    watched = (tuple(key) for group in watch.values() for key in group.values())
    task = [("task_reward",)] if "task_reward" in env.observation_spec else []
    return [("next", *key) for key in (("done",), ("reward",), ("episode_reward",), *task, *watched)]
