"""How long a comparison takes: a step of the env and of the guide, a batch of training, a plan."""

import itertools
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike
from omegaconf import DictConfig
from torchrl.envs import EnvBase

from coil_rl.comparison.arms import (
    POINTS,
    PPO,
    SAC,
    SHARE,
    TESTED_CASES,
    Arm,
    curve_cases,
)
from coil_rl.comparison.baselines import Policy, uniform
from coil_rl.comparison.sentences import COMPARE
from coil_rl.config.parts import build_learner, env_maker
from coil_rl.run.evaluation import episodes
from coil_rl.run.parts import TEST
from coil_rl.run.rollout import Rollout

EPISODES = 2  # whose length is measured
LONGEST = 1000  # steps of these
ROWS, STEPS = 16, 32  # of the env in which a step is timed: many rows share what a step costs
TIMED = 128  # frames of training, at least
LEAST_BATCHES = 4  # of a training: with fewer there is nothing to compare
LEAST_FRAMES = 2_000  # of a training with replay, whose batches are small
FEWEST_CASES = 5  # of the table
MEASURING = 0.4  # share of the time that the evaluations may take
SEEDS = 2


@dataclass(frozen=True)
class Pace:
    """Measured times, in seconds, and lengths of episodes.

    Args:
        step: of a step of one row of the env.
        guide: of one action of the guide.
        learning: of a frame of plain training, by learner: step, policy and update.
        length: steps of an episode, of the guide or of random actions, whichever is longer.
        overhead: to prepare a training.
    """

    step: float
    guide: float
    learning: Mapping[str, float]
    length: float
    overhead: float

    @property
    def sentence(self) -> str:
        """What was measured, for people."""
        return COMPARE.said("pace", pace=self)[0]


@dataclass(frozen=True)
class Plan:
    """What a comparison is going to do.

    Args:
        frames: of each job of an arm, by its name.
        cases: of the table; None for those of the env's file.
        seeds: number of trainings of each.
        seconds: that it takes, about.
    """

    frames: Mapping[str, int]
    cases: int | None
    seeds: int
    seconds: float

    @property
    def arms(self) -> list[str]:
        """Names of what learns."""
        return list(self.frames)

    @property
    def jobs(self) -> int:
        """Number of trainings."""
        return len(self.frames) * self.seeds

    def described(self, minutes: float) -> str:
        """Return what is going to be done, for people.

        Args:
            minutes: that it may take.
        """
        is_enough = self.seconds <= 1.3 * 60 * minutes
        return COMPARE.said("plan", plan=self, minutes=minutes, is_enough=is_enough)[0]


def measure(plain: Mapping[str, DictConfig], overhead: float) -> Pace:
    """Time a step of the env and of the guide, and batches of training.

    Args:
        plain: configurations of trainings that do not ask the guide, by learner; PPO's is among
            them.
        overhead: seconds to prepare a training.
    """
    make_env = env_maker(plain[PPO])
    with torch.random.fork_rng():
        env, follow = make_env.guided(EPISODES, TEST)
        length = _length(env, follow)
        env = make_env.plain(EPISODES, TEST)
        length = max(length, _length(env, uniform(env)))
        guided, _ = _stepped(*make_env.guided(ROWS, TEST))
        env = make_env.plain(ROWS, TEST)
        seconds, waiting = _stepped(env, uniform(env))
        step = seconds / ROWS
        learning = {name: _frame(config) + waiting / ROWS for name, config in plain.items()}
    learning = {name: max(frame, step) for name, frame in learning.items()}
    return Pace(step, max(guided / ROWS - step, 0.0), learning, length, overhead)


def _length(env: EnvBase, policy: Policy) -> float:
    """Return the mean number of steps of an episode; one that does not end counts as `LONGEST`."""
    rows = env.batch_size.numel()
    steps = torch.zeros(rows)
    for _, _, running in itertools.islice(episodes(env, policy), LONGEST):
        steps += running.reshape(rows, -1)[:, 0].cpu()
    return float(steps.mean())


def seconds_of(laps: ArrayLike) -> tuple[float, float]:
    """Return the mean seconds of a piece of work, and those that it waits.

    They do not depend on what else the machine does: it is the processor's time of this process,
    and what even the fastest piece waited besides, such as for a process or a device.

    Args:
        laps: seconds of each piece, on the wall and of the processor, [pieces, 2].
    """
    wall, own = np.asarray(laps).T
    waiting = max(float((wall - own).min()), 0.0)
    return float(own.mean()) + waiting, waiting


def _stepped(env: EnvBase, policy: Policy) -> tuple[float, float]:
    """Return `seconds_of` steps of all rows; the first step may prepare something."""
    times = [
        (time.perf_counter(), time.process_time())
        for _ in itertools.islice(episodes(env, policy), STEPS + 1)
    ]
    return seconds_of(np.diff(times, axis=0))


def _frame(config: DictConfig) -> float:
    """Return the processor's seconds of a frame of training, with its share of the update."""
    learner = build_learner(config, env := env_maker(config)())
    keys = [*learner.keys, ("next", "done"), ("next", "reward"), ("next", "episode_reward")]
    rollout = Rollout(env, learner.policy, config.budget.steps, keys)
    start, frames = time.process_time(), 0
    while frames < TIMED:
        learner.update(rollout.collect(), 0.0)
        frames += rollout.frames
    return (time.process_time() - start) / frames


def plan(
    configs: Mapping[str, DictConfig], pace: Pace, arms: Sequence[Arm], minutes: float
) -> Plan:
    """Return how many frames each job gets, and how long everything takes.

    All jobs get the same time, and so the more frames the less one of theirs takes: at most a tenth
    of the budget, and at least a few batches, in whole batches.

    Args:
        configs: of trainings that do not ask the guide, by learner; PPO's is among them.
        minutes: that it may take.
    """
    config = configs[PPO]
    cases = _cases(config, pace, arms, minutes)
    left, frames = 60 * minutes - _measuring(config, pace, arms, cases), dict[str, int]()
    # What those that need little time leave is for the others.
    costs = {
        arm.name: pace.learning.get(arm.learner, pace.step) + pace.guide * arm.asks for arm in arms
    }
    for arm in sorted(arms, key=lambda arm: costs[arm.name]):
        share = max(left, 0.0) / (SEEDS * (len(arms) - len(frames)))
        affordable = share / costs[arm.name]
        frames[arm.name] = _frames(configs.get(arm.learner, config), arm, affordable, pace.length)
        left -= SEEDS * frames[arm.name] * costs[arm.name]
    number = cases if isinstance(config.evaluation.cases, int) else None
    in_order = {arm.name: frames[arm.name] for arm in arms}
    return Plan(in_order, number, SEEDS, 60 * minutes - left)


def _frames(config: DictConfig, arm: Arm, affordable: float, length: float) -> int:
    """Return the frames of a training of an arm, of which some are affordable.

    Args:
        length: of an episode.
    """
    batch, budget = config.budget.num_envs * config.budget.steps, config.budget.frames
    least = math.ceil(LEAST_FRAMES / batch) if arm.learner == SAC else LEAST_BATCHES
    if arm.is_tested:  # with a guide, its opposite and the new policy
        least += math.ceil(3 * TESTED_CASES * length / batch)
    tenth = max(round(SHARE * budget / batch), least)
    return min(min(max(int(affordable / batch), least), tenth) * batch, budget)


def _cases(config: DictConfig, pace: Pace, arms: Sequence[Arm], minutes: float) -> int:
    """Return the number of cases of the table, fewer than the env's if they take too long."""
    given = config.evaluation.cases
    if not isinstance(given, int):
        return len(given)
    allowed = MEASURING * 60 * minutes / (_measuring(config, pace, arms, given) / given)
    return min(given, max(int(allowed), FEWEST_CASES))


def _measuring(config: DictConfig, pace: Pace, arms: Sequence[Arm], cases: int) -> float:
    """Return the seconds that all evaluations take."""
    curve = (POINTS + 1) * curve_cases(config, cases)
    baselines = cases * pace.length * (5 * pace.step + 3 * pace.guide)
    jobs = 0.0
    for arm in arms:
        asked = pace.step + pace.guide * arm.asks
        jobs += SEEDS * ((curve + 3 * cases) * pace.length * asked + pace.overhead)
    return baselines + jobs
