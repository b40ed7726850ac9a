"""A run: one training of one method with one seed, its evaluation, and its folder."""

from __future__ import annotations

import tempfile
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import cached_property
from numbers import Integral
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from coil_rl import record
from coil_rl.errors import NO_SPACE, UserError, is_outside
from coil_rl.foreign.batch import SeededRows
from coil_rl.foreign.controllers import PerRow
from coil_rl.learners.learner import Callback, Learner
from coil_rl.output import decoration, say
from coil_rl.report.curves import draw_learning_curves, draw_phases
from coil_rl.report.runs import EVALUATION, begun_with
from coil_rl.run import checkpoint
from coil_rl.run.beside import Beside, Driver
from coil_rl.run.controller import Controller
from coil_rl.run.curve import Watch, guide_returns
from coil_rl.run.delivery import policy_of
from coil_rl.run.experiment import Experiment
from coil_rl.run.folder import (
    CODE,
    CODE_BEFORE,
    HANDED_OVER,
    changed_code,
    code_of,
    is_begun,
    is_evaluated,
    locked,
    refuse_links,
    report_changed_versions,
    versions,
    weights_file,
    write_config,
)
from coil_rl.run.judge import Judgement, Trial, judge, report_outcome
from coil_rl.run.parts import SOME_ROWS, TEST, TRAIN, EnvMaker, try_out
from coil_rl.run.reasons import SENTENCES, handed_over, line_of, next_step, page_of, start_test
from coil_rl.run.stopping import resume_command

if TYPE_CHECKING:
    import pandas as pd

ACCEPT = "accept"  # what a user says to go on with changed code
# What an interpreter offers of a run; the other names are for the programs.
PUBLIC = (
    *("folder", "label", "seed", "settings", "train", "evaluate", "controller", "policy"),
    *("make_env", "weights"),
)


@dataclass(frozen=True)
class Budget:
    """How much a run learns, and how often it looks at itself.

    Args:
        frames: length of the run; the last batch may exceed it.
        steps: length of a batch in steps of each row.
        rows: number of rows of the training env; None for its own number.
        stages: earlier lengths, in frames, of a run that was made longer.
        points: number of policies that are kept for the evaluation curve, besides the first one.
        batches: number of evaluations of kept policies over the run.
        checkpoint_every: updates between two checkpoints.
    """

    frames: int
    steps: int
    rows: int | None = None
    stages: Sequence[int] = ()
    points: int = 16
    batches: int = 1
    checkpoint_every: int = 10


@contextmanager
def as_before() -> Iterator[None]:
    """Put back the caller's number of threads and random numbers of torch when the block ends."""
    threads = torch.get_num_threads()
    try:
        with torch.random.fork_rng():
            yield
    finally:
        torch.set_num_threads(threads)


@dataclass(eq=False, repr=False)
class Run:
    """One training of one method with one seed, and its evaluation.

    `coil_rl.train` makes one from names, `coil_rl.open_run` from a folder, and this constructor
    from parts. A folder is a run for every program.

    Args:
        folder: for everything that the run writes.
        make_env: makes its envs.
        make_learner: makes its learner for an env; None for a guide alone.
        make_trial: makes what says how it is evaluated.
        budget: how much it learns.
        label: name of the policy in tables and pictures; runs with one label differ by their seed.
        seed: of the learner's first weights, of the exploration and of sampled evaluations.
        watch: further entries to log, see `Experiment`.
        noise_correlation: of the exploration noise, see `Rollout`.
        logger: makes a TorchRL logger, in addition to the CSV file.
        callbacks: makes further callbacks for a learner; `GuideReturns` for one that trains guides.
        prepare: called before the training, for what the learner needs; returns the frames that
            this took.
        init: folder of a run whose last policy, with its normaliser, this one begins with, instead
            of random weights.
        delivery: what the run hands over, "last" for the last policy, or "tested" for what is best
            in a test at the end, see `Delivery`.
        which: policy that is evaluated: "handed_over" or "last".
        beside: what makes further drivers of the evaluation table.
        compiled: whether to compile the steps of env and guides where they can be.
        device: of everything.
        threads: of torch.
        settings: what is written as `config.yaml`: plain values, with `label`, `seed`,
            `method.needs_guide` and `evaluation.measures` for reports.
        identity: values on which the numbers depend, by name; a resumed run must have the same.
        command: what was typed to make the run.
        trust: packages that a command which goes on with it must trust.
        code: returns the SHA-256 of each file of the user that it depends on, by module.
        in_python: whether what to do next is said in Python, not for a shell.

    Example:
        >>> import coil_rl
        >>> run = coil_rl.open_run("outputs/tank")  # doctest: +SKIP
        >>> action = run.controller().act(observation)  # doctest: +SKIP
    """

    folder: Path
    make_env: EnvMaker
    make_learner: Callable[[EnvBase], Learner] | None
    make_trial: Callable[[], Trial]
    budget: Budget
    _: KW_ONLY
    label: str
    seed: int = 0
    watch: Watch = field(default_factory=dict)
    noise_correlation: float = 0.0
    logger: Callable[[], Any] | None = None
    callbacks: Callable[[Learner], Sequence[Callback]] = lambda learner: ()
    prepare: Callable[[], int] = lambda: 0
    init: Path | None = None
    delivery: str = "last"
    which: str = HANDED_OVER
    beside: Sequence[Beside] = ()
    compiled: bool = False
    device: str = "cpu"
    threads: int = 1
    settings: Mapping[str, Any] = field(default_factory=dict)
    identity: Mapping[str, Any] = field(default_factory=dict)
    command: Sequence[str] = ()
    trust: Sequence[str] = ()
    code: Callable[[], Mapping[str, str]] = dict
    in_python: bool = False

    def __repr__(self) -> str:
        return line_of(self)

    def _repr_html_(self) -> str:
        return page_of(self)

    def __dir__(self) -> Iterable[str]:
        return PUBLIC

    def __post_init__(self) -> None:
        self.folder = Path(self.folder).absolute()  # the working folder may change
        if not self.settings:
            self.settings = self._settings_of_parts()
        if not self.identity:
            self.identity = {"label": self.label, "budget.frames": self.budget.frames}

    @cached_property
    def trial(self) -> Trial:
        """How the run is evaluated."""
        return self.make_trial()

    @property
    def has_agent(self) -> bool:
        """Whether the run has a policy, and not only a guide that acts alone."""
        return self.make_learner is not None

    @property
    def resume_command(self) -> str:
        """What continues the run, as a shell or Python reads it."""
        if self.in_python:
            trust = f", trust={list(self.trust)}" if self.trust else ""
            return f"coil_rl.open_run({str(self.folder)!r}{trust}).train()"
        return resume_command(self.folder, self.trust)

    def weights(self, which: str) -> Path:
        """Return the file of a policy, "handed_over" or "last".

        Raises:
            UserError: for another name.
        """
        if which not in (HANDED_OVER, "last"):
            raise UserError(
                f"which={which!r} must be {HANDED_OVER} or last; with delivery=tested a run hands "
                "over what is best in a test at its end"
            )
        return weights_file(self.folder, which if self.delivery == "tested" else "last")

    @as_before()
    def train(self, frames: int | None = None, *, changed: str = "") -> Run:
        """Train to the end, evaluate, and return the run.

        A run that was stopped, or is shorter, goes on.

        Args:
            frames: new length of the run. Schedules over the run, such as a learning rate, then
                refer to the new length.
            changed: "accept" to go on although the code of the env or of another part was changed
                since the run began.

        Raises:
            UserError: if another process uses the folder, if it holds another run, its code was
                changed or a link leads out of it, if the run is longer than `frames`, or if that is
                no whole number.
        """
        if is_begun(self.folder):
            refuse_links(self.folder)
        with locked(self.folder):
            if frames is not None:
                self.lengthen(whole("frames", frames), changed)
            if is_begun(self.folder):
                self.finish_begun(changed)
            else:
                self.begin()
                self.finish()
        return self

    @as_before()
    def evaluate(self, cases: int | None = None, folder: str | Path | None = None) -> pd.DataFrame:
        """Evaluate the policy and the guides, and return the rows of `evaluation.csv`.

        Args:
            cases: number of cases, for an env whose cases are numbered; by default those of the
                run.
            folder: for tables and pictures; by default they are not kept.

        Raises:
            UserError: if the cases of the env have names, so that there is no other number of them,
                or for a number below 1.
        """
        import pandas as pd  # a training does without it

        trial = self.trial
        if cases is not None:
            trial = trial_with_cases(trial, whole("cases", cases))
        if folder is None:
            trial = replace(trial, pictures=[])
        with tempfile.TemporaryDirectory() as temporary:
            place = Path(temporary) if folder is None else Path(folder).expanduser()
            judgement = self.judge(trial, place, self.seed)
        return pd.DataFrame(judgement.rows)

    def judge(self, trial: Trial, folder: Path, seed: int) -> Judgement:
        """Evaluate the policy of a finished run and the guides; see `judge`."""
        env = trial.env(SOME_ROWS)  # not of the training, whose env may be another
        self.try_out(env)
        policy = self.policy(env)
        return judge(trial, policy, folder, seed, self.drivers(policy))

    def controller(self, which: str | None = None) -> Controller:
        """Return what a machine is sent: the policy with guide, normaliser and memory inside.

        Args:
            which: policy, "handed_over" or "last"; by default the one that is evaluated.

        Raises:
            UserError: if the policy is missing, or for another name.
        """
        which = self.which if which is None else which
        self.weights(which)
        if not self.has_agent:
            env, policy = self.make_env.guided(1, TRAIN)
            self.try_out(env)
            return Controller(env, policy, self.folder)
        env = self.make_env(1, TRAIN)
        self.try_out(env)
        return Controller(env, self.policy(env, which), self.folder, which)

    def try_out(self, env: EnvBase) -> None:
        """Try what others wrote of the run, and warn of what is found; see `Trial`.

        Args:
            env: of the run, which shows whether there is anything.
        """
        names = changed_code(self.folder, self.code()) if is_begun(self.folder) else ""
        if names:
            warnings.warn(
                f"{self.folder} was trained with another file of {names}: what follows is of the "
                "present one",
                stacklevel=2,
            )
        if any(isinstance(part, (SeededRows, PerRow)) for part in env.modules()):
            try_out(self.make_env.bare(SOME_ROWS, TEST, None), self.make_env.guides())

    def policy(self, env: EnvBase | None = None, which: str | None = None) -> Any:
        """Return the policy of a finished run for an env; None without an agent.

        Args:
            env: of the run, such as `run.make_env(rows)`; by default a new one.
            which: policy, "handed_over" or "last"; by default the one that is evaluated.

        Raises:
            UserError: if the policy is missing, damaged, or does not fit the configuration.
        """
        if not self.has_agent:
            return None
        env = self.make_env() if env is None else env
        return self._loaded(self.new_policy(env), env, which or self.which)

    def begin(self) -> None:
        """Write the versions, the command and the configuration of a new run.

        Raises:
            UserError: if the folder holds one already.
        """
        if is_begun(self.folder):
            raise UserError(
                f"{self.folder} already holds a run; resume it with "
                f"{resume_command(self.folder, self.trust)}, or choose another folder with "
                "hydra.run.dir=FOLDER"
            )
        record.VERSIONS.write(self.folder, versions())
        if self.command:
            record.COMMAND.write(self.folder, list(self.command))
        code = dict(self.code())
        write_config(self.folder, {**self.settings, **({CODE: code} if code else {})})

    def lengthen(self, frames: int, changed: str = "") -> None:
        """Set a new length, before the run goes on.

        Args:
            changed: as of `train`.

        Raises:
            UserError: if the run has been trained for longer, or its configuration or its code was
                changed.
        """
        budget = self.budget
        if frames == budget.frames:
            return
        if frames < budget.frames:
            raise UserError(
                f"{self.folder} has budget.frames={budget.frames}, more than {frames}; give a "
                "larger number, or train another run"
            )
        begun = is_begun(self.folder)
        if begun:
            checkpoint.go_on(self)
            self._take_code(changed)
        stages = [*budget.stages, budget.frames] if begun else []
        self.budget = replace(budget, frames=frames, stages=stages)
        saved = dict(self.settings.get("budget", {})) | {"frames": frames, "stages": stages}
        self.settings = dict(self.settings) | {"budget": saved}
        self.identity = dict(self.identity) | {"budget.frames": frames, "budget.stages": stages}
        if not begun:
            return
        # With a new length and an evaluation it would be a finished run.
        for file in (record.EVALUATION, record.PAGE, record.SECONDS, record.DELIVERY):
            (self.folder / file.name).unlink(missing_ok=True)
        write_config(self.folder, {**self.settings, **code_of(self.folder)})
        say(
            f"{self.folder} goes on from {budget.frames:,} to {frames:,} frames; schedules over "
            f"the run, such as a learning rate, go on at {budget.frames / frames:.0%} of their way",
            error=True,
        )

    def finish_begun(self, changed: str = "") -> float:
        """Finish the run in the folder, and return the mean test reward of its policy.

        Args:
            changed: as of `train`.

        Raises:
            UserError: if its configuration or its code was edited since it began.
        """
        if is_evaluated(self.folder):
            checkpoint.go_on(self)
            say(f"{self.folder} is finished already, and not trained or drawn again", error=True)
            reward = report_outcome(self.folder)
            self._say_next()
            return reward
        self._take_code(changed)
        return self.finish(resumed=True)

    def _take_code(self, changed: str) -> None:
        """Go on with the code as it is; a `UserError` if it was changed and nobody accepts that."""
        if changed not in ("", ACCEPT):
            raise UserError(f"changed={changed} must be {ACCEPT}, or be left out")
        present = dict(self.code())
        names = changed_code(self.folder, present)
        if names and changed != ACCEPT:
            raise UserError(
                f"{self.folder} was begun with another file of {names}, so one curve would be of "
                "two tasks; put the file back, train another run, or go on with "
                f"{resume_command(self.folder, self.trust)} changed={ACCEPT}"
            )
        if names:
            begun = code_of(self.folder)
            before = begun.get(CODE_BEFORE, {}) | begun[CODE]
            saved = {**self.settings, CODE: present, CODE_BEFORE: before}
            write_config(self.folder, saved)
            (self.folder / record.GUIDE_RETURNS.name).unlink(missing_ok=True)  # of the other code
            say(f"{self.folder} goes on with another file of {names}", error=True)

    def finish(self, *, resumed: bool = False) -> float:
        """Train and evaluate in the folder, which is locked and holds the configuration."""
        torch.set_num_threads(self.threads)
        try:
            if resumed:
                report_changed_versions(self.folder)
            policy = self.learn(resumed=resumed) if self.has_agent else None
            drivers = self.drivers(policy)
            trial = replace(self.trial, notes=[*self.trial.notes, *self.reasons()])
            judge(trial, policy, self.folder, self.seed, drivers)
            reward = report_outcome(self.folder)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(f"continue with: {self.resume_command}") from None
        except ValueError as error:  # of env or controller, before or after the training
            if not is_outside(error):
                raise
            raise UserError(
                f"{error}; what is finished is kept: correct the cause and continue with "
                f"{self.resume_command}"
            ) from error
        except OSError as error:
            if error.errno not in NO_SPACE:
                raise
            raise UserError(
                f"{error.filename or self.folder} cannot be written ({error.strerror}); make room, "
                f"and continue with {self.resume_command}"
            ) from error
        self._say_next()
        return reward

    def _say_next(self) -> None:
        """Print what usually follows a training."""
        if not self.has_agent:
            return
        rows, frames = record.METRICS.need(self.folder), self.budget.frames
        say(next_step(self.folder, frames, rows, self.trust, in_python=self.in_python))

    def learn(self, *, resumed: bool = False) -> TensorDictModuleBase:
        """Train, draw the learning curve and return the policy to evaluate."""
        before = self.prepare()
        torch.set_num_threads(self.threads)  # what prepares may have set another number
        guide_returns = self._saved_guide_returns()
        # After the guides, which a resumed run does not evaluate again.
        torch.manual_seed(self.seed)
        training = self.training(before)
        if resumed:
            training.resume()
        start = time.monotonic()
        rows = training.run(max(guide_returns.values(), default=None))
        if not resumed:  # the time before the interruption is unknown
            record.SECONDS.write(self.folder, {"seconds": time.monotonic() - start})
        learner, path = training.learner, self.folder / "learning_curve.png"
        with decoration(f"the learning curve in {self.folder}"):
            if learner is not None and learner.kind == "guides":
                draw_phases(rows, list(learner.guides), path, title=self.label)
            else:
                cases = self.make_env.sizes.get(EVALUATION)
                draw_learning_curves({self.label: [rows]}, path, guides=guide_returns, cases=cases)
        training.metrics.close()
        if learner is None:
            return self.policy()
        learner.export(self.folder)
        return self._loaded(learner.policy, training.rollout.env, self.which)

    def training(self, before: int) -> Any:
        """Return the training, an `Experiment`; a search for numbers has no learner.

        Args:
            before: frames that were taken before it.
        """
        return Experiment(self, before)

    def _saved_guide_returns(self) -> dict[str, float]:
        """Return the mean return of each guide in the cases of the curve, measured once.

        It is empty without such cases.
        """
        returns = record.GUIDE_RETURNS.read(self.folder)
        if returns is None:
            returns = guide_returns(self.make_env, self.make_env.guides())
            record.GUIDE_RETURNS.write(self.folder, returns)
        return returns

    def require_agent(self) -> Callable[[EnvBase], Learner]:
        """Return what makes the learner of the run for an env.

        Raises:
            UserError: for a run without an agent.
        """
        if self.make_learner is None:
            raise UserError(
                f"{self.folder} has no agent: its guide drives alone; give that guide instead"
            )
        return self.make_learner

    def new_policy(self, env: EnvBase) -> TensorDictModuleBase:
        """Return a policy as the run has, for an env with its transforms, with first weights."""
        return self.require_agent()(env).policy

    def _loaded(
        self, policy: TensorDictModuleBase, env: EnvBase, which: str
    ) -> TensorDictModuleBase:
        """Return a policy with the weights of a file, or the guide for which that file stands.

        Args:
            policy: of the learner.
            env: with the transforms of the run.
            which: "handed_over" or "last".

        Raises:
            UserError: if the file is missing, damaged, or does not fit the policy.
        """
        path = self.weights(which)
        return policy_of(checkpoint.load(path, self.device), policy, env, path)

    def reasons(self) -> list[str]:
        """Return the sentences on how the training began, and on its tests."""
        rows = record.METRICS.need(self.folder) if self.has_agent else []
        found = start_test(rows[0]) if rows else []
        if (source := begun_with(self.settings)) is not None:
            found += SENTENCES.said("begun", source=source)
        if self.which == HANDED_OVER and self.delivery == "tested":
            found += handed_over(self.folder)
        return found

    def in_env(
        self, env: EnvBase, which: str = HANDED_OVER
    ) -> tuple[EnvBase, TensorDictModuleBase]:
        """Return any env with the guides and transforms of the run, and the policy of the run.

        The own env and tracks of the run are not built. Arguments and errors are those of
        `policy`; a policy that cannot act in this env is a `UserError` too.
        """
        self.require_agent()
        try:
            transformed = self.make_env.around(env)
            return transformed, self.policy(transformed, which)
        except UserError as error:
            raise UserError(f"run {self.folder}: {error}") from error

    def drivers(self, policy: TensorDictModuleBase | None) -> list[Driver]:
        """Return the further drivers of the evaluation table, given the policy."""
        return [each.driver(self, policy) for each in self.beside]

    def _settings_of_parts(self) -> dict[str, Any]:
        """Return what reports need of a run that was made from parts."""
        measures = self.trial.evaluation.measures.items()
        return {
            "made_from_parts": True,
            "label": self.label,
            "seed": self.seed,
            "method": {"name": self.label, "needs_guide": bool(self.trial.guides)},
            "budget": {"frames": self.budget.frames, "steps": self.budget.steps},
            "evaluation": {"measures": {name: each.node() for name, each in measures}},
        }


def whole(name: str, number: Any) -> int:
    """Return a number of things that somebody gave.

    Raises:
        UserError: if it is no whole number, or below 1.
    """
    if isinstance(number, bool) or not isinstance(number, Integral) or number < 1:
        raise UserError(f"{name}={number!r} must be a whole number of at least 1")
    return int(number)


def trial_with_cases(trial: Trial, cases: int) -> Trial:
    """Return a trial with another number of cases.

    Raises:
        UserError: if the cases have names, such as tracks.
    """
    names = list(trial.evaluation.cases)
    if names != list(map(str, range(len(names)))):
        raise UserError(
            f"cases={cases}: the cases of this env have names ({', '.join(names[:3])} ...), so "
            "there is no other number of them; leave it out"
        )
    evaluation = replace(trial.evaluation, cases=list(map(str, range(cases))))
    return replace(trial, evaluation=evaluation, count=cases)
