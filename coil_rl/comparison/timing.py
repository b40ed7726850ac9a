"""How long a comparison takes: a step of the env and of the guide, a batch of training, a plan."""

import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from omegaconf import DictConfig
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from coil_rl.comparison.arms import POINTS, SAC, SAC_UPDATE, SHARE, TUNE, Arm, curve_cases
from coil_rl.comparison.baselines import Acting
from coil_rl.config.parts import build_learner, env_maker
from coil_rl.run.evaluation import episodes
from coil_rl.run.parts import TEST, EnvMaker
from coil_rl.run.rollout import Rollout

EPISODES = 2  # whose length is measured
LONGEST = 1000  # steps of these
ROWS, STEPS = 16, 32  # of the env in which a step is timed: many rows share what a step costs
LEAST_BATCHES = 4  # of a training: with fewer there is nothing to compare
LEAST_CASES = 5
MEASURING = 0.4  # share of the time that the evaluations may take
SEEDS = 2


@dataclass(frozen=True)
class Pace:
    """Measured times, in seconds, and lengths of episodes.

    Args:
        step: of a step of one row of the env.
        guide: of one action of the guide.
        learning: of a frame of plain training: step, policy and update.
        length: steps of an episode, of the guide or of random actions, whichever is longer.
        overhead: to prepare a training.
    """

    step: float
    guide: float
    learning: float
    length: float
    overhead: float

    @property
    def sentence(self) -> str:
        """What was measured, for people."""
        return (
            f"A step of the env takes {1000 * self.step:.2f} ms, an action of the guide "
            f"{1000 * self.guide:.2f} ms, a frame of training {1000 * self.learning:.2f} ms; an "
            f"episode has about {self.length:.0f} steps."
        )


@dataclass(frozen=True)
class Plan:
    """What a comparison is going to do.

    Args:
        frames: of each job.
        cases: of the table; None for those of the env's file.
        arms: names of what learns.
        seeds: number of trainings of each.
        seconds: that it takes, about.
    """

    frames: int
    cases: int | None
    arms: Sequence[str]
    seeds: int
    seconds: float

    @property
    def jobs(self) -> int:
        """Number of trainings."""
        return len(self.arms) * self.seeds

    def described(self, minutes: float) -> str:
        """Return what is going to be done, for people.

        Args:
            minutes: that it may take.
        """
        more = ""
        if self.seconds > 1.3 * 60 * minutes:
            more = f" (minutes={minutes:g} is not enough: each training needs a few batches)"
        return (
            f"It runs {self.jobs} trainings of {self.frames:,} frames each "
            f"({', '.join(self.arms)}; {self.seeds} seeds), beside the guide, its opposite, zero, "
            "random actions and the first network, and takes about "
            f"{_duration(self.seconds)}{more}."
        )


def _duration(seconds: float) -> str:
    """Return a duration in words."""
    if seconds < 90:
        return f"{max(seconds, 1):.0f} s"
    return f"{seconds / 60:.1f} min"


def measure(config: DictConfig, overhead: float) -> Pace:
    """Time a step of the env and of the guide, and a batch of training.

    Args:
        config: of a training with plain PPO, with a guide.
        overhead: seconds to prepare a training.
    """
    make_env = env_maker(config)
    with torch.random.fork_rng():
        env, follow = make_env.guided(EPISODES, TEST)
        length = _length(env, follow)
        env = make_env.plain(EPISODES, TEST)
        length = max(length, _length(env, Acting.random(env)))
        guided = _step(*make_env.guided(ROWS, TEST))
        env = make_env.plain(ROWS, TEST)
        plain = _step(env, Acting.random(env))
        learning = _batch(config, make_env)
    guide = max(guided - plain, 0.0)
    return Pace(plain, guide, max(learning, plain), length, overhead)


def _length(env: EnvBase, policy: TensorDictModuleBase) -> float:
    """Return the mean number of steps of an episode; one that does not end counts as `LONGEST`."""
    rows = env.batch_size.numel()
    steps = torch.zeros(rows)
    for _, running in itertools.islice(episodes(env, policy), LONGEST):
        steps += running.reshape(rows, -1)[:, 0].cpu()
    return float(steps.mean())


def _step(env: EnvBase, policy: TensorDictModuleBase) -> float:
    """Return the seconds of a step of one row; the first step may prepare something."""
    steps = itertools.islice(episodes(env, policy), STEPS + 1)
    next(steps)
    start = time.perf_counter()
    count = sum(1 for _ in steps)
    return (time.perf_counter() - start) / (max(count, 1) * env.batch_size.numel())


def _batch(config: DictConfig, make_env: EnvMaker) -> float:
    """Return the seconds of a frame of training, with its share of the update."""
    env = make_env()
    learner = build_learner(config, env)
    keys = [*learner.keys, ("next", "done"), ("next", "reward"), ("next", "episode_reward")]
    rollout = Rollout(env, learner.policy, config.budget.steps, keys)
    start = time.perf_counter()
    learner.update(rollout.collect(), 0.0)
    return (time.perf_counter() - start) / rollout.frames


def plan(config: DictConfig, pace: Pace, arms: Sequence[Arm], minutes: float) -> Plan:
    """Return how many frames each job gets, and how long everything takes.

    A job gets a tenth of the budget, or what the minutes allow, in whole batches of PPO, but at
    least a few of them.

    Args:
        minutes: that it may take.
    """
    cases = _cases(config, pace, arms, minutes)
    fixed = _measuring(config, pace, arms, cases)
    other = {TUNE: pace.step, SAC: pace.step + SAC_UPDATE}
    each = [other.get(arm.name, pace.learning) for arm in arms]
    a_frame = SEEDS * sum(
        cost + pace.guide * arm.asks for cost, arm in zip(each, arms, strict=True)
    )
    batch = config.budget.num_envs * config.budget.steps
    tenth = max(round(SHARE * config.budget.frames / batch), LEAST_BATCHES)
    affordable = int((60 * minutes - fixed) / a_frame / batch)
    batches = min(max(affordable, LEAST_BATCHES), tenth)
    frames = min(batches * batch, config.budget.frames)
    number = cases if isinstance(config.evaluation.cases, int) else None
    names = [arm.name for arm in arms]
    return Plan(frames, number, names, SEEDS, fixed + frames * a_frame)


def _cases(config: DictConfig, pace: Pace, arms: Sequence[Arm], minutes: float) -> int:
    """Return the number of cases of the table, fewer than the env's if they take too long."""
    given = config.evaluation.cases
    if not isinstance(given, int):
        return len(given)
    allowed = MEASURING * 60 * minutes / (_measuring(config, pace, arms, given) / given)
    return min(given, max(int(allowed), LEAST_CASES))


def _measuring(config: DictConfig, pace: Pace, arms: Sequence[Arm], cases: int) -> float:
    """Return the seconds that all evaluations take."""
    curve = (POINTS + 1) * curve_cases(config, cases)
    baselines = cases * pace.length * (5 * pace.step + 3 * pace.guide)
    jobs = 0.0
    for arm in arms:
        asked = pace.step + pace.guide * arm.asks
        jobs += SEEDS * ((curve + 3 * cases) * pace.length * asked + pace.overhead)
    return baselines + jobs
