"""The evaluation curve of a run: the returns of policies that were kept during the training.

The return in training says little about a policy: its actions are sampled, and it is the mean of
the episodes that happen to end. The kept policies act deterministically, all of them in one batch,
each in the same cases.
"""

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from tensordict import unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from coil_rl.measures import Measure
from coil_rl.output import progress
from coil_rl.report.runs import EVALUATION, RETURN
from coil_rl.run import checkpoint
from coil_rl.run.evaluation import Totals, episodes
from coil_rl.run.judge import guide_titles
from coil_rl.run.metrics import Metrics
from coil_rl.run.parts import EnvMaker
from coil_rl.run.policy_batch import policy_batch

POLICIES = "policies"  # subfolder with the kept policies
Watch = Mapping[str, Mapping[str, Sequence[str]]]  # name to key, of "episode" and of "step"


@dataclass(eq=False)
class EvaluationCurve:
    """Keeps policies of a run, and evaluates them in sets of cases.

    It writes `policies/FRAMES.pt`. The results are filled into the rows of the updates after which
    the policies were kept.

    Args:
        folder: of the run.
        policy: of the learner; copies of it act.
        make_env: makes the envs.
        sets: names of the sets of cases. Without any, no policies are kept.
        watch: further measures, "episode" at the end of an episode, "step" as the mean over its
            steps.
        points: number of policies that are kept, besides the first one.
        batches: number of evaluations over the run. Each is of the policies that were kept since
            the one before, and takes as long as one episode.

    Attributes:
        columns: names of its numbers in the log.
    """

    folder: Path
    policy: TensorDictModuleBase
    make_env: EnvMaker
    sets: Collection[str]
    _: KW_ONLY
    watch: Watch = field(default_factory=dict)
    points: int = 16
    batches: int = 1

    def __post_init__(self) -> None:
        self.columns = columns_of(self.sets, self.watch)

    def attach(self, metrics: Metrics, stages: Sequence[int], frames: int, before: int) -> None:
        """Tell the curve about the run.

        A run that was made longer has several ends. Its policies are kept as in a run of each
        length: evenly from one end to the next.

        Args:
            stages: numbers of updates at which the run ends.
            before: frames that were taken before the first update.
        """
        self.metrics, self.stages = metrics, list(stages)
        self.frames_of_update, self.frames_before = frames, before

    def after_update(self, update: int) -> None:
        """Keep the policy, and evaluate the kept ones, if it is time and it is not done.

        The row of the update has been logged.
        """
        if update in self.kept():
            self.keep(update)
        batch = self.batch(update)
        if batch and math.isnan(self.metrics.rows[batch[-1]][RETURN]):
            self.metrics.fill(dict(zip(batch, self.evaluate(batch), strict=True)))

    def kept(self) -> list[int]:
        """Return the updates of the run after which the policy is kept."""
        return evenly([0, *self.stages], self.points) if self.sets else []

    def batch(self, update: int) -> list[int]:
        """Return the updates whose policies are evaluated after an update, if any."""
        ends = evenly([0, *self.stages], self.batches)
        if update not in ends[1:]:
            return []
        begin = ends[ends.index(update) - 1]
        return [each for each in self.kept() if begin < each <= update or begin == each == 0]

    def keep(self, update: int) -> None:
        """Write the policy as it is, after some updates."""
        checkpoint.save(self.policy.state_dict(), self.file(update))

    def file(self, update: int) -> Path:
        """Return the file of the policy after some updates; its name has their frames."""
        frames = self.frames_before + update * self.frames_of_update
        return self.folder / POLICIES / f"{frames:012d}.pt"

    def evaluate(self, updates: Sequence[int]) -> list[dict[str, float]]:
        """Return the mean measures of the policies after some numbers of updates, by name.

        A damaged file is a `UserError`.
        """
        states = [checkpoint.load(self.file(each)) for each in updates]
        policies = policy_batch(self.policy, states)
        rows: list[dict[str, float]] = [{} for _ in updates]
        # The training's random numbers are left alone.
        with (
            torch.random.fork_rng(),
            progress(unit="step", desc="evaluate", leave=False, mininterval=0.5) as bar,
        ):
            for cases in self.sets:
                count = self.make_env.sizes[cases]
                env = self.make_env(len(updates) * count, cases)
                results = measures(env, policies, cases=count, watch=self.watch, tick=bar.update)
                for row, means in zip(rows, means_of(results, cases, len(rows)), strict=True):
                    row |= means
        return rows


def columns_of(sets: Iterable[str], watch: Watch) -> list[str]:
    """Return the names of what a curve measures in some sets of cases."""
    measured = ["return", *(name for group in watch.values() for name in group)]
    return [f"{cases}/{name}" for cases in sets for name in measured]


def means_of(results: Mapping[str, Tensor], cases: str, parts: int) -> list[dict[str, float]]:
    """Return the means of equal parts of the rows of an env, by their columns.

    Args:
        results: of `measures`, in that set of cases.
    """
    rows: list[dict[str, float]] = [{} for _ in range(parts)]
    for name, values in results.items():
        numbers = values.view(parts, -1).double()
        means = numbers.mean(1) if name == "return" else numbers.nanmean(1)
        for row, mean in zip(rows, means.tolist(), strict=True):
            row[f"{cases}/{name}"] = mean
    return rows


def evenly(ends: Sequence[int], parts: int) -> list[int]:
    """Return numbers that divide each interval between consecutive ends into equal parts."""
    numbers = set()
    for begin, end in pairwise(ends):
        numbers |= {begin + round((end - begin) * part / parts) for part in range(parts + 1)}
    return sorted(numbers)


@torch.no_grad()
def measures(
    env: EnvBase,
    policy: TensorDictModuleBase,
    *,
    cases: int | None = None,
    watch: Watch | None = None,
    tick: Callable[[], Any] | None = None,
) -> dict[str, Tensor]:
    """Run one episode on every row of an env with deterministic actions, and return its measures.

    Args:
        env: of batch size [B].
        cases: number of different cases; row i has case `i % cases`. None: as many as rows.
        watch: further measures, as for `EvaluationCurve`.
        tick: called after every step.

    Returns:
        The `return`, the sum of the rewards of the task, and the measures of `watch`, [B] each.
    """
    measured = {"return": Measure(unravel_key(env.reward_key), "sum")}
    for group, reduction in (("episode", "last"), ("step", "mean")):
        keys = (watch or {}).get(group, {})
        measured |= {name: Measure.of(key, reduction=reduction) for name, key in keys.items()}
    totals = Totals(measured)
    for _, after, running in episodes(env, policy, cases=cases, tick=tick):
        totals.add(after, running)
    return totals.results()


class GuideReturns:
    """Mean return of each guide of a learner that trains its guides, with its present parameters.

    A `Callback`. It measures nothing without a curve.

    Args:
        make_env: makes the env.
        guides: of the learner, by name.
        each_phase: whether to measure after each phase that changed a guide, not only before and
            after the training.
    """

    def __init__(
        self,
        make_env: EnvMaker,
        guides: Mapping[str, TensorDictModuleBase],
        *,
        each_phase: bool = True,
    ) -> None:
        self.make_env, self.guides, self.each_phase = make_env, guides, each_phase
        measured = guides if EVALUATION in make_env.sizes else ()
        self.names: Sequence[str] = [f"guide/{name}" for name in measured]

    def due(self, update: int, updates: int, row: Mapping[str, float]) -> bool:
        """Return whether the guides have changed, or the training begins or ends."""
        if update in (0, updates):
            return True
        return self.each_phase and bool(row["learner/guides_changed"])

    def after_update(self, update: int) -> dict[str, float]:
        """Return the means by their names in the log."""
        returns = guide_returns(self.make_env, self.guides)
        return dict(zip(self.names, returns.values(), strict=True))


def guide_returns(
    make_env: EnvMaker, guides: Mapping[str, TensorDictModuleBase]
) -> dict[str, float]:
    """Return the mean return of each guide in the cases of the curve.

    It is empty without cases or guides.
    """
    if EVALUATION not in make_env.sizes or not guides:
        return {}
    cases = make_env.sizes[EVALUATION]
    env, policy = make_env.guided(cases, EVALUATION, guides)
    with torch.random.fork_rng():
        returns = measures(env, policy, cases=cases)["return"].view(len(guides), -1).mean(1)
    return dict(zip(guide_titles(guides), returns.tolist(), strict=True))
