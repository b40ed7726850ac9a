"""A run that tunes the numbers of its guide: a search instead of a training, and then as any run.

The numbers are written into `tuned.json`, from which its env takes them whenever it is made. The
policy of the run follows that guide.
"""

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from coil_rl import record
from coil_rl.errors import UserError, file_of_a_run
from coil_rl.guides.simple import FollowAdvice
from coil_rl.output import progress, say
from coil_rl.report.runs import EVALUATION
from coil_rl.report.sentences import Sentences
from coil_rl.report.table import return_format
from coil_rl.run import checkpoint
from coil_rl.run.cases import TrainingCases
from coil_rl.run.curve import columns_of, evenly, means_of, measures
from coil_rl.run.delivery import GUIDE, GuideActs
from coil_rl.run.folder import HANDED_OVER, weights_file
from coil_rl.run.metrics import Metrics
from coil_rl.run.parts import TESTS
from coil_rl.run.run import Run
from coil_rl.run.stopping import STOP
from coil_rl.tune.candidates import Candidates
from coil_rl.tune.numbers import GuideWithNumbers
from coil_rl.tune.search import BEST, MEAN, OWN, Number, Search, Tuner, Values, chosen

SENTENCES = Sentences("coil_rl.tune", "tune.j2")
NAMES = {OWN: "guide", MEAN: "tuned", BEST: "best_candidate"}  # in delivery.json


@dataclass(eq=False, repr=False)
class TunedRun(Run):
    """A run that tunes its guide.

    Args:
        numbers: of the guide that are searched.
        make_guide: makes the guide with some values of them.
        search: settings.
    """

    _: KW_ONLY
    numbers: Sequence[Number] = ()
    make_guide: GuideWithNumbers
    search: Search = field(default_factory=Search)

    @property
    def has_agent(self) -> bool:
        """Whether the run has a policy: the one that follows the tuned guide."""
        return True

    def new_policy(self, env: EnvBase) -> TensorDictModuleBase:
        """Return the policy that follows the tuned guide of an env.

        Raises:
            UserError: if the run is not finished, or its files are damaged.
        """
        if read_tuned(self.folder, self.numbers) is None:
            raise UserError(
                f"{self.folder} has no {record.TUNED.name} yet; finish it with "
                f"{self.resume_command}"
            )
        return GuideActs(env)

    def training(self, before: int) -> Any:
        """Return the search, a `TunedTraining`."""
        return TunedTraining(self)

    def reasons(self) -> list[str]:
        """Return the sentences on the test, the numbers of the guide, and a budget too small."""
        values, report = read_tuned(self.folder, self.numbers), record.DELIVERY.read(self.folder)
        own = {each.name: each.own for each in self.numbers}
        steps = 0 if report is None else report.steps
        return [
            *super().reasons(),
            *SENTENCES.said("numbers", values=values, own=own, file=record.TUNED.name),
            *SENTENCES.said("beyond_budget", steps=steps, frames=self.budget.frames),
        ]

    def _say_next(self) -> None:
        """Print what usually follows: a training with the guide itself, faster than this run."""
        values = read_tuned(self.folder, self.numbers) or {}
        tuned = self.make_guide.words(values)
        if self.in_python:
            each = (f"{name}={str(value).removesuffix('.0')}" for name, value in values.items())
            numbers = ", ".join(each)
            guide = f"guide=functools.partial(GUIDE, {numbers})"
            if not all(word.lstrip("+").startswith("guide.controller.") for word in tuned):
                guide = f"guide=GUIDE, overrides={tuned}"  # a guide of this package has a name
            say(f"Next: coil_rl.train(ENV, {guide})")
            return
        typed = [*self.command] or record.COMMAND.read(self.folder) or ["coil-train"]
        own = ["method=", "method.run.", "tune=", "tune.", "label=", "run_dir=", "existing="]
        # A number that was added on the command line is in no file, so that it is added again.
        given = {word.lstrip("+").partition("=")[0]: word.partition("=")[0] for word in typed}
        for index, word in enumerate(tuned):
            key, equals, value = word.lstrip("+").partition("=")
            own.append(f"{key}=")
            tuned[index] = f"{given.get(key, word.partition('=')[0])}{equals}{value}"
        kept = [word for word in typed if not word.lstrip("+").startswith(tuple(own))]
        say(f"Next: {shlex.join([*kept, *tuned, 'method=coil_anchored'])}")


class TunedTraining:
    """The search of a run and the test of what it found, in the place of an `Experiment`.

    Args:
        run: whose guide is tuned.
    """

    learner = None

    def __init__(self, run: TunedRun) -> None:
        self.tuned, self.folder, self.make_env = run, run.folder, run.make_env
        self.candidates = Candidates(
            [run.make_guide({each.name: each.own for each in run.numbers})]
        )
        self.cases = TrainingCases(self._build, run.budget.frames, run.seed)
        self.tuner = Tuner(
            run.numbers,
            run.make_guide,
            self.candidates,
            self.cases,
            search=run.search,
            seed=run.seed,
        )
        logger = run.logger() if run.logger is not None else None
        self.metrics = Metrics(self.folder / "metrics.csv", logger)

    def _build(self, rows: int) -> EnvBase:
        return self._env(rows, TESTS, self.candidates)

    def _env(self, rows: int, cases: str, candidates: Candidates) -> EnvBase:
        """Return an env in which candidates act in the place of the guide."""
        (name,) = self.make_env.guides()
        return self.make_env.guided(rows, cases, {name: candidates})[0]

    def resume(self) -> None:
        """Go on from the last intact checkpoint of the folder; without one begin anew."""
        checkpoint.go_on(self.tuned, self._load)
        done = len(self.tuner.told)
        self.metrics.truncate(done + 1 if done else 0)
        say(f"{self.folder} continues after generation {done}", error=True)

    def _load(self, state: Mapping[str, Any]) -> None:
        self.tuner.load_state_dict(state["tuner"])

    def run(self, guide_return: float | None = None) -> list[dict[str, float]]:
        """Search to the end, test which numbers the guide gets, and return the rows of the log."""
        tuner, cases, metrics = self.tuner, self.cases, self.metrics
        with (
            progress(
                total=cases.frames, initial=cases.steps, unit="frame", unit_scale=True, desc="tune"
            ) as bar,
            STOP.after_update(),
        ):
            while tuner.may_go_on() and not (tuner.told and tuner.converged):
                before = cases.steps
                row = self._row(tuner.generation())
                if not metrics.rows:
                    metrics.append(self._first_row(row))
                metrics.append(row)
                metrics.flush()
                bar.update(cases.steps - before)
                shown = format(row["train/return"], return_format([row["train/return"]]))
                bar.set_postfix({"candidates": shown})
                self._save()
                if STOP.requested:
                    raise KeyboardInterrupt
        self._hand_over()
        return metrics.rows

    def _row(self, means: Sequence[float]) -> dict[str, float]:
        """Return the row of the log after a generation."""
        sets = self.make_env.sizes.keys() & {EVALUATION}
        row = {
            **dict.fromkeys(columns_of(sets, self.tuned.watch), math.nan),
            "frames": self.cases.steps,
            "frames/before": 0,
            "frames/rollout": 0,
            "frames/tests": self.cases.steps,
            "guide/calls": self.cases.calls,
            "train/return": sum(means) / len(means),
            "tune/best": max(means),
            "tune/spread": self.tuner.spread,
        }
        return row | {f"tune/number/{name}": value for name, value in self.tuner.mean.items()}

    def _first_row(self, row: Mapping[str, float]) -> dict[str, float]:
        """Return the row of the state before the first generation."""
        counted = [name for name in row if name.startswith(("frames", "guide/calls"))]
        own = {f"tune/number/{name}": value for name, value in self.tuner.own.items()}
        return dict.fromkeys(row, math.nan) | dict.fromkeys(counted, 0) | own

    def _hand_over(self) -> None:
        """Test which numbers the guide gets, unless that is done, and evaluate the kept ones."""
        with STOP.at_once():
            report = record.DELIVERY.read(self.folder)
            if report is None or not weights_file(self.folder).exists():
                report = self._test()
            self.cases.steps, self.cases.calls = report.steps, report.calls
            counted = {"frames": report.steps, "frames/tests": report.steps}
            last = len(self.metrics.rows) - 1
            self.metrics.fill({last: counted | {"guide/calls": report.calls}})
            if EVALUATION in self.make_env.sizes:
                self._fill_curve(last)
        self._save()

    def _test(self) -> record.Delivery:
        """Test, and write the numbers that the guide gets and why; return why."""
        tuner = self.tuner
        values = {OWN: tuner.own, MEAN: tuner.mean, BEST: tuner.best}
        returns = tuner.test()
        name = chosen(returns)
        record.TUNED.write(self.folder, dict(values[name]))
        for which in ("last", HANDED_OVER):
            checkpoint.save({GUIDE: torch.tensor(0)}, weights_file(self.folder, which))
        report = record.Delivery(
            policy=NAMES[name],
            cases=len(returns[OWN]),
            steps=self.cases.steps,
            calls=self.cases.calls,
            returns={NAMES[each]: float(found.mean()) for each, found in returns.items()},
        )
        record.DELIVERY.write(self.folder, report)
        return report

    def _save(self) -> None:
        """Write the checkpoint."""
        state = {"tuner": self.tuner.state_dict(), "identity": self.tuned.identity}
        checkpoint.save_newest(state, self.folder)

    def _fill_curve(self, last: int) -> None:
        """Evaluate the guide with the numbers of some generations in the cases of the curve.

        Args:
            last: number of the last row.
        """
        kept = evenly([0, last], min(self.tuned.budget.points, last))
        rows = [self.metrics.rows[each] for each in kept]
        values = [{name: row[f"tune/number/{name}"] for name in self.tuner.own} for row in rows]
        candidates = Candidates(list(map(self.tuned.make_guide, values)))
        cases = self.make_env.sizes[EVALUATION]
        env = self._env(len(kept) * cases, EVALUATION, candidates)
        with torch.random.fork_rng():
            found = measures(env, FollowAdvice(env), cases=cases, watch=self.tuned.watch)
        means = means_of(found, EVALUATION, len(kept))
        self.metrics.fill(dict(zip(kept, means, strict=True)))


def read_tuned(folder: Path, numbers: Sequence[Number]) -> Values | None:
    """Return the numbers that a run found, by name; None if it has found none yet.

    Raises:
        UserError: for a file that holds other numbers, or numbers out of their bounds.
    """
    saved = record.TUNED.read(folder)
    if saved is None:
        return None
    with file_of_a_run(folder / record.TUNED.name, checkpoint.PUT_BACK):
        values = {number.name: saved[number.name] for number in numbers}
        for number in numbers:
            low, high = min(number.low, number.own), max(number.high, number.own)
            if not low <= values[number.name] <= high:
                raise ValueError(f"{number.name} is not between {low:g} and {high:g}")
    return values
