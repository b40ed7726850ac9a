"""The evaluation of a run: its policy and its guides in all cases, as tables and pictures."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from functools import partial
from itertools import compress
from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from coil_rl import record
from coil_rl.compiled import compile_steps
from coil_rl.errors import UserError
from coil_rl.guides.simple import FollowAdvice
from coil_rl.measures import (
    MEAN_CASE,
    Measure,
    denominators,
    summarise,
    with_denominators,
)
from coil_rl.output import decoration, progress, say
from coil_rl.report import Returns, markdown_table
from coil_rl.report.pictures import Picture
from coil_rl.report.statistics import difference
from coil_rl.report.table import AUTO_FORMAT, return_format
from coil_rl.run.beside import Driver
from coil_rl.run.evaluation import EvaluationResult, evaluate_policy
from coil_rl.run.parts import TEST, EnvMaker
from coil_rl.run.policy_batch import Acting, OnRows, traced
from coil_rl.run.reasons import SENTENCES
from coil_rl.transforms.action_space import random_action

COLUMNS = {
    "driver": ("driver", ""),
    "advice": ("advice", ""),
    "actions": ("actions", ""),
    "case": ("case", ""),
    "reward": ("reward", AUTO_FORMAT),
}
MAX_CASES = 8  # in the table for people
ALLOWED_LOSS = 0.01  # of what a guide earns beyond random actions, for a policy that is not worse


@dataclass(frozen=True)
class Evaluation:
    """What is measured in each episode, and on which cases.

    Args:
        cases: names of the cases; row i of an env is case i modulo their number.
        measures: by name.
        record: entries of every step that pictures need, by name.
    """

    cases: Sequence[str]
    measures: Mapping[str, Measure] = field(default_factory=dict)
    record: Mapping[str, NestedKey] = field(default_factory=dict)

    def run(self, env: EnvBase, policy: TensorDictModuleBase, **options: Any) -> EvaluationResult:
        """Evaluate a policy on an env whose rows are the cases, perhaps several times.

        `options` are those of `evaluate_policy`.
        """
        return evaluate_policy(
            env, policy, cases=self.cases, measures=self.measures, record=self.record, **options
        )


@dataclass(frozen=True, eq=False)
class Trial:
    """How the policy of a run is evaluated, and what is made of it.

    Args:
        label: name of the policy in tables and pictures.
        evaluation: cases and measures.
        make_env: makes the env of the policy in the cases of the test.
        pictures: of the deterministic episodes.
        guides: names of the guides, as in tables.
        together: whether the policy's env is that of its guides: all that its method adds is their
            advice. Then the guides act in rows beside the policy.
        advice: names of further kinds of advice, with each of which the policy is evaluated too.
        repeats: episodes a case with sampled actions.
        count: number of cases, if it is not the env's own.
        compiled: whether the steps of the env are compiled.
        notes: further sentences for the page.
    """

    label: str
    evaluation: Evaluation
    make_env: EnvMaker
    _: KW_ONLY
    pictures: Sequence[Picture] = field(default_factory=lambda: [Returns()])
    guides: Sequence[str] = ()
    together: bool = False
    advice: Sequence[str] = ()
    repeats: int = 0
    count: int | None = None
    compiled: bool = False
    notes: Sequence[str] = ()

    def env(self, rows: int, advice: str = "") -> EnvBase:
        """Return the env of the policy in the cases of the test."""
        return self.make_env(rows, TEST, advice, count=self.count)

    def guide_results(
        self, evaluation: Evaluation, pictures: Sequence[Picture] = ()
    ) -> dict[str, EvaluationResult]:
        """Evaluate each guide alone, once in each case of the test; there may be none."""
        if not self.guides:
            return {}
        cases = len(evaluation.cases)
        rows = {title: slice(n * cases, (n + 1) * cases) for n, title in enumerate(self.guides)}
        env, policy = self.make_env.guided(cases, TEST, count=self.count)
        with progress(unit="step", desc="guides", leave=False, mininterval=0.5) as bar:
            result = evaluation.run(
                env, policy, tick=bar.update, watch=watching(env, pictures, rows)
            )
        return {title: result[part] for title, part in rows.items()}

    def chance(self) -> float:
        """Return the mean reward of random actions in the cases of the test.

        It is the zero of the scale of returns: a reward of 0 means nothing by itself.
        """
        rows = len(self.evaluation.cases)
        env = self.make_env.plain(rows, TEST, count=self.count)
        with torch.random.fork_rng():
            torch.manual_seed(0)
            return evaluate_policy(env, partial(random_action, env)).mean_reward


class Judgement:
    """The results of an evaluation, as they come in.

    Args:
        measures: of each episode, by name.
    """

    def __init__(self, measures: Mapping[str, Measure]) -> None:
        self.measures = measures
        self.table: list[dict[str, Any]] = []  # means
        self.counts: list[dict[str, int]] = []  # episodes that each mean rests on
        self.episodes: list[dict[str, Any]] = []
        self.shown: dict[str, EvaluationResult] = {}  # deterministic episodes, by title

    @property
    def rows(self) -> list[dict[str, Any]]:
        """The rows of evaluation.csv."""
        return with_denominators(self.table, self.counts)

    def add(
        self,
        result: EvaluationResult,
        driver: str,
        advice: str = "",
        actions: str = "deterministic",
    ) -> None:
        """Add the episodes of a policy or a guide."""
        label = {"driver": driver, "advice": advice, "actions": actions}
        self.table += [label | row for row in summarise(result.episodes, self.measures)]
        self.counts += denominators(result.episodes, self.measures)
        self.episodes += [label | row for row in result.episodes]
        if actions == "deterministic":
            self.shown[f"{driver}, {advice}" if advice else driver] = result


def judge(
    trial: Trial,
    policy: TensorDictModuleBase | None,
    folder: Path,
    seed: int,
    drivers: Sequence[Driver] = (),
) -> Judgement:
    """Evaluate a policy beside its guides; write tables and pictures.

    Each guide acts once in each case, beside the policy where both have the same env. A policy acts
    once with deterministic actions, `trial.repeats` times with sampled ones if it samples, once
    with each advice of `trial.advice` instead of its own. Each of the `drivers` acts once.

    The files are `episodes.csv`, `evaluation.md` (means), pictures, and last `evaluation.csv`, with
    which a run is finished. A picture that fails is a warning.

    Args:
        policy: of the run; None for the guides alone.
        drivers: further ones, beside the policy.
    """
    judgement = Judgement(trial.evaluation.measures)
    if policy is None or not trial.together:
        for name, result in trial.guide_results(trial.evaluation, trial.pictures).items():
            judgement.add(result, name)
    said: list[str] = []
    torch.manual_seed(seed)
    with progress(unit="step", desc="evaluate", leave=False, mininterval=0.5) as bar:
        if policy is not None:
            samples = isinstance(policy, ProbabilisticTensorDictSequential)
            acting, repeats = traced(policy), trial.repeats if samples else 0
            for advice in ("", *trial.advice):
                bar.set_postfix_str(", ".join(filter(None, (trial.label, advice))))
                _evaluate(trial, acting, judgement, bar, advice, 0 if advice else repeats)
        for driver in drivers:
            result = trial.evaluation.run(trial.env(len(trial.evaluation.cases)), driver.policy)
            judgement.add(result, f"{trial.label} {driver.name}")
            said += driver.said(result)
    record.EPISODES.write(folder, judgement.episodes)
    page = _page(trial, judgement, has_policy=policy is not None, said=said)
    record.PAGE.write(folder, page)
    for picture in trial.pictures:
        with decoration(f"the picture {type(picture).__name__} in {folder}"):
            picture.draw(judgement.shown, folder)
    record.EVALUATION.write(folder, judgement.rows)
    return judgement


def _evaluate(
    trial: Trial,
    policy: TensorDictModuleBase,
    judgement: Judgement,
    bar: Any,
    advice: str,
    repeats: int,
) -> None:
    """Add the episodes of a policy with one kind of advice, and of the guides beside it.

    All episodes run in one batch: the time of a step hardly depends on its size.

    Args:
        advice: empty for the policy's own, beside which the guides act.
        repeats: episodes a case with sampled actions.
    """
    count = len(trial.evaluation.cases)
    beside = trial.guides if trial.together and not advice else ()
    own = (1 + repeats) * count
    guides = {name: slice(own + n * count, own + (n + 1) * count) for n, name in enumerate(beside)}
    env = trial.env(own + len(guides) * count, advice)
    if trial.compiled:
        compile_steps(env)
    pictures = [] if advice else trial.pictures
    acting = [Acting(policy, rows=slice(count), whole=True)]
    if repeats:
        acting.append(Acting(policy, sampled=True, rows=slice(count, own), whole=True))
    for number, rows in enumerate(guides.values()):
        acting.append(Acting(FollowAdvice(env, number), rows=rows))
    watch = watching(env, pictures, {trial.label: slice(count), **guides})
    drives = OnRows(acting) if len(acting) > 1 else policy
    result = trial.evaluation.run(env, drives, tick=bar.update, watch=watch)
    for name, rows in guides.items():
        judgement.add(result[rows], name)
    judgement.add(result[:count], trial.label, advice)
    if repeats:
        judgement.add(result[count:own], trial.label, advice, "sampled")


def _page(trial: Trial, judgement: Judgement, *, has_policy: bool, said: Sequence[str]) -> str:
    """Return the page for people: a table and sentences."""
    columns = dict(COLUMNS)
    if not trial.advice:
        del columns["advice"]
    for name, measure in trial.evaluation.measures.items():
        if heading := measure.heading(name):
            columns[name] = (heading, measure.format)
    count = len(trial.evaluation.cases)
    shown = [count <= MAX_CASES or row["case"] == MEAN_CASE for row in judgement.table]
    rows, counts = (list(compress(each, shown)) for each in (judgement.table, judgement.counts))
    page = [markdown_table(rows, columns, counts)]
    page += SENTENCES.said("many_cases", cases=count, shown=MAX_CASES)
    if has_policy and count > 1 and trial.guides:
        # An env that fails with random actions costs this sentence, and not the results.
        with decoration("the comparison with the guide"):
            chance, mine = trial.chance(), judgement.shown[trial.label]
            for name in trial.guides:
                page += not_worse(mine, judgement.shown[name], name, chance)
    page += said
    return "\n\n".join([*page, *trial.notes])


def not_worse(
    policy: EvaluationResult, guide: EvaluationResult, name: str, chance: float
) -> list[str]:
    """Return the sentence that says whether a policy is not worse than a guide in the same cases.

    The allowed loss is 1 % of the distance between the mean rewards of the guide and of random
    actions, so an offset of all rewards changes nothing. The answer is yes if even the lower end of
    the t interval of the difference is within this loss, and no if even the upper end is beyond it.

    Args:
        policy: its episodes.
        guide: its episodes, in the same cases.
        name: of the guide.
        chance: mean reward of random actions.
    """
    mine, theirs = policy.rewards, guide.rewards
    found = difference(mine, theirs)
    allowed = ALLOWED_LOSS * abs(guide.mean_reward - chance)
    answer = "undecided"
    if found.low >= -allowed:
        answer = "yes"
    elif found.high < -allowed:
        answer = "no"
    elif found.high < 0:
        answer = "undecided, but worse"
    return SENTENCES.said(
        "not_worse",
        name=name,
        cases=len(mine),
        same=mine == theirs,
        answer=answer,
        low=found.low,
        high=found.high,
        least=f"{-allowed or 0.0:{return_format([allowed])}}",
        spec=return_format([found.low, found.high]),
    )


def watching(
    env: EnvBase, pictures: Sequence[Picture], rows: Mapping[str, slice]
) -> Callable[[Tensor, TensorDictBase, TensorDictBase], None] | None:
    """Return what shows each step of an env to the pictures that watch; None without any.

    A picture that fails is left out from then on.

    Args:
        rows: of each policy; the first one drives the first case.
    """
    present = [picture for picture in pictures if picture.watches]
    firsts = {name: part.start or 0 for name, part in rows.items()}

    def watch(running: Tensor, before: TensorDictBase, after: TensorDictBase) -> None:
        shown = {name: row for name, row in firsts.items() if running[row]}
        for picture in list(present):
            present.remove(picture)
            with decoration(f"the picture {type(picture).__name__}"):
                picture.watch(env, shown, before, after)
                present.append(picture)

    return watch if present else None


def report_outcome(folder: Path) -> float:
    """Print the evaluation of a run, and return the mean reward of its deterministic policy.

    Without a policy it is that of the guide; those of further drivers are on the page only. A
    damaged file is a `UserError`.
    """
    rows = record.EVALUATION.need(folder)
    means = [row for row in rows if (row["case"], row["actions"]) == (MEAN_CASE, "deterministic")]
    beside = tuple(f"{row['driver']} " for row in means)  # they are called after their policy
    own = [row for row in means if not row["advice"] and not row["driver"].startswith(beside)]
    if not own:
        raise UserError(f"{folder / record.EVALUATION.name} has no means; evaluate again")
    reward, completed = own[-1]["reward"], own[-1].get("completed", math.nan)
    say(record.PAGE.need(folder))
    share = "" if math.isnan(completed) else f", {completed:.0%} completed"
    shown = format(reward, return_format([reward]))
    say(f"{own[-1]['driver']}: mean test reward {shown}{share}; see {folder}")
    return reward


def guide_titles(guides: Iterable[str]) -> list[str]:
    """Return the names of guides in tables: `guide` for a single one, otherwise `guide NAME`.

    Args:
        guides: their names.
    """
    names = list(guides)
    return ["guide"] if len(names) == 1 else [f"guide {name}" for name in names]
