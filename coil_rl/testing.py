"""Contract checks of envs, guides and transforms, for the tests of new parts.

They hold for the parts of this project, and can be used for those of any other one.
"""

import warnings
from collections.abc import Callable

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs import EnvBase, Transform, TransformedEnv, check_env_specs, step_mdp

from coil_rl.foreign.batch import optional_entries
from coil_rl.foreign.gymnasium_env import GymnasiumEnv
from coil_rl.foreign.trial import AskedGuide, difference, episodes
from coil_rl.transforms import GuideActions, set_progress
from coil_rl.transforms.action_space import ActionSpace, nested_key, space_of
from coil_rl.transforms.guide_actions import unfit_action


def check_env(env: EnvBase, steps: int = 10) -> None:
    """Check an env in training mode.

    Data fits the specs, numbers are finite, the same seed gives the same rollout, a step leaves the
    data before it alone, and a partial reset leaves the other rows alone. A Gymnasium env whose
    observations lie outside of its `observation_space` is a warning, as some published ones leave
    their bounds a little.

    Args:
        env: the env, with or without transforms.
        steps: length of the rollouts.

    Raises:
        AssertionError: if data does not fit the specs, by `check_env_specs`.
        ValueError: for the first other property that does not hold; it names the entry.
    """
    base = env.base_env if isinstance(env, TransformedEnv) else env
    set_progress(env.train(), 0.0)
    check_env_specs(env)
    _check_rollouts(env, steps)
    if isinstance(base, GymnasiumEnv):
        _look_at_bounds(base, steps)
    data = env.rand_action(env.reset())
    copy = data.clone()
    env.step(data)
    changed = difference(copy, data)
    if changed is not None:
        raise ValueError(f"a step changed {changed} of the data before it; write new tensors")
    if env.batch_size and env.batch_size[0] > 1:
        _check_partial_reset(base)


def _check_rollouts(env: EnvBase, steps: int) -> None:
    """Compare two rollouts with the same seed."""
    rollout, again = episodes(env, steps)
    optional = {part for key in optional_entries(env) for part in (key, ("next", *key))}
    for key, value in rollout.items(True, True):
        numbers = value.nan_to_num() if key in optional else value
        if value.is_floating_point() and not numbers.isfinite().all():
            raise ValueError(f"{key} holds a number that is not finite")
    changed = difference(rollout, again)
    if changed is not None:
        raise ValueError(
            f"the same seed gives other values of {changed}; "
            "draw random numbers from a seeded generator"
        )


def _look_at_bounds(env: GymnasiumEnv, steps: int) -> None:
    """Warn of each entry of the observation with a number outside of its space."""
    rollout = env.rollout(steps, break_when_any_done=False)
    for entry in env.codec.entries:
        parts = [rollout[entry.key], rollout["next", *entry.key]]
        values = torch.cat([part.reshape(-1, *entry.given) for part in parts])
        found = entry.outside(values.cpu().numpy())
        if found is not None:
            index, value, low, high = found
            warnings.warn(
                f"number {index} of {entry.title} is {value:g}, but the observation_space of "
                f"{entry.id} has it from {low:g} to {high:g}; correct its bounds, or the number",
                stacklevel=3,
            )


def _check_partial_reset(env: EnvBase) -> None:
    """Compare a step after the reset of row 0 with the same step without it.

    An env that draws random numbers in its steps may differ anyway: so the step is compared only if
    another seed makes no difference.
    """

    def leave_alone(present: TensorDictBase) -> TensorDictBase:
        return present

    def seed(present: TensorDictBase) -> TensorDictBase:
        env.set_seed(1)
        return present

    def reset(present: TensorDictBase) -> TensorDictBase:
        mask = torch.zeros_like(present["done"])
        mask[0] = True
        return env.reset(present.set("_reset", mask))

    def second_step(change: Callable[[TensorDictBase], TensorDictBase]) -> TensorDictBase:
        env.set_seed(0)
        torch.manual_seed(0)
        present = change(step_mdp(env.step(env.rand_action(env.reset()))))
        torch.manual_seed(0)  # of the action
        return env.step(env.rand_action(present))["next"]

    plain, seeded, after_reset = second_step(leave_alone), second_step(seed), second_step(reset)
    changed = difference(plain[1:], after_reset[1:])
    if difference(plain, seeded) is None and changed is not None:
        raise ValueError(f"resetting row 0 changed {changed} of other rows in the next step")


def check_guide(
    guide: TensorDictModuleBase,
    data: TensorDictBase | EnvBase,
    action_key: NestedKey = "action",
    tolerance: float = 0.0,
    steps: int = 12,
) -> None:
    """Check that a guide writes valid actions, and depends on nothing but its own row.

    It must not change its input either. With an env the guide is asked through `GuideActions`, and
    the history is checked too: the same history gives the same action, an episode begins without
    the memory of the one before, and the reset of a row leaves the others alone.

    Args:
        guide: without random numbers.
        data: [B], written by an env; or the env, which a guide with a memory needs.
        action_key: of the action.
        tolerance: allowed effect of other rows; a network rounds differently in another batch.
        steps: number of steps in the env, of random actions.

    Raises:
        ValueError: states the first property that does not hold.
    """
    action_key = nested_key(action_key)
    if action_key not in guide.out_keys:
        raise ValueError(f"the guide writes {guide.out_keys}, not {action_key!r}")
    if isinstance(data, EnvBase):
        return _check_history(guide, data, action_key, tolerance, steps)
    if GuideActions({"guide": guide}, action_key).needs_past:
        raise ValueError(
            "the guide depends on earlier steps: give check_guide an env in place of data"
        )
    inputs = data.select(*guide.in_keys)
    copy = inputs.clone()
    with torch.no_grad():
        together = guide(inputs.copy())[action_key]
        single = [guide(inputs[row : row + 1].copy())[action_key] for row in range(len(inputs))]
        alone = torch.cat(single)
    if not together.isfinite().all():
        raise ValueError("the guide's action is not finite")
    if not (inputs == copy).all():
        raise ValueError("the guide changed its input")
    if not torch.allclose(together, alone, rtol=0, atol=tolerance):
        raise ValueError("the guide's action for a row depends on the other rows")


def _check_history(
    guide: TensorDictModuleBase, env: EnvBase, action_key: NestedKey, tolerance: float, steps: int
) -> None:
    """Check what the advice of a guide depends on over the steps of an episode."""
    recorded = _recorded_rollout(env, steps)
    asked = AskedGuide(guide, env, recorded, action_key)
    space = space_of(asked.env.base_env, action_key)
    middle = recorded.shape[1] // 2
    hook = guide.register_forward_hook(_CheckedAction(space, action_key))
    try:
        first, again, fresh = asked.advice(), asked.advice(), asked.advice(begin=middle)
        try:
            interrupted = asked.advice(reset_at=middle)
        except (IndexError, RuntimeError) as error:
            raise ValueError(
                "the guide fails after a single row was reset, "
                f"so it may remember in itself, not in entries: {error}"
            ) from error
    finally:
        hook.remove()

    def equal(one: Tensor, other: Tensor) -> bool:
        return torch.allclose(one, other, rtol=0, atol=tolerance)

    if not torch.equal(first, again):
        raise ValueError(
            "the guide's action is another one for the same history; "
            "it draws, or remembers earlier episodes"
        )
    if not equal(interrupted[1:], first[1:]):
        raise ValueError("the guide's action for a row depends on the reset of another row")
    if not equal(interrupted[0, middle:], fresh[0]):
        raise ValueError(
            "the guide's action after the reset of a row depends on what was before it"
        )


def _recorded_rollout(env: EnvBase, steps: int) -> TensorDictBase:
    """Return data [B, T] of random actions, with at least two rows.

    For an env without batch dimension these are two episodes.
    """
    with torch.no_grad():
        if env.batch_size:
            recorded: TensorDictBase = env.rollout(steps, break_when_any_done=False)
        else:
            episodes = [env.rollout(steps, break_when_any_done=False) for _ in range(2)]
            shortest = min(map(len, episodes))
            recorded = TensorDict.stack([episode[:shortest] for episode in episodes])
    if len(recorded.batch_size) != 2 or len(recorded) < 2:
        raise ValueError(
            "check_guide needs an env with one batch dimension of at least 2 rows, not "
            f"{list(env.batch_size)}; make it with more, such as GymnasiumEnv(ID, num_envs=2)"
        )
    return recorded


class _CheckedAction:
    """A forward hook of a guide that raises a `ValueError` for an invalid action.

    Args:
        space: of the action.
        action_key: of the action.
    """

    def __init__(self, space: ActionSpace, action_key: NestedKey) -> None:
        self.space, self.action_key = space, action_key

    def __call__(self, guide: nn.Module, _: object, written: TensorDictBase) -> None:
        action, batch, space = written[self.action_key], written.batch_size, self.space
        try:
            space.check_advice(action, batch)
        except ValueError as error:
            raise unfit_action("guide", guide, action, batch, space, str(error)) from None
        if space.continuous and not action.is_floating_point():
            raise ValueError(
                f"the guide's action is of {action.dtype}, but the env's of {space.spec.dtype}"
            )
        if space.bounds is not None and not torch.equal(action, action.clamp(*space.bounds)):
            raise ValueError("the guide's action lies outside the bounds of the env's action")


def check_transform(env: EnvBase, transform: Transform) -> None:
    """Check an env with a transform; see `check_env`.

    Args:
        env: the env.
        transform: the transform; its random state must be in its `state_dict()`.
    """
    check_env(TransformedEnv(env, transform))
