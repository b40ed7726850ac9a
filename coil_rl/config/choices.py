"""The sentence for a method or learner that needs numbers as actions, where they are choices."""

from omegaconf import DictConfig, OmegaConf
from torchrl.envs import EnvBase

from coil_rl.transforms.action_space import ChoicesError, choices_of

# Methods that take choices as actions, the most useful ones first.
WITH_CHOICES = (
    "coil_anchored",
    "coil",
    "coil_dropout",
    "rfc",
    "coil_rfc",
    "kickstart",
    "jump_start",
    "imitate_then_ppo",
    "advisor",
    "dagger",
    "oil",
    "ppo",
)


def needs_numbers(error: BaseException | None) -> bool:
    """Return whether an error, or one of its causes, is about choices where numbers are needed.

    Args:
        error: or None.
    """
    while error is not None and not isinstance(error, ChoicesError):
        error = error.__cause__
    return error is not None


def about_choices(config: DictConfig, env: EnvBase) -> str:
    """Return why a method cannot be used with the actions of an env, and which ones can.

    Args:
        config: composed, of a method that needs numbers.
        env: without transforms.
    """
    needs = f"method={config.method.name} needs numbers as actions"
    if config.method.name in WITH_CHOICES:  # then it is another learner than the method's own
        learner = config.learner["_target_"].rpartition(".")[2].lower()
        needs = f"learner={learner} needs numbers as actions"
    if config.action:
        return (
            f"{needs}, but action=choices makes choices of them; leave action= out, or take "
            f"learner=dqn or learner=ppo with method={', '.join(WITH_CHOICES)}"
        )
    name = OmegaConf.select(config, "env.id") or OmegaConf.select(config, "env.of._target_")
    of_env = f"env.id={name}" if "id" in config.env else f"the env {name or config.env._target_}"
    return (
        f"{needs}, but the action of {of_env} is {_described(choices_of(env.action_spec))}; "
        f"with choices take learner=ppo and method={', '.join(WITH_CHOICES)}"
    )


def _described(choices: list[int]) -> str:
    if len(choices) == 1:
        return f"one of {choices[0]} choices"
    return f"{len(choices)} choices at once, of {', '.join(map(str, choices))} options"
