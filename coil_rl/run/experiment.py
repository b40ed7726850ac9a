"""The training loop: collect a batch, learn from it, log, and let the callbacks act."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from coil_rl.compiled import compile_steps
from coil_rl.errors import UserError, is_outside
from coil_rl.learners.anchor import rest_guides
from coil_rl.learners.learner import Callback, Stateful
from coil_rl.output import decoration, progress, say
from coil_rl.report.runs import EVALUATION
from coil_rl.report.table import return_format
from coil_rl.run import checkpoint
from coil_rl.run.cases import TrainingCases, guide_calls
from coil_rl.run.curve import EvaluationCurve, Watch
from coil_rl.run.delivery import Delivery
from coil_rl.run.folder import weights_file
from coil_rl.run.metrics import Metrics
from coil_rl.run.parts import TESTS
from coil_rl.run.reasons import start_test
from coil_rl.run.rollout import Rollout
from coil_rl.run.stopping import STOP
from coil_rl.transforms.normalised_action import given_units, units_of

if TYPE_CHECKING:
    from coil_rl.run.run import Run

REST = 0.1  # of the frames: a larger one that stays unused or is added is said
INIT = "init.pt"  # a copy of the policy that a run began from


class Experiment(Stateful):
    """The training of a run, whose env and learner are made here.

    Files: `metrics.csv` (a row for the state before the first update and after each update),
    `checkpoint.pt` (the complete state), `checkpoint_previous.pt`, `policy_last.pt` and `policies/`
    (the kept ones). A run that was killed at any moment and resumed in a new process ends with the
    same files, to the bit on a CPU.

    Args:
        run: whose training it is; its folder exists.
        before: frames that were taken before it, by what prepared it.

    Attributes:
        learner: learns from the batches.
        rollout: collects them.
        cases: in which callbacks compare policies; their steps are frames.
        curve: keeps policies and evaluates them, after the row of an update was logged.
        callbacks: called before the first update, and after each one before its row is logged. The
            numbers that one returns are columns of the log.
        reserve: returns the frames that are kept for a test at the end, once the tests before the
            first update are over. None: there is no such test.
    """

    EPISODES: ClassVar[int] = 100  # the return is the mean over this many finished episodes
    parts: ClassVar = ("learner", "rollout", "cases", "updates", "first", "ends")

    def __init__(self, run: Run, before: int) -> None:
        self.owner, self.budget, self.before = run, run.budget, before
        env = run.make_env(run.budget.rows)
        _say_units(env)
        if run.compiled:
            compile_steps(env)
        learner = self.learner = run.require_agent()(env)
        if run.init is not None:
            init = run.folder / INIT
            if not init.exists():
                checkpoint.save(checkpoint.load(weights_file(Path(run.init))), init)
            checkpoint.put_weights(learner.policy, checkpoint.load(init, run.device), init)
        keys = [*learner.keys, *watched_keys(env, run.watch)]
        self.rollout = Rollout(env, learner.policy, run.budget.steps, keys, run.noise_correlation)
        make_env = partial(run.make_env, cases=TESTS)
        self.cases = TrainingCases(make_env, run.budget.frames, run.seed, run.noise_correlation)
        self.curve = _curve_of(run, learner.policy)
        self.callbacks: list[Callback] = [*learner.callbacks(self.cases), *run.callbacks(learner)]
        self.reserve: Callable[[], int] | None = None
        if run.delivery == "tested":
            delivery = Delivery(learner, env, self.cases, self.curve, run.folder)
            self.callbacks.append(delivery)
            self.reserve = delivery.reserve
        logger = run.logger() if run.logger is not None else None
        self.metrics = Metrics(run.folder / "metrics.csv", logger)
        self.updates = 0  # so far
        self.calls_before = 0  # of the guides in the rollouts of earlier processes
        self.first: dict[str, float] = {}  # the row of the log before the first update
        self.ends: dict[int, int] = {}  # frames of each length of the run to its number of updates
        self.returns: deque[float] = deque(maxlen=self.EPISODES)

    @property
    def all_updates(self) -> int:
        """Number of updates of the whole run, once it is known."""
        return self.ends[self.budget.frames]

    def _plan(self) -> None:
        """Fix at how many updates the run ends, and what the curve keeps.

        The frames are rounded up to whole batches. What tests have taken, and what is kept for the
        last one, is left out of these, so that a run with tests takes no more frames than one
        without. At least one further update is left. If more than `REST` of the frames stay unused,
        or are added, that is said.
        """
        kept = 0 if self.reserve is None else self.reserve()
        batch, length = self.rollout.frames, self.budget.frames
        for frames in (*self.budget.stages, length):
            if frames not in self.ends:
                whole = math.ceil((frames - self.before) / batch) * batch
                updates = (whole - self.cases.steps - kept) // batch
                self.ends[frames] = max(updates, self.updates + 1)
        rest = length - self.before - self.all_updates * batch - self.cases.steps - kept
        if abs(rest) > REST * length and not self.updates:
            done = "of {:,} frames stay unused" if rest > 0 else "frames are added to {:,}"
            say(
                f"train: {abs(rest):,} {done.format(length)}, because they are no whole "
                f"batch of {batch:,}; take smaller batches (budget.steps) or more frames",
                error=True,
            )
        known = [update for update in self.ends.values() if update <= self.all_updates]
        self.curve.attach(self.metrics, known, self.rollout.frames, int(self.first["frames"]))

    def resume(self) -> None:
        """Continue from the last intact checkpoint of the folder.

        Without a checkpoint the run begins anew.

        Raises:
            UserError: if the checkpoint or the log is damaged, or belongs to another run.
        """
        known = checkpoint.go_on(self.owner, self.load_state_dict)
        self.metrics.truncate(self.updates + 1 if self.updates else 0)
        self.metrics.check_columns(self.curve.columns)
        where = f"after update {self.updates}"
        if not known:
            where = "from the beginning: there is no checkpoint yet"
        say(f"{self.owner.folder} continues {where}", error=True)

    def run(self, guide_return: float | None = None) -> list[dict[str, float]]:
        """Train to the end and return the rows of `metrics.csv`.

        What is measured before the first update may take frames, and comes before the plan.

        Args:
            guide_return: mean return of the best guide, shown beside the agent's.

        Raises:
            UserError: for a NaN from the env, in the losses or in the weights.
        """
        self.metrics.describe(self.owner.identity)
        if not self.first:
            first = self._measure({})
            for sentence in start_test(first):
                say(sentence, error=True)
            self.first = first | self._taken()
        self._plan()
        read: list[NestedKey] = []
        for group in self.owner.watch.values():
            read += [unravel_key(tuple(key)) for key in group.values()]
        read += getattr(getattr(self.learner, "extensions", None), "keys", [])
        rest_guides(self.learner.policy, self.rollout.env, read)
        updates, frames = self.all_updates, self.rollout.frames
        with progress(
            total=updates * frames,
            initial=self.updates * frames,
            unit="frame",
            unit_scale=True,
            desc="train",
        ) as bar:
            self._act({})
            if self.cases.steps and not self.updates:
                self.save()
            with STOP.after_update():
                while self.updates < updates:
                    # The first update may learn from all steps of the tests, which takes long.
                    kept = self.cases.steps and not self.updates
                    with STOP.at_once() if kept else nullcontext():
                        row = self.update(self.updates / updates)
                    row |= self._measure(row)
                    row = self._taken() | row
                    if not self.metrics.rows:
                        self.metrics.append({**dict.fromkeys(row, math.nan), **self.first})
                    self.metrics.append(row)
                    bar.update(frames)
                    with decoration("the progress bar"):
                        self._show(bar, row, guide_return)
                    self._act(row)
        checkpoint.save(self.learner.policy.state_dict(), weights_file(self.owner.folder))
        return self.metrics.rows

    def update(self, progress: float) -> dict[str, float]:
        """Collect one batch, learn from it and return the row of the log.

        Args:
            progress: finished share of the run, in [0, 1], for all schedules.
        """
        with self.resume_hint():
            batch = self.rollout.collect(progress)
        row = dict.fromkeys(self.curve.columns, math.nan) | self._describe(batch)
        learned = {
            f"learner/{name}": value for name, value in self.learner.update(batch, progress).items()
        }
        self.updates += 1
        # What is a mean over the minibatches has no number where there are none.
        without = learned.get("learner/minibatches") == 0
        with self.resume_hint():
            for name, value in learned.items():
                if not math.isfinite(value) and not (without and math.isnan(value)):
                    raise UserError(f"{name} is {value} in update {self.updates}")
        return {**row, **learned}

    def _measure(self, row: Mapping[str, float]) -> dict[str, float]:
        """Return the numbers of the callbacks, NaN where they are not due."""
        numbers: dict[str, float] = {}
        all_updates = self.ends.get(self.budget.frames, -1)  # not known before the first update
        for callback in self.callbacks:
            if callback.due(self.updates, all_updates, row):
                numbers |= callback.after_update(self.updates)
            else:
                numbers |= dict.fromkeys(callback.names, math.nan)
        return numbers

    def _taken(self) -> dict[str, float]:
        """Return the frames so far, their parts, and the number of calls of guides, by name."""
        rollout = self.updates * self.rollout.frames
        return {
            "frames": self.before + self.cases.steps + rollout,
            "frames/before": self.before,
            "frames/rollout": rollout,
            "frames/tests": self.cases.steps,
            "guide/calls": self.calls_before + guide_calls(self.rollout.env) + self.cases.calls,
        }

    def _act(self, row: Mapping[str, float]) -> None:
        """Write the checkpoint after an update, and continue the curve.

        A training that is asked to stop writes its checkpoint, and is interrupted. An evaluation
        takes long and changes nothing of the state, so that it is interrupted at once, and done
        again by the run that goes on.

        Args:
            row: of the log; empty before the first update.
        """
        update, updates = self.updates, self.all_updates
        if row and (
            update % self.budget.checkpoint_every == 0 or update == updates or STOP.requested
        ):
            self.save()
            if STOP.requested:
                raise KeyboardInterrupt
        try:
            with STOP.at_once():
                self.curve.after_update(update)
        except KeyboardInterrupt:
            if update:
                self.save()
            raise

    def _show(self, bar: Any, row: Mapping[str, float], guide_return: float | None) -> None:
        """Show the newest returns beside the progress bar.

        `training` is with exploration; `curve` and `guide` are deterministic, in the cases of the
        curve.
        """
        returns = {
            "training": row["train/return"],
            "curve": self.metrics.newest(),
            "guide": guide_return,
        }
        known = {name: value for name, value in returns.items() if value is not None}
        spec = return_format(known.values())
        shown = {name: f"{value:{spec}}" for name, value in known.items()}
        bar.set_postfix(shown)

    @contextmanager
    def resume_hint(self) -> Iterator[None]:
        """Add the command that continues a saved run to an error whose cause is outside of it."""
        try:
            yield
        except Exception as error:
            if not is_outside(error):
                raise
            kept = ""
            if (self.owner.folder / checkpoint.NEWEST).exists():
                kept = (
                    "; the last good checkpoint is kept: correct the cause and continue with "
                    f"{self.owner.resume_command}, or train again with other values"
                )
            raise UserError(f"{error}{kept}") from error

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
        for name, key in self.owner.watch.get("episode", {}).items():
            ended = after[tuple(key)][done].float()
            row[f"train/{name}"] = float(ended.nanmean())
        for name, key in self.owner.watch.get("step", {}).items():
            row[f"train/{name}"] = float(after[tuple(key)].float().nanmean())
        return row

    def save(self) -> None:
        """Write the checkpoint; a NaN in it is a `UserError`."""
        state = self.state_dict()
        with self.resume_hint():
            checkpoint.check_parameters(state["learner"], self.updates)
        self.metrics.flush()
        checkpoint.save_newest(state, self.owner.folder)

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the rest of the run depends on."""
        return super().state_dict() | {
            "identity": self.owner.identity,
            "calls": self.calls_before + guide_calls(self.rollout.env),
            "returns": list(self.returns),
            "torch_rng": torch.get_rng_state(),
            "cuda_rng": torch.cuda.get_rng_state_all() if torch.cuda.is_initialized() else [],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state that `state_dict` returned."""
        super().load_state_dict(state)
        if self.rollout.carrier is None:  # its env cannot go on with the running episodes
            self.learner.begin_episodes()
        # What building this process's env has asked its guides for is no part of the run.
        self.calls_before = state["calls"] - guide_calls(self.rollout.env)
        self.returns = deque(state["returns"], maxlen=self.EPISODES)
        torch.set_rng_state(state["torch_rng"])
        if state["cuda_rng"]:
            torch.cuda.set_rng_state_all(state["cuda_rng"])


def watched_keys(env: EnvBase, watch: Watch) -> list[NestedKey]:
    """Return the entries that `Experiment` needs in a rollout, besides those of the learner."""
    keys: list[NestedKey] = [("next", "done"), ("next", "reward"), ("next", "episode_reward")]
    if "task_reward" in env.observation_spec:
        keys.append(("next", "task_reward"))
    for group in watch.values():
        keys += [("next", *key) for key in group.values()]
    return keys


def _curve_of(run: Run, policy: TensorDictModuleBase) -> EvaluationCurve:
    """Return the evaluation curve of a run; it has no sets where there are no such cases."""
    sets = [*run.make_env.sizes] if EVALUATION in run.make_env.sizes else []
    if run.delivery == "tested":  # an earlier policy is chosen by the test at the end
        sets = [each for each in sets if each == EVALUATION]
    return EvaluationCurve(
        run.folder,
        policy,
        run.make_env,
        sets,
        watch=run.watch,
        points=run.budget.points,
        batches=run.budget.batches,
    )


def _say_units(env: EnvBase) -> None:
    """Print the units in which an action that lacks bounds is normalised."""
    if len(env.action_keys) != 1:
        return
    spec = env.full_action_spec[env.action_key]
    units = given_units(env) or units_of(spec, len(env.batch_size))
    if units is not None and units.assumed:
        say(f"action: {'; '.join(units.assumed)}", error=True)
