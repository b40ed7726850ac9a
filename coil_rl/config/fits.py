"""Whether an env has what a configuration names, and whether a guide can act in it."""

from collections.abc import Iterable
from typing import Any

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase
from torchrl.data import Composite
from torchrl.envs import EnvBase, TransformedEnv

from coil_rl.errors import UserError, did_you_mean
from coil_rl.foreign.batch import optional_entries
from coil_rl.foreign.faults import ForeignError
from coil_rl.guides.simple import FollowAdvice
from coil_rl.measures import measures_of
from coil_rl.transforms import GuideActions
from coil_rl.transforms.action_space import nested_key
from coil_rl.transforms.guide_actions import UnfitActionError

EPISODE_REWARD = "episode_reward"  # written by a transform of every env


def check_measures(measures: Any, env: EnvBase) -> None:
    """Raise a `UserError` for a measure of an entry that is missing or not one number per row.

    So it is for a `where` that is neither true or false in each row nor a number of Gymnasium's
    info.

    Args:
        measures: nodes by name.
    """
    for name, measure in measures_of(measures).items():
        place = f"evaluation.measures.{name}"
        check_number(env, nested_key(measure.entry), place)
        if measure.where is not None:
            _check_flag(env, nested_key(measure.where), place)


def check_number(env: EnvBase, key: NestedKey, name: str) -> None:
    """Raise a `UserError` if an entry does not have exactly one number per row, or per agent."""
    check_entry(env, key, name)
    rewards = [env.full_reward_spec[each].shape for each in env.reward_keys]
    for group in _groups(env, key):
        spec = group[key]
        parent = group[key[:-1]] if isinstance(key, tuple) and len(key) > 1 else group
        shape = spec.shape[len(parent.shape) :]
        is_one = shape.numel() == 1 or spec.shape in rewards  # of each agent, for some envs
        if isinstance(spec, Composite) or spec.dtype is None or not is_one:
            numbers = f"{shape.numel()} numbers" if shape.numel() > 1 else "no number"
            raise UserError(
                f"{name}={dotted(key)} has {numbers} a row, and one is needed; name an entry of "
                "one number, or let the env write one"
            )


def _check_flag(env: EnvBase, key: NestedKey, name: str) -> None:
    """Raise a `UserError` if an entry is not a flag with one value per row.

    It is a boolean, or a number of Gymnasium's info, where flags are numbers too.
    """
    check_entry(env, key, name)
    found = [group[key] for group in _groups(env, key)]
    rows = env.batch_size.numel()
    of_info = key in optional_entries(env)
    if not any(
        (of_info or spec.dtype == torch.bool) and spec.shape.numel() == rows for spec in found
    ):
        raise UserError(
            f"{name}.where={dotted(key)} must be a flag, true or false once a row, or a number of "
            "Gymnasium's info (env.info); name another entry, or leave it out"
        )


def _specs(env: EnvBase) -> list[Composite]:
    """Return the specs of what an env writes after a step."""
    return [env.observation_spec, env.full_reward_spec, env.full_done_spec]


def _groups(env: EnvBase, key: NestedKey) -> list[Composite]:
    """Return the specs of an env that have an entry; none for the sum of rewards."""
    return [group for group in _specs(env) if key in group.keys(True)]


def check_entry(env: EnvBase, key: NestedKey, name: str) -> None:
    """Raise a `UserError` if an env does not write an entry; `name` is the key that names it."""
    known = {EPISODE_REWARD}
    for spec in _specs(env):
        known |= {dotted(each) for each in spec.keys(True)}
    given = dotted(key)
    if given not in known:
        raise UserError(
            f"{name}={given} is no entry of the env; it has {', '.join(sorted(known))}"
            f"{did_you_mean(given, known)}"
        )


def check_guide_in_env(guide: TensorDictModuleBase, env: EnvBase, name: str) -> None:
    """Check that a guide can act in an env.

    Args:
        env: of any number of rows; it is stepped once.
        name: key of the guide, for the message.

    Raises:
        UserError: if the env lacks an entry that the guide reads, or its action does not fit.
    """
    try:
        transform = GuideActions({"guide": guide})
        memory = (key for each in transform.guides.memories.values() for key in each.specs)
        known = [*env.observation_spec.keys(True), *transform.supplied, *memory]
        for key in guide.in_keys:
            if key not in known:
                has = ", ".join(map(dotted, env.observation_spec.keys()))
                remedy = getattr(guide, "remedy", "")  # what gives the entry that it reads
                raise UserError(
                    f"{name}: it reads {dotted(key)}, but the env has only {has}"
                    f"{remedy and '; '}{remedy}"
                )
        advised = TransformedEnv(env, transform)
        advised.step(FollowAdvice(advised)(advised.reset()))
        advised.state_dict()  # a state that no checkpoint can hold is refused before the training
    except UnfitActionError as error:
        raise UserError(f"{name}: its action {error.problem}") from error
    except ForeignError as error:  # its sentence says whether the env or the guide is at fault
        raise UserError(str(error)) from error
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"{name}: {error.args[0] if error.args else error}") from error
    except RuntimeError as error:
        first = str(error).partition("\n")[0]
        raise UserError(
            f"{name}: it cannot act on the observations of this env ({first})"
        ) from error


def dotted(key: str | Iterable[Any]) -> str:
    """Return the name of an entry as in a configuration, such as "info.lap".

    Args:
        key: of the entry, perhaps nested.
    """
    return key if isinstance(key, str) else ".".join(map(str, key))
