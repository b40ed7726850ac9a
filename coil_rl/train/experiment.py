"""The training loop: collect a batch, update, log, keep and judge policies, save checkpoints."""

import csv
import io
import math
import os
import shutil
import sys
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import KW_ONLY, dataclass, field
from operator import itemgetter
from pathlib import Path
from typing import Any, ClassVar

import pandas as pd
import torch
from tensordict import NestedKey, TensorDictBase
from torchrl.envs import EnvBase
from tqdm import tqdm

from coil_rl.errors import UserError, file_of_a_run
from coil_rl.files import whole_file
from coil_rl.learners.learner import Callback, Learner
from coil_rl.report.runs import CHOICE, RETURN, read_curve
from coil_rl.train import checkpoint
from coil_rl.train.curve import EvaluationCurve, Watch
from coil_rl.train.rollout import Rollout
from coil_rl.train.run_folder import check_same

REMEDY = "put the whole file back, or train again in another folder"  # for a damaged log


@dataclass(eq=False)
class Experiment:
    """One training run in one folder.

    Files: `metrics.csv` (a row for the state before the first update and after each update),
    `checkpoint.pt` (the complete state), `checkpoint_previous.pt`, `policy_last.pt`,
    `policy_best.pt` (best evaluation; the last one without evaluations) and `policies/` (the kept
    ones). A run that was killed at any moment and resumed in a new process ends with the same
    files, to the bit on a CPU.
    """

    EPISODES: ClassVar[int] = 100  # the return is the mean over this many finished episodes

    learner: Learner
    # Its env must write `episode_reward` (TorchRL's RewardSum), and `task_reward` if a transform
    # adds to the reward of the task.
    rollout: Rollout
    frames: int  # length of the run; the last batch may exceed it
    folder: Path  # exists
    _: KW_ONLY
    logger: Any | None = None  # any TorchRL logger, in addition to the CSV file
    # Further entries to log, as means over finished episodes ("episode") or over all steps
    # ("step").
    watch: Watch = field(default_factory=dict)
    checkpoint_every: int = 10  # updates between two checkpoints
    callbacks: Sequence[Callback] = ()
    curve: EvaluationCurve | None = None  # drives the kept policies
    # Values of the configuration, which a checkpoint keeps and a resumed run must have.
    identity: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.metrics = Metrics(self.folder / "metrics.csv", self.logger)
        self.updates = 0
        self.returns: deque[float] = deque(maxlen=self.EPISODES)
        self.rows: list[dict[str, float]] = []

    def resume(self) -> None:
        """Continue from the last intact checkpoint of the folder, or from the beginning if there is none yet."""
        state = checkpoint.load_newest(self.folder)
        if state is not None:
            newest = self.folder / checkpoint.NEWEST
            remedy = "put the files of the run back, or train again in another folder"
            with file_of_a_run(newest, remedy):
                check_same(state["identity"], self.identity, f"{newest} belongs to a run", remedy)
                self.load_state_dict(state)
        self.rows = self.metrics.truncate(self.updates + 1 if self.updates else 0)
        lacking = [
            name
            for name in (self.curve.names if self.curve else [])
            if self.rows and name not in self.rows[0]
        ]
        if lacking:
            raise UserError(f"{self.metrics.path} has no column {lacking[0]}; {REMEDY}")
        where = (
            f"after update {self.updates}"
            if self.updates
            else "from the beginning: there is no checkpoint yet"
        )
        print(f"{self.folder} continues {where}", file=sys.stderr)

    def run(self, guide_return: float | None = None) -> list[dict[str, float]]:
        """Train to the end and return the rows of `metrics.csv`; `guide_return` is shown beside the agent's.

        NaN from the env, in the losses or in the weights is a `UserError`.
        """
        updates, frames = math.ceil(self.frames / self.rollout.frames), self.rollout.frames
        with tqdm(
            total=updates * frames,
            initial=self.updates * frames,
            unit="frame",
            unit_scale=True,
            desc="train",
        ) as bar:
            first = self._call_back(updates, {}) if self.updates == 0 else {}
            evaluated = self._newest_evaluation()
            while True:
                if self._evaluate(updates):
                    evaluated = self._newest_evaluation()
                if self.updates == updates:
                    break
                row = self.update(self.updates / updates)
                row |= self._call_back(updates, row)
                if not self.rows:
                    self._log({**dict.fromkeys(row, math.nan), "frames": 0, **first})
                self._log(row)
                bar.update(frames)
                returns = {
                    "return": row["train/return"],
                    "evaluation": evaluated,
                    "guide": guide_return,
                }
                bar.set_postfix(
                    {name: f"{value:.0f}" for name, value in returns.items() if value is not None}
                )
                if self.updates % self.checkpoint_every == 0 or self.updates == updates:
                    self._save()
        policy = self.learner.policy.state_dict()
        checkpoint.save(policy, self.folder / "policy_last.pt")
        if self.curve is None:
            checkpoint.save(policy, self.folder / "policy_best.pt")
        return self.rows

    def _log(self, row: dict[str, float]) -> None:
        self.rows.append(row)
        self.metrics.append(row)

    def _newest_evaluation(self) -> float | None:
        """Return the return of the last policy that has been evaluated, None before the first one."""
        returns = (row.get(RETURN, math.nan) for row in reversed(self.rows))
        return next((value for value in returns if not math.isnan(value)), None)

    def _evaluate(self, updates: int) -> bool:
        """Keep the policy, and drive the kept ones, if it is time; return whether any were driven."""
        if self.curve is None:
            return False
        if self.updates in self.curve.kept(updates):
            self.curve.keep(self.updates * self.rollout.frames)
        batch = self.curve.batch(self.updates, updates)
        if not batch or not math.isnan(self.rows[batch[-1]][RETURN]):
            return False
        frames = [update * self.rollout.frames for update in batch]
        results = dict(zip(batch, self.curve.drive(frames), strict=True))
        for update, result in results.items():
            self.rows[update] |= result
            self.metrics.log(result, update * self.rollout.frames)
        judged = (row for row in self.rows if not math.isnan(row[CHOICE]))
        with whole_file(self.folder / "policy_best.pt") as unfinished:
            shutil.copyfile(
                self.curve.file(int(max(judged, key=itemgetter(CHOICE))["frames"])), unfinished
            )
        self.metrics.fill(results)
        return True

    def update(self, progress: float) -> dict[str, float]:
        """Collect one batch, learn from it and return the row of the log."""
        with self._resume_hint():
            batch = self.rollout.collect(progress)
        row = dict.fromkeys(self.curve.names if self.curve else [], math.nan) | self._describe(
            batch
        )
        learned = {
            f"learner/{name}": value for name, value in self.learner.update(batch, progress).items()
        }
        self.updates += 1
        with self._resume_hint():
            for name, value in learned.items():
                if not math.isfinite(value):
                    raise UserError(f"{name} is {value} in update {self.updates}")
        return {"frames": self.updates * self.rollout.frames, **row, **learned}

    def _call_back(self, updates: int, row: Mapping[str, float]) -> dict[str, float]:
        """Return the numbers of the callbacks, NaN where one is not due."""
        numbers: dict[str, float] = {}
        for callback in self.callbacks:
            if callback.due(self.updates, updates, row):
                numbers |= callback.after_update(self.updates)
            else:
                numbers |= dict.fromkeys(callback.names, math.nan)
        return numbers

    @contextmanager
    def _resume_hint(self) -> Iterator[None]:
        try:
            yield
        except UserError as error:
            remedy = f"correct the cause and continue with coil-train resume={self.folder}"
            kept = "the last good checkpoint is kept"
            raise UserError(
                f"{error}; {kept}: {remedy}, or train again with other values"
            ) from error

    def _save(self) -> None:
        state = self.state_dict()
        with self._resume_hint():
            check_parameters(state["learner"], self.updates)
        self.metrics.flush()
        checkpoint.save_newest(state, self.folder)

    def _describe(self, batch: TensorDictBase) -> dict[str, float]:
        after = batch["next"]
        done = after["done"]
        self.returns.extend(after["episode_reward"][done].tolist())
        row = {
            "train/return": sum(self.returns) / len(self.returns) if self.returns else math.nan,
            "train/episodes": float(done.sum()),
            "train/reward": float(
                after["task_reward" if "task_reward" in after else "reward"].mean()
            ),
        }
        for name, key in self.watch.get("episode", {}).items():
            row[f"train/{name}"] = (
                float(after[tuple(key)][done].float().mean()) if done.any() else math.nan
            )
        for name, key in self.watch.get("step", {}).items():
            row[f"train/{name}"] = float(after[tuple(key)].float().mean())
        return row

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the rest of the run depends on."""
        return {
            "learner": self.learner.state_dict(),
            "rollout": self.rollout.state_dict(),
            "identity": self.identity,
            "updates": self.updates,
            "returns": list(self.returns),
            "torch_rng": torch.get_rng_state(),
            "cuda_rng": torch.cuda.get_rng_state_all() if torch.cuda.is_initialized() else [],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state that `state_dict` returned."""
        self.learner.load_state_dict(state["learner"])
        self.rollout.load_state_dict(state["rollout"])
        self.updates = state["updates"]
        self.returns = deque(state["returns"], maxlen=self.EPISODES)
        torch.set_rng_state(state["torch_rng"])
        if state["cuda_rng"]:
            torch.cuda.set_rng_state_all(state["cuda_rng"])


def watched_keys(env: EnvBase, watch: Watch) -> list[NestedKey]:
    """Return the entries that `Experiment` needs in a rollout, besides those of the learner."""
    watched = (tuple(key) for group in watch.values() for key in group.values())
    task = [("task_reward",)] if "task_reward" in env.observation_spec else []
    return [
        ("next", *key) for key in (("done",), ("reward",), ("episode_reward",), *task, *watched)
    ]


def check_parameters(state: Any, update: int, name: str = "learner") -> None:
    """Raise a `UserError` if a tensor of a nested state holds NaN; bounds may be infinite."""
    if isinstance(state, Mapping):
        for key, value in state.items():
            check_parameters(value, update, f"{name}/{key}")
    elif isinstance(state, torch.Tensor) and state.is_floating_point() and state.isnan().any():
        raise UserError(f"{name} is nan after update {update}")


class Metrics:
    """Log of a run: rows in a CSV file and in any TorchRL logger.

    After a resume the rows since the checkpoint are written again. They are removed from the CSV
    file and from TensorBoard first; other loggers may show a point twice, with the same value.
    """

    def __init__(self, path: Path, logger: Any | None = None) -> None:
        self.path, self.logger = path, logger
        writer = getattr(logger, "experiment", None)
        self.tensorboard: Any | None = writer if hasattr(writer, "purge_step") else None

    def append(self, row: dict[str, float]) -> None:
        """Log a row; `frames` is the step of the logger."""
        first = not self.path.exists()
        with self.path.open("a", newline="") as file:
            writer = csv.DictWriter(file, list(row))
            if first:
                writer.writeheader()
            writer.writerow(row)
        self.log(row, int(row["frames"]))

    def log(self, values: Mapping[str, float], frames: int) -> None:
        """Log values with the TorchRL logger, if there is one; NaN is left out."""
        for name, value in values.items() if self.logger is not None else ():
            if not math.isnan(value):
                self.logger.log_scalar(name, value, step=frames)  # type: ignore[union-attr]

    def fill(self, results: Mapping[int, Mapping[str, float]]) -> None:
        """Put values into rows, by their numbers, of the CSV file; the other cells keep their text."""
        rows = pd.read_csv(self.path, dtype=str, keep_default_na=False)
        for number, values in results.items():
            rows.loc[number, list(values)] = list(map(str, values.values()))
        with whole_file(self.path) as unfinished:
            rows.to_csv(unfinished, index=False, lineterminator="\r\n")

    def flush(self) -> None:
        """Wait until all rows are on the disk."""
        if self.path.exists():
            with self.path.open("a") as file:
                os.fsync(file.fileno())
        if self.tensorboard is not None:
            self.tensorboard.flush()

    def truncate(self, count: int) -> list[dict[str, float]]:
        """Remove all rows except the first ones and return these; raise a `UserError` if there are fewer."""
        lines = self.path.read_bytes().splitlines(keepends=True) if self.path.exists() else []
        if len(lines) <= count and count:
            found = f"{max(len(lines) - 1, 0)} of the {count} rows that belong to the checkpoint"
            raise UserError(f"{self.path} has {found}; {REMEDY}")
        rows: list[dict[str, float]] = []
        if count:
            kept = b"".join(lines[: count + 1])
            with file_of_a_run(self.path, REMEDY):
                rows = read_curve(io.BytesIO(kept))
            with whole_file(self.path) as unfinished:
                unfinished.write_bytes(kept)
        else:
            self.path.unlink(missing_ok=True)
        if self.logger is not None and self.tensorboard is not None:
            self.tensorboard.close()
            frames = int(rows[-1]["frames"]) if rows else 0
            self.tensorboard = type(self.tensorboard)(
                self.tensorboard.log_dir, purge_step=frames + 1
            )
            self.logger.experiment = self.tensorboard
        return rows
