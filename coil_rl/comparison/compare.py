"""A comparison of a guide with policies that learn with it and without it, in a few minutes."""

import math
import shlex
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from omegaconf import DictConfig

from coil_rl.comparison import timing
from coil_rl.comparison.arms import (
    ANCHORED,
    ARMS,
    PPO,
    RANDOM,
    SAC,
    TUNE,
    Arm,
    arms_for,
    check_words,
    job_of,
    short_words,
)
from coil_rl.comparison.baselines import (
    measure_baselines,
    measure_delayed,
    measure_network,
    read_baselines,
)
from coil_rl.comparison.entry import IDLE, Entry
from coil_rl.comparison.jobs import job_name, run_jobs
from coil_rl.comparison.outcome import Outcome, first_of, read_outcome
from coil_rl.comparison.page import command_of, delayed_sentence, draw, page_of
from coil_rl.comparison.same import identity_of, keep_plan, known_plan
from coil_rl.comparison.timing import Plan
from coil_rl.comparison.verdict import NOTHING, Verdict, verdict
from coil_rl.config.check import check_read
from coil_rl.config.compose import Composed
from coil_rl.config.parts import env_maker
from coil_rl.config.python import Named, checked, composed, named, new_folder
from coil_rl.config.trust import trust_own
from coil_rl.errors import UserError
from coil_rl.files import FAILED_JOBS, write_text
from coil_rl.output import decoration, quietly, say
from coil_rl.record import json_file
from coil_rl.report import write_csv
from coil_rl.run.folder import is_evaluated, locked
from coil_rl.run.parts import TEST
from coil_rl.run.run import as_before

TABLE, PAGE, PICTURE = "compare.csv", "compare.md", "compare.png"
FOUND = json_file("verdict.json", dict[str, Any], "compare again")


@dataclass(frozen=True)
class Worth:
    """What a comparison found.

    Attributes:
        folder: with the runs, the table, the page and the picture.
        verdict: what to use, and why.
        table: one row for each policy.
        command: that trains what is recommended to the end; empty for none.
        page: for people.
    """

    folder: Path
    verdict: Verdict
    table: pd.DataFrame
    command: str
    page: str


@as_before()
def compare(
    env: Any,
    *,
    guide: Any,
    tune: Mapping[str, Any] | str | None = None,
    minutes: float = 2.0,
    frames: int | None = None,
    seed: int = 0,
    folder: str | Path | None = None,
    overrides: Sequence[str] = (),
) -> Worth:
    """Say whether a guide is worth it, and what to use, after a few minutes.

    Args:
        env: as for `train`.
        guide: as for `train`.
        tune: bounds of numbers of the guide by name, which are tuned too: [low, high] or [low,
            high, "log"]; "auto" for those that the guide knows.
        minutes: that it may take, about; it takes longer where an env or a guide is too slow.
        frames: of a whole training, of which each job here gets a tenth at most; by default those
            of the env's file.
        seed: of the first trainings; the others have the next one.
        folder: for everything that is written; one that holds this comparison goes on with it. By
            default a new one in outputs/compare.
        overrides: further words of the command line, such as "learner.gamma=0.98".

    Raises:
        UserError: for a mistake in an argument, with one sentence that says what to do.

    Example:
        >>> import coil_rl
        >>> found = coil_rl.compare("Pendulum-v1", guide="swing_up")  # doctest: +SKIP
        >>> print(found.page)  # doctest: +SKIP
    """
    place = new_folder("compare") if folder is None else Path(folder).expanduser()
    given = named(env, guide, str(place))
    words = [*given.words, *overrides]
    if frames is not None:
        words.append(f"budget.frames={frames}")
    if tune is not None:
        given.nodes["tune"] = tune if isinstance(tune, str) else dict(tune)
    return Comparison(Named(words, given.nodes), place, minutes=minutes, seed=seed).run()


class Comparison:
    """A comparison in a folder, new or begun before.

    Args:
        given: env, guide and everything else that was given.
        folder: of the comparison; each training has a folder in it.
        minutes: that it may take, about.
        seed: of the first trainings.
        command: by which it goes on if it is stopped; empty for none.

    Raises:
        UserError: for a word that a comparison decides itself, for no time, and for a file where
            the folder is to be.
    """

    def __init__(
        self,
        given: Named,
        folder: Path,
        *,
        minutes: float = 2.0,
        seed: int = 0,
        command: str = "",
    ) -> None:
        check_words(given.words)
        if not 0 < minutes < math.inf:
            raise UserError(f"minutes={minutes:g} must be above 0; 2 is the default")
        if folder.is_file():
            raise UserError(f"folder={folder} is a file; give a folder, or a name that is not used")
        self.given, self.folder, self.minutes, self.seed = given, folder, minutes, seed
        self.command = command

    def run(self) -> Worth:
        """Compare, or go on with it, and return what was found; the page is written and printed.

        Raises:
            UserError: for a mistake in what was given, for a folder that holds something else, and
                if another process uses the folder.
        """
        start = time.process_time()
        config = self._checked()
        torch.set_num_threads(config.threads)  # as the trainings, whose steps are timed
        overhead = time.process_time() - start
        identity = identity_of(self.given, config, self.minutes, self.seed)
        plan = known_plan(self.folder, identity)
        if plan is not None:
            say(f"{self.folder} goes on. {plan.described(self.minutes)}", error=True)
        else:
            plan = self._plan(config, overhead)
        with locked(self.folder):  # nothing is made before there is a plan
            plan = known_plan(self.folder, identity) or plan
            keep_plan(self.folder, identity, plan)
            (self.folder / FAILED_JOBS).unlink(missing_ok=True)
            short = short_words(self.given.words, config, plan.cases)
            with quietly():
                base = self._composed(ANCHORED, plan.frames[ANCHORED], short).config
                measure_baselines(base, self.folder)
            failed = run_jobs(self._jobs(plan, short), self.folder)
            return self._judge(plan, base, failed)

    @property
    def tunes(self) -> bool:
        """Whether numbers of the guide are tuned."""
        return "tune" in self.given.nodes

    def _checked(self) -> DictConfig:
        """Return the configuration of plain PPO with its whole budget, after a check of all."""
        made = self._composed(ANCHORED)
        anchored = made.config
        if len(anchored.guide) != 1:
            found = ", ".join(map(str, anchored.guide)) or "none"
            raise UserError(
                f"guide: a comparison is about one guide, but there is {found}; give guide=NAME, "
                "or guide=controller guide.controller.of=MODULE:NAME"
            )
        trust_own(anchored)
        checked(made)
        # A word that this arm does not read is read by no arm, as it has every part that one may
        # have: a learner, advice and tests.
        check_read(anchored, self.given.words)
        if self.tunes:
            checked(self._composed(TUNE))
        return self._composed(PPO).config

    def _composed(
        self, name: str, frames: int | None = None, short: Sequence[str] = ()
    ) -> Composed:
        """Return the configuration of an arm, by default with the whole budget."""
        job = job_of(self.given, ARMS[name], self.seed, frames, short)
        return composed(job, self.folder / name)

    def _plan(self, config: DictConfig, overhead: float) -> Plan:
        """Return what is going to be done in a new comparison, and say it.

        Args:
            config: of plain PPO with its whole budget.
            overhead: s, CPU time to prepare a training.
        """
        if any(self.folder.rglob("config.yaml")):
            raise UserError(f"{self.folder} holds runs of something else; choose another folder")
        if self.command:
            say(f"if this is stopped, go on with: {self.command}", error=True)
        say("coil-compare: timing the env and the guide", error=True)
        with quietly():
            arms = self._able(arms_for(env_maker(config).bare(1, TEST, None), tunes=self.tunes))
            plain = {PPO: config}
            if any(arm.learner == SAC for arm in arms):
                # It is timed from its first update on, which takes as long as any other.
                plain[SAC] = self._composed(SAC, short=["learner.starts=1"]).config
            pace = timing.measure(plain, overhead)
        plan = timing.plan(plain, pace, arms, self.minutes)
        say(f"{pace.sentence}\n{plan.described(self.minutes)}", error=True)
        return plan

    def _able(self, arms: Sequence[Arm]) -> list[Arm]:
        """Return the arms that can learn with what was given; say why others cannot."""
        able = []
        for arm in arms:
            try:
                if arm.learner == SAC:  # the others are checked already
                    checked(self._composed(arm.name))
            except UserError as error:
                say(f"coil-compare: {arm.name} is left out: {error}", error=True)
            else:
                able.append(arm)
        return able

    def _jobs(self, plan: Plan, short: Sequence[str]) -> dict[str, Named]:
        """Return what each training consists of, by its name; each seed of all arms in turn."""
        jobs = {}
        for seed in range(self.seed, self.seed + plan.seeds):
            for name, frames in plan.frames.items():
                job = job_of(self.given, ARMS[name], seed, frames, short)
                jobs[job_name(name, seed)] = job
        return jobs

    def _judge(self, plan: Plan, base: DictConfig, failed: Mapping[str, str]) -> Worth:
        """Write and print what was found."""
        with quietly():
            for plain in filter(is_evaluated, sorted(self.folder.glob(job_name(PPO, "*")))):
                measure_network(self.folder, plain)
            outcome = read_outcome(self.folder, plan.arms, failed)
            found = verdict(
                outcome.entries, [name for name in plan.arms if name not in outcome.runs]
            )
            delayed = self._delayed(found, outcome, base)
        command = command_of(self.given, found)
        page = page_of(found, outcome, delayed, self._steps(outcome), command)
        write_csv(outcome.rows, self.folder / TABLE)
        write_text(self.folder / PAGE, f"{page}\n")
        FOUND.write(self.folder, found.to_dict(command))
        more = ""
        if outcome.runs:
            with decoration(f"the picture in {self.folder}"):
                draw(outcome, base.evaluation.curve.num_envs, self.folder / PICTURE)
            more = f"; {shlex.join(['coil-report', f'folder={self.folder}'])} has more"
        say(f"{page}\nSee {self.folder}{more}.")
        return Worth(self.folder, found, pd.DataFrame(outcome.rows), command, page)

    def _delayed(self, found: Verdict, outcome: Outcome, base: DictConfig) -> list[str]:
        """Return the sentence about a delay of a guide or policy; none for everything else."""
        if found.use in (NOTHING, *IDLE):
            return []
        run = first_of(outcome, found.use)
        with decoration("the delay"):
            table = measure_delayed(found.use, None if run is None else run.folder, base)
            entry = outcome.entries[found.use]
            late = Entry(found.use, table["reward"].to_numpy()[None])
            write_csv(table.to_dict("records"), self.folder / "delayed.csv")
            return delayed_sentence(entry, late, outcome.entries[RANDOM])
        return []

    def _steps(self, outcome: Outcome) -> int:
        """Return the env steps that only measured: all episodes of the table."""
        runs = [run for each in outcome.runs.values() for run in each]
        tables = [pd.read_csv(run.folder / "episodes.csv") for run in runs]
        return sum(int(table["steps"].sum()) for table in [*tables, read_baselines(self.folder)])
