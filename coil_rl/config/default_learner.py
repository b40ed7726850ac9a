"""Default learner in an env that is not shipped: SAC if its actions are numbers.

SAC needs far fewer frames where actions are numbers (docs/learners.md), and cannot learn choices.
Hydra composes the learner before the env exists. So the env is made once before, and the choice
becomes words of the command, which the folder of the run keeps.
"""

from collections.abc import Callable, Iterable
from contextlib import closing, suppress

from omegaconf import DictConfig

from coil_rl.config.compose import compose_train, key_of
from coil_rl.output import say

ANY_ENV = ("fmu", "gym", "torchrl")  # files of conf/env that stand for any env
FRAMES = 100_000  # 3.5 minutes of the processor with SAC, where the steps of an env are fast


def default_learner(
    words: Iterable[str], compose: Callable[[list[str]], DictConfig] = compose_train
) -> list[str]:
    """Return the words that select SAC, or none if the command or the env excludes it.

    A learner, a network, an experiment, a policy to begin with and a method are a choice, but for
    `coil_anchored`, which is the default method with a guide.

    An env that cannot be made gives none: the run says what is wrong with it.

    Args:
        words: of the command line.
        compose: returns the configuration for some of them.
    """
    given = {key_of(word): word for word in words}
    kind, method = (given.get(key, "").partition("=")[2] for key in ("env", "method"))
    chosen = given.keys() & {"experiment", "init", "learner", "network", "resume"}
    if kind not in ANY_ENV or chosen or method not in ("", "coil_anchored"):
        return []
    read = ("env", "hydra.searchpath", "budget.frames")
    of_env = [word for key, word in given.items() if key.startswith(read)]
    with suppress(Exception):
        config = compose([*of_env, "learner=sac"])
        if _acts_in_numbers(config):
            more = [f"budget.frames={FRAMES}"]
            if "budget.frames" in given:
                # A very short run learns too: its first quarter is stored without learning.
                frames, starts = config.budget.frames, config.learner.starts
                is_short = frames < 4 * starts and "learner.starts" not in given
                more = [f"learner.starts={frames // 4}"] if is_short else []
            say("learner=sac, because actions are numbers (for PPO write learner=ppo)")
            return ["learner=sac", *more]
    return []


def _acts_in_numbers(config: DictConfig) -> bool:
    """Return whether SAC can learn in the env of a configuration."""
    from coil_rl.config.parts import build_bare_env  # imports torch
    from coil_rl.learners.off_policy import check_replay

    few = {"num_envs": 1} | ({"workers": 0} if "workers" in config.env else {})
    with closing(build_bare_env(config, few)) as env:
        check_replay(env, "SAC")
        return env.action_spec.dtype.is_floating_point
