"""A run that tunes the numbers of its guide: a search instead of a training, and then as any run.

The numbers are written into `tuned.json`, from which its env takes them whenever it is made. The
policy of the run follows that guide.
"""

import math
import shlex
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from coil_rl import record
from coil_rl.errors import UserError, file_of_a_run
from coil_rl.guides.simple import FollowAdvice
from coil_rl.output import decoration, progress, say
from coil_rl.report import draw_learning_curves
from coil_rl.report.runs import EVALUATION
from coil_rl.report.table import return_format
from coil_rl.run import checkpoint
from coil_rl.run.cases import TrainingCases
from coil_rl.run.curve import measures
from coil_rl.run.delivery import GUIDE, GuideActs
from coil_rl.run.experiment import PUT_BACK, check_identity
from coil_rl.run.folder import HANDED_OVER, weights_file
from coil_rl.run.metrics import Metrics
from coil_rl.run.parts import TESTS
from coil_rl.run.run import Run
from coil_rl.run.stopping import STOP
from coil_rl.tune.candidates import Candidates
from coil_rl.tune.search import BEST, MEAN, OWN, MakeGuide, Number, Search, Tuner, Values, chosen

NAMES = {OWN: "guide", MEAN: "tuned", BEST: "best_candidate"}  # in delivery.json


@dataclass(eq=False, repr=False)
class TunedRun(Run):
    """A run that tunes its guide.

    Args:
        numbers: of the guide that are searched.
        make_guide: makes the guide with some values of them.
        search: settings.
        words: returns the words of a command line that give the guide some values.
    """

    _: KW_ONLY
    numbers: Sequence[Number] = ()
    make_guide: MakeGuide
    search: Search = field(default_factory=Search)
    words: Callable[[Values], Sequence[str]] = lambda values: ()

    @property
    def has_agent(self) -> bool:
        """Whether the run has a policy: the one that follows the tuned guide."""
        return True

    def load_policy(self, env: EnvBase, which: str = HANDED_OVER) -> TensorDictModuleBase:
        """Return the policy that follows the tuned guide of an env.

        Args:
            which: "handed_over" or "last", which are the same here.

        Raises:
            UserError: if the run is not finished, or its files are damaged.
        """
        if read_tuned(self.folder, self.numbers) is None:
            raise UserError(
                f"{self.folder} has no {record.TUNED.name} yet; finish it with "
                f"{self.resume_command}"
            )
        return self._loaded(GuideActs(env), env, which)

    def learn(self, *, resumed: bool = False) -> TensorDictModuleBase:
        """Tune the guide, draw the learning curve, and return the policy that follows the guide."""
        self._saved_guide_returns()
        candidates = Candidates(
            [self.make_guide({number.name: number.own for number in self.numbers})]
        )
        cases = TrainingCases(self._env_of(candidates), self.budget.frames, self.seed)
        tuner = Tuner(
            self.numbers, self.make_guide, candidates, cases, search=self.search, seed=self.seed
        )
        metrics = Metrics(
            self.folder / "metrics.csv", self.logger() if self.logger is not None else None
        )
        if resumed:
            self._resume(tuner, metrics)
        start = time.monotonic()
        self._search(tuner, metrics)
        self._hand_over(tuner, metrics)
        if not resumed:  # the time before the interruption is unknown
            record.SECONDS.write(self.folder, {"seconds": time.monotonic() - start})
        with decoration(f"the learning curve in {self.folder}"):
            draw_learning_curves(
                {self.label: [metrics.rows]},
                self.folder / "learning_curve.png",
                guides=self._saved_guide_returns(),
                title=self.label,
                cases=self.make_env.sizes.get(EVALUATION),
            )
        return self.load_policy(self.make_env())

    def reasons(self) -> list[str]:
        """Return the sentences on the test, the numbers of the guide, and a budget too small."""
        found = super().reasons()
        values = read_tuned(self.folder, self.numbers)
        if values is not None:
            found.append(numbers_sentence(values, {each.name: each.own for each in self.numbers}))
        return [*found, *beyond_budget(self.folder, self.budget.frames)]

    def _say_next(self) -> None:
        """Print what usually follows: a training with the guide itself, faster than this run."""
        values = read_tuned(self.folder, self.numbers) or {}
        tuned = [*self.words(values)]
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

    def _env_of(self, candidates: Candidates) -> Any:
        """Return what makes the env in which candidates act."""
        (name,) = self.make_env.guides()

        def build(rows: int) -> EnvBase:
            return self.make_env.guided(rows, TESTS, {name: candidates})[0]

        return build

    def _resume(self, tuner: Tuner, metrics: Metrics) -> None:
        """Go on from the last intact checkpoint of the folder; without one begin anew."""
        state = checkpoint.load_newest(self.folder)
        if state is not None:
            newest = self.folder / checkpoint.NEWEST
            with file_of_a_run(newest, PUT_BACK):
                lengths = (self.budget.frames, *self.budget.stages)
                check_identity(state["identity"], self.identity, lengths, newest)
                tuner.load_state_dict(state["tuner"])
        metrics.truncate(len(tuner.told) + 1 if tuner.told else 0)
        say(f"{self.folder} continues after generation {len(tuner.told)}", error=True)

    def _search(self, tuner: Tuner, metrics: Metrics) -> None:
        """Search to the end, with a row of the log and a checkpoint for each generation."""
        frames = self.budget.frames
        with (
            progress(
                total=frames, initial=tuner.cases.steps, unit="frame", unit_scale=True, desc="tune"
            ) as bar,
            STOP.after_update(),
        ):
            while tuner.may_go_on() and not (tuner.told and tuner.converged):
                before = tuner.cases.steps
                means = tuner.generation()
                row = self._row(tuner, means)
                if not metrics.rows:
                    metrics.append(self._first_row(row))
                metrics.append(row)
                metrics.flush()
                bar.update(tuner.cases.steps - before)
                shown = format(row["train/return"], return_format([row["train/return"]]))
                bar.set_postfix({"candidates": shown})
                self._save(tuner)
                if STOP.requested:
                    raise KeyboardInterrupt

    def _row(self, tuner: Tuner, means: Sequence[float]) -> dict[str, float]:
        """Return the row of the log after a generation."""
        row = {
            **dict.fromkeys(self._columns(), math.nan),
            "frames": tuner.cases.steps,
            "frames/before": 0,
            "frames/rollout": 0,
            "frames/tests": tuner.cases.steps,
            "guide/calls": tuner.cases.calls,
            "train/return": sum(means) / len(means),
            "tune/best": max(means),
            "tune/spread": tuner.spread,
        }
        return row | {f"tune/number/{name}": value for name, value in tuner.mean.items()}

    def _first_row(self, row: Mapping[str, float]) -> dict[str, float]:
        """Return the row of the state before the first generation."""
        counted = [name for name in row if name.startswith(("frames", "guide/calls"))]
        own = {f"tune/number/{number.name}": number.own for number in self.numbers}
        return dict.fromkeys(row, math.nan) | dict.fromkeys(counted, 0) | own

    def _columns(self) -> list[str]:
        """Return the names of what the curve measures."""
        if EVALUATION not in self.make_env.sizes:
            return []
        measured = ["return", *(name for group in self.watch.values() for name in group)]
        return [f"{EVALUATION}/{name}" for name in measured]

    def _hand_over(self, tuner: Tuner, metrics: Metrics) -> None:
        """Test which numbers the guide gets, unless that is done, and evaluate the kept ones."""
        with STOP.at_once():
            report = record.DELIVERY.read(self.folder)
            if report is None or not (self.folder / "policy_last.pt").exists():
                report = self._test(tuner)
            tuner.cases.steps, tuner.cases.calls = report.steps, report.calls
            counted = {"frames": report.steps, "frames/tests": report.steps}
            metrics.fill({len(metrics.rows) - 1: counted | {"guide/calls": report.calls}})
            self._fill_curve(metrics)
        self._save(tuner)

    def _test(self, tuner: Tuner) -> record.Delivery:
        """Test, and write the numbers that the guide gets and why; return why."""
        values = {OWN: tuner.own, MEAN: tuner.mean, BEST: tuner.best}
        returns = tuner.test()
        name = chosen(returns)
        record.TUNED.write(self.folder, dict(values[name]))
        for which in ("last", HANDED_OVER):
            checkpoint.save({GUIDE: torch.tensor(0)}, weights_file(self.folder, which))
        report = record.Delivery(
            policy=NAMES[name],
            cases=len(returns[OWN]),
            steps=tuner.cases.steps,
            calls=tuner.cases.calls,
            returns={NAMES[each]: float(found.mean()) for each, found in returns.items()},
        )
        record.DELIVERY.write(self.folder, report)
        return report

    def _save(self, tuner: Tuner) -> None:
        """Write the checkpoint."""
        state = {"tuner": tuner.state_dict(), "identity": self.identity}
        checkpoint.save_newest(state, self.folder)

    def _fill_curve(self, metrics: Metrics) -> None:
        """Evaluate the guide with the numbers of some generations in the cases of the curve."""
        if not self._columns():
            return
        last = len(metrics.rows) - 1
        points = min(self.budget.points, last)
        kept = sorted({round(last * point / points) for point in range(points + 1)})
        guides = [self.make_guide(self._numbers_of(metrics.rows[each])) for each in kept]
        cases = self.make_env.sizes[EVALUATION]
        (name,) = self.make_env.guides()
        env, _ = self.make_env.guided(len(kept) * cases, EVALUATION, {name: Candidates(guides)})
        with torch.random.fork_rng():
            results = measures(env, FollowAdvice(env), cases=cases, watch=self.watch)
        rows: dict[int, dict[str, float]] = {each: {} for each in kept}
        for measured, numbers in results.items():
            means = numbers.view(len(kept), -1).double().mean(1).tolist()
            for each, mean in zip(kept, means, strict=True):
                rows[each][f"{EVALUATION}/{measured}"] = mean
        metrics.fill(rows)

    def _numbers_of(self, row: Mapping[str, float]) -> Values:
        """Return the numbers around which candidates were drawn after a row of the log."""
        return {number.name: row[f"tune/number/{number.name}"] for number in self.numbers}


def beyond_budget(folder: Path, frames: int) -> list[str]:
    """Return the sentence for a search that took more frames than its budget; none for another.

    Raises:
        UserError: if the file is damaged.
    """
    report = record.DELIVERY.read(folder)
    if report is None or report.steps <= frames:
        return []
    return [
        f"The search took {report.steps:,} frames, more than budget.frames={frames:,}: that is "
        "too little for a generation and a test of its result."
    ]


def numbers_sentence(values: Values, own: Values) -> str:
    """Return the sentence that says which numbers a guide got.

    Args:
        values: by name.
    """
    listed = (f"{name} {value:.4g} (its own {own[name]:.4g})" for name, value in values.items())
    return f"The guide's numbers: {', '.join(listed)}; all digits are in {record.TUNED.name}."


def read_tuned(folder: Path, numbers: Sequence[Number]) -> Values | None:
    """Return the numbers that a run found, by name; None if it has found none yet.

    Raises:
        UserError: for a file that holds other numbers, or numbers out of their bounds.
    """
    saved = record.TUNED.read(folder)
    if saved is None:
        return None
    with file_of_a_run(folder / record.TUNED.name, PUT_BACK):
        values = {number.name: saved[number.name] for number in numbers}
        for number in numbers:
            low, high = min(number.low, number.own), max(number.high, number.own)
            if not low <= values[number.name] <= high:
                raise ValueError(f"{number.name} is not between {low:g} and {high:g}")
    return values
