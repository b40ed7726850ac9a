"""Evaluation of policies: one episode on every row of an env, reduced to its measures."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase

from coil_rl.envs.seeded_env import SeededEnv
from coil_rl.measures import Measure, in_info
from coil_rl.run.lean_steps import LeanEnv
from coil_rl.run.policy_batch import acted
from coil_rl.transforms.guide_transform import SeededGenerator


@dataclass(frozen=True)
class EvaluationResult:
    """Episodes of a policy, one per row of the env.

    Attributes:
        episodes: `case`, `reward` (sum), `steps`, and the measures.
        histories: recorded entries of the steps of each episode, [steps, ...].
        rate: control steps per second, the attribute `rate` of the env; NaN for an env without it.
    """

    episodes: list[dict[str, Any]]
    histories: dict[str, list[NDArray[np.float64]]] = field(default_factory=dict)
    rate: float = float("nan")

    @property
    def rewards(self) -> list[float]:
        """Reward of each episode."""
        return [float(episode["reward"]) for episode in self.episodes]

    @property
    def mean_reward(self) -> float:
        """Mean of the episodes."""
        return sum(self.rewards) / len(self.episodes)

    def __getitem__(self, rows: slice) -> EvaluationResult:
        """Return the episodes of some rows."""
        histories = {name: history[rows] for name, history in self.histories.items()}
        return EvaluationResult(self.episodes[rows], histories, self.rate)


@torch.no_grad()
def evaluate_policy(
    env: EnvBase,
    policy: TensorDictModuleBase,
    *,
    sampled: bool = False,
    measures: Mapping[str, Measure] | None = None,
    record: Mapping[str, NestedKey] | None = None,
    cases: Sequence[str] = (),
    different: int | None = None,
    tick: Callable[[], Any] | None = None,
    watch: Callable[[Tensor, TensorDictBase, TensorDictBase], Any] | None = None,
) -> EvaluationResult:
    """Run one episode on every row of an env, with its transforms in evaluation mode.

    Args:
        env: of any batch size, also of none.
        policy: writes the action.
        sampled: whether to sample actions instead of taking the deterministic ones.
        measures: by name.
        record: entries after each step to keep, by name.
        cases: names of the cases; row i is case i modulo their number. By default rows are
            numbered.
        different: number of rows that draw random numbers; row i gets those of row `i % different`.
            None: as many as cases.
        tick: called after every step.
        watch: called after every step with whether each row was in its episode, [rows], and with
            the entries before, with the action, and after the step.
    """
    measures = {"reward": Measure(unravel_key(env.reward_key), "sum"), **(measures or {})}
    totals, recorded = Totals(measures), {name: list[Tensor]() for name in record or {}}
    drawn = different or len(cases) or None
    for before, after, running in episodes(env, policy, sampled=sampled, cases=drawn, tick=tick):
        totals.add(after, running)
        if watch is not None:
            watch(running.reshape(-1), before, after)
        for name, key in (record or {}).items():
            recorded[name].append(after[key])
    steps = totals.steps.tolist()
    results = totals.results()
    names = [cases[row % len(cases)] if cases else str(row) for row in range(len(steps))]
    columns = {"case": names, "reward": results["reward"].tolist(), "steps": steps}
    columns |= {name: results[name].tolist() for name in measures if name != "reward"}
    rows = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
    histories = {}
    for name, entries in recorded.items():
        flat = torch.stack(entries).reshape(
            len(entries), len(steps), *entries[0].shape[env.batch_dims :]
        )
        values = (flat.squeeze(-1) if flat.ndim > 2 else flat).cpu().double().numpy()
        histories[name] = [values[:count, row] for row, count in enumerate(steps)]
    return EvaluationResult(rows, histories, getattr(env, "rate", float("nan")))


EXTREMES = {"min", "max", "last"}  # reductions that are no sums


class Totals:
    """Measures of the episodes of all rows of an env, reduced step by step.

    Args:
        measures: by name.

    Attributes:
        steps: number of steps of each episode so far, [rows].
    """

    def __init__(self, measures: Mapping[str, Measure]) -> None:
        self.measures, self.steps = dict(measures), torch.zeros((), dtype=torch.int64)
        self.extremes: dict[str, list[int]] = {}  # places of those that are no sums, by reduction
        for place, measure in enumerate(measures.values()):
            if measure.reduction in EXTREMES:
                self.extremes.setdefault(measure.reduction, []).append(place)
        self.where = any(measure.where is not None for measure in measures.values())
        self.values = self.counts = torch.zeros(len(measures), 0)  # of no rows yet

    def add(self, after: TensorDictBase, running: Tensor) -> None:
        """Add the entries after a step of the rows that are `running`.

        There is one flag a row. Entries of several agents are summed.
        """
        running, measures = running.reshape(-1), self.measures.values()
        if "task_reward" in after:  # the reward may be another one for who learns
            after = after.copy().update({"reward": after["task_reward"]})
        self.steps = self.steps.to(running.device) + running.long()
        entries = [after[each.entry].double().reshape(len(running), -1) for each in measures]
        values = torch.stack([entry.sum(-1) for entry in entries])
        if not self.values.numel():
            self._begin(values)
        mask = running & ((values != 0) | self.with_zeros) & ~(values.isnan() & self.without_nan)
        if self.where:
            mask = mask & torch.stack(
                [running if each.where is None else _flags(after[each.where]) for each in measures]
            )
        before, self.values = self.values, self.values + torch.where(mask, values, 0.0)
        self.counts = self.counts + mask
        for reduction, part in self.extremes.items():
            value, new = before[part], values[part]
            if reduction == "last":
                self.values[part] = torch.where(mask[part], new, value)
            else:
                best = torch.fmin if reduction == "min" else torch.fmax
                self.values[part] = best(value, torch.where(mask[part], new, torch.nan))

    def _begin(self, values: Tensor) -> None:
        """Set the sums and counts of all measures to their start, for values [M, rows]."""
        self.values, self.counts = torch.zeros_like(values), torch.zeros_like(values)
        for part in self.extremes.values():
            self.values[part] = torch.nan
        kinds = [(each.reduction, in_info(each.entry)) for each in self.measures.values()]
        # Nothing happens where no number is, and it is no extreme.
        no_nan = [info or kind in EXTREMES | {"any", "count"} for kind, info in kinds]
        zeros = [kind not in ("any", "count", "mean_nonzero") for kind, _ in kinds]
        self.without_nan = torch.tensor(no_nan, device=values.device).unsqueeze(-1)
        self.with_zeros = torch.tensor(zeros, device=values.device).unsqueeze(-1)

    def results(self) -> dict[str, Tensor]:
        """Return the measures by name, [rows] each: numbers (float64) or flags (bool).

        Flags of which some are undecided are numbers: 0, 1, and NaN for these.
        """
        results: dict[str, Tensor] = {}
        for (name, measure), number, count in zip(
            self.measures.items(), self.values, self.counts, strict=True
        ):
            if measure.reduction in ("mean", "mean_nonzero"):
                number = number / count
            elif measure.reduction == "count":
                number = count
            elif measure.reduction == "any":
                number = count > 0
            results[name] = _within(measure, number, count)
        return results


def _flags(entry: Tensor) -> Tensor:
    """Return an entry as flags of the rows: a number is one if it is neither 0 nor NaN."""
    return entry.reshape(-1).nan_to_num() != 0


def _within(measure: Measure, numbers: Tensor, counts: Tensor) -> Tensor:
    """Return whether numbers are within the bound of a measure; without one the numbers.

    Args:
        numbers: of the episodes, [rows].
        counts: number of steps that each number rests on.
    """
    if measure.at_least is not None:
        flags = numbers >= measure.at_least
    elif measure.at_most is not None:
        flags = numbers <= measure.at_most
    else:
        return numbers
    undecided = numbers.isnan() & (counts > 0)
    return torch.where(undecided, torch.nan, flags.double()) if undecided.any() else flags


def episodes(
    env: EnvBase,
    policy: TensorDictModuleBase,
    *,
    sampled: bool = False,
    cases: int | None = None,
    tick: Callable[[], Any] | None = None,
) -> Iterator[tuple[TensorDictBase, TensorDictBase, Tensor]]:
    """Yield the entries before, with the action, and after each step of one episode on every row.

    With them comes whether the row was still in its episode, [*B, 1].

    Args:
        env: as for `evaluate_policy`.
        policy: as above.
        sampled: as above.
        cases: number of different cases; row i has the random numbers of row `i % cases`. None: as
            many as rows.
        tick: as above.
    """
    with _drawn_by_case(env, cases):
        carrier = env.eval().reset()
        lean = LeanEnv(env) if LeanEnv.covers(env) else None
        running = torch.ones_like(env.full_done_spec["done"].zero())
        for count in itertools.count(1):
            before = acted(policy, carrier, sampled)
            # Entries of a policy for the next step, `("next", KEY)`, are left to TorchRL.
            if lean is None or "next" in before:
                step = env.step(before)
                after, carrier = step["next"], env.step_mdp(step)
            else:
                after = lean.step(before["action"], before)
                carrier = before.exclude(*after.keys()).update(after)
            yield before, after, running
            running = running & ~after["done"]
            # The test waits for the device.
            if count % 8 == 0 and not running.any():
                return
            if tick is not None:
                tick()


@contextmanager
def _drawn_by_case(env: EnvBase, cases: int | None) -> Iterator[None]:
    """Let the env, transforms and guides draw the same random numbers for all rows of a case."""
    several = cases is not None and env.batch_dims == 1 and env.batch_size.numel() > cases
    parts = [part for part in env.modules() if isinstance(part, (SeededEnv, SeededGenerator))]
    before = [part.different for part in parts]
    try:
        for part in parts:
            part.different = cases if several else None
        yield
    finally:  # a guide may be a part of another env too
        for part, different in zip(parts, before, strict=True):
            part.different = different
