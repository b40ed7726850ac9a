"""The arms of a comparison: what learns, in which words of `coil-train`."""

from collections.abc import Sequence
from dataclasses import dataclass

from omegaconf import DictConfig
from torchrl.envs import EnvBase

from coil_rl.config.compose import key_of
from coil_rl.config.python import Named
from coil_rl.errors import UserError

GUIDE, OPPOSITE, ZERO, RANDOM, NETWORK = "guide", "opposite", "zero", "random", "first network"
PPO, SAC, TUNE = "ppo", "sac", "tune"
ANCHORED, ANCHORED_SAC = "coil_anchored", "coil_anchored_sac"
SHARE = 0.1  # of the budget, for each job
POINTS = 4  # kept policies of a training, besides the first one
MOST_CURVE_CASES = 8
TESTED_CASES = 4  # of a start test, at least: after two only a very large difference is certain
# What a comparison decides itself, and the reason.
OWN = {
    "method": "it compares methods",
    "learner": "it compares learners; learner.KEY=VALUE sets a value of all of them",
    "seed": "it is an argument of its own",
    "run_dir": "give folder=FOLDER",
    "hydra.run.dir": "give folder=FOLDER",
    "resume": "give folder=FOLDER, with the words that began the comparison",
    "init": "each training begins with a new network",
    "delivery": "each method has its own",
    "label": "labels are the names of the methods",
}
# Values that make the evaluation of a job short, unless the words give them.
SHORT = {
    "evaluation.curve.points": str(POINTS),
    "evaluation.repeats": "1",
    "evaluation.gif": "false",
    "logger": "none",
}


@dataclass(frozen=True)
class Arm:
    """What learns in a comparison.

    Args:
        name: label of its runs.
        words: of `coil-train`, that choose it.
        asks: whether it asks the guide in each step.
        learner: name of what learns alone as it does; TUNE: nothing learns.
    """

    name: str
    words: tuple[str, ...]
    asks: bool
    learner: str

    @property
    def is_tested(self) -> bool:
        """Whether a start test decides what it holds."""
        return self.asks and self.learner != TUNE


ARMS = {
    TUNE: Arm(TUNE, ("method=tune",), asks=True, learner=TUNE),
    PPO: Arm(PPO, ("method=ppo", "learner=ppo"), asks=False, learner=PPO),
    ANCHORED: Arm(ANCHORED, ("method=coil_anchored", "learner=ppo"), asks=True, learner=PPO),
    SAC: Arm(SAC, ("method=ppo", "learner=sac"), asks=False, learner=SAC),
    ANCHORED_SAC: Arm(
        ANCHORED_SAC, ("method=coil_anchored", "learner=sac"), asks=True, learner=SAC
    ),
}


def arms_for(env: EnvBase, *, tunes: bool) -> list[Arm]:
    """Return the arms that fit an env: SAC where actions are numbers.

    Args:
        tunes: whether numbers of the guide are to be tuned.
    """
    names = [TUNE] if tunes else []
    names += [PPO, ANCHORED]
    if env.full_action_spec[env.action_key].dtype.is_floating_point:
        names += [SAC, ANCHORED_SAC]
    return [ARMS[name] for name in names]


def check_words(words: Sequence[str]) -> None:
    """Raise a `UserError` for a word that a comparison decides itself."""
    for word in words:
        reason = OWN.get(key_of(word))
        if reason is not None:
            raise UserError(f"{word} cannot be given to coil-compare: {reason}; leave it out")


def short_words(words: Sequence[str], config: DictConfig, cases: int | None) -> list[str]:
    """Return the words that make the evaluation of a job short, unless some others give them.

    Args:
        cases: of the table; None for those of the env's file.
    """
    given = {key_of(word) for word in words}
    short = dict(SHORT)
    short["evaluation.curve.num_envs"] = str(curve_cases(config, cases))
    if cases is not None:
        short["evaluation.cases"] = str(cases)
    return [f"{key}={value}" for key, value in short.items() if key not in given]


def curve_cases(config: DictConfig, cases: int | None) -> int:
    """Return the number of cases of the learning curves.

    Args:
        cases: of the table; None for those of the env's file.
    """
    curve = config.evaluation.curve
    if curve.count_key != "cases":  # they are places on tracks
        return int(curve.num_envs)
    most = MOST_CURVE_CASES if cases is None else min(MOST_CURVE_CASES, cases)
    return min(most, int(curve.num_envs))


def job_of(given: Named, arm: Arm, seed: int, frames: int | None, short: Sequence[str]) -> Named:
    """Return everything that a job consists of.

    Args:
        given: env, guide and everything else that was given.
        frames: of the job; None for those that were given, or are of the env's file.
    """
    words = list(given.words)
    if frames is not None:
        words = [word for word in words if key_of(word) != "budget.frames"]
        words.append(f"budget.frames={frames}")
        least = "learner.anchor.least_cases"
        if arm.is_tested and least not in map(key_of, words):
            words.append(f"{least}={TESTED_CASES}")
    words += [*short, *arm.words, f"label='{arm.name}'", f"seed={seed}"]
    nodes = dict(given.nodes)
    if arm.name != TUNE:
        nodes.pop("tune", None)
    return Named(words, nodes, shared=True)
