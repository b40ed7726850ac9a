"""Envs that do not react to actions, such as recordings: nothing can be learned there by trial.

What somebody else did in them can be imitated, and the imitation is tested in another env. The
class of such an env says so by `reacts = False`, and has

- `whole_pass(arguments)`, a static method: how many episodes there are, and the steps of the
  longest, by the arguments of the constructor;
- `length`, [B], the steps of the episode of each row;
- `demonstrations()`: lines on what there is to learn; a `ValueError` if there is nothing.
"""

import math
from typing import TYPE_CHECKING, Any

import hydra.utils
from omegaconf import DictConfig, OmegaConf

from coil_rl.errors import UserError
from coil_rl.output import say

if TYPE_CHECKING:
    from coil_rl.run.parts import EnvMaker


def passive(config: DictConfig) -> Any:
    """Return the class of an env that does not react to actions; None for any other env."""
    try:
        kind = hydra.utils.get_object(str(config.env.get("_target_", "")))
    except Exception:  # who builds it says what is wrong
        return None
    return None if getattr(kind, "reacts", True) else kind


def check_passive(config: DictConfig, make_env: "EnvMaker") -> None:
    """Check a training in an env that does not react, and print what there is to learn from.

    Raises:
        UserError: for a method that needs the effect of its actions, for a budget that does not
            reach all steps, and if nothing can be learned.
    """
    from coil_rl.run.parts import TRAIN  # imports torch

    kind = passive(config)
    if kind is None:
        return
    env: Any = make_env.bare(None, TRAIN, None)  # first, because it says if there are no data
    explores = False
    for node in config.method.transforms.values():
        probability = OmegaConf.select(node, "probability")
        explores = explores or (probability is not None and probability != 1.0)
    if config.method.learner != "imitation" or explores:
        raise UserError(
            f"{kind.__name__} does not react to actions, so method={config.method.name} cannot "
            "learn there; imitate what it shows with method=oil, and go on from there in an env "
            "that reacts: method=dagger env=ENV learner.dataset=FOLDER/dataset.pt"
        )
    _check_pass(config, env, kind.whole_pass(config.env)[0])
    try:
        for line in env.demonstrations():
            say(line)
    except ValueError as error:
        raise UserError(f"env: {error}") from error


def _check_pass(config: DictConfig, env: Any, episodes: int) -> None:
    """Raise a `UserError` for a training that ends before all steps of all episodes were seen."""
    rows, longest = env.batch_size[0], int(env.length.max())
    if rows < episodes:
        raise UserError(
            f"env.num_envs={rows} leaves out episodes, of which there are {episodes}; leave "
            f"budget.num_envs and env.num_envs out, or give at least {episodes}"
        )
    steps = config.budget.steps
    seen = math.ceil(config.budget.frames / (rows * steps)) * steps
    if seen < longest:
        raise UserError(
            f"budget.frames={config.budget.frames} is {seen} steps of each episode, and the "
            f"longest has {longest}, so the others would be left out; leave budget.frames "
            f"out, or give at least {rows * longest}"
        )


def whole_pass(what: str, otherwise: int, *, _root_: DictConfig) -> int:
    """Return what a training takes that sees all of an env that does not react.

    Args:
        what: "num_envs", one for each episode; "steps", those of the longest; or "frames".
        otherwise: the value in other envs.
    """
    kind = passive(_root_)
    if kind is None:
        return otherwise
    rows, steps = kind.whole_pass(_root_.env)
    return {"num_envs": rows, "steps": steps, "frames": rows * steps}[what]
