"""Words of the command line that nothing reads: they would have no effect, and are refused.

Some nodes are read by some runs only, or only where another value refers to them.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from omegaconf import DictConfig, OmegaConf

from coil_rl.config.compose import REFERENCE, covers, key_of
from coil_rl.config.parts import advises, env_maker, learner_kind, trains_guides
from coil_rl.errors import UserError
from coil_rl.plain_yaml import is_part, leaves

# Nodes that other values refer to, and that nothing else reads.
REFERRED = (
    "preset",
    "track",
    "recording",
    "training.learning_rate",
    "training.imitation_env",
    "budget.minibatches",
)
NOISE = "training.noise_correlation"
NEEDS_GUIDE = "method.needs_guide"  # a fact about the method, not a choice
OF_A_LEARNER = (
    *("learner", "network", "checkpoint_every", "evaluation.repeats"),
    *("budget.num_envs", "budget.steps", "training.normalise", "training.scale_rewards"),
)
OF_A_TRAINING = (
    *("training", "budget", "logger", "watch", "observes", "action", "compile"),
    *("evaluation.curve", "evaluation.guides", "evaluation.policy"),
)


def check_read(config: DictConfig, task: Iterable[str]) -> None:
    """Refuse a word of the command line that a run does not read.

    Raises:
        UserError: for the first word without an effect.
    """
    for sentence in unread(config, task):
        raise UserError(sentence)


def unread(config: DictConfig, task: Iterable[str]) -> Iterator[str]:
    """Yield a sentence for each word of the command line that a run does not read."""
    closed = [*_unread_nodes(config)]
    references = set(_references(config, closed))
    for text in task:
        key = key_of(text)
        if key == NEEDS_GUIDE:
            yield (
                f"{text} has no effect: the file of method={config.method.name} says whether its "
                "policy needs a guide; leave it out"
            )
        is_read = not is_part(key, (*closed, *REFERRED))
        if key == NOISE:
            is_read = is_read and _adds_noise(config)
        if not is_read and not any(covers(key, other) for other in references):
            yield (
                f"{text} has no effect: nothing in this run reads {key} "
                f"(method={config.method.name}); leave it out"
            )


def _unread_nodes(config: DictConfig) -> Iterator[str]:
    """Yield the nodes that a run does not read, whatever they hold."""
    has_agent = config.method.observes is not None
    learns = has_agent and not config.method.run
    anchored = OmegaConf.select(config, "learner.anchor") is not None
    if not has_agent:
        yield from OF_A_TRAINING
    if not learns:
        yield from (*OF_A_LEARNER, NOISE)
    if not (anchored or config.delivery == "tested"):
        yield "training.tests"
    if not trains_guides(config):
        yield "proxy"
    if not advises(config):
        yield "evaluation.advice"


def _references(config: DictConfig, closed: Sequence[str]) -> Iterator[str]:
    """Yield the keys to which values refer, except values in nodes that are not read.

    A run without a learner has one row for each case, whatever the number of rows in its env.
    """
    left_out = (*closed, "env.num_envs") if "learner" in closed else closed
    values: Any = OmegaConf.to_container(config, resolve=False)
    for key, value in leaves(values).items():
        if isinstance(value, (str, list)) and not is_part(key, left_out):
            yield from (name for name in REFERENCE.findall(str(value)) if name != key)


def _adds_noise(config: DictConfig) -> bool:
    """Return whether noise is added to the actions of a training, which are numbers then."""
    if learner_kind(config) == "imitation":
        return False
    env = env_maker(config)()
    return bool(env.full_action_spec[env.action_key].dtype.is_floating_point)
