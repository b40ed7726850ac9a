"""Contract checks of envs, guides and transforms, for the tests of new parts.

They hold for the parts of this project, and can be used for those of any other one.
"""

import copy
import warnings
from collections.abc import Iterable

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs import Compose, EnvBase, Transform, TransformedEnv, check_env_specs

from coil_rl.foreign.faults import shortened
from coil_rl.foreign.trial import Finding, Trial, same
from coil_rl.transforms import set_progress
from coil_rl.transforms.action_space import ActionSpace, nested_key, space_of
from coil_rl.transforms.guide_actions import unfit_action

RESUMED_AT = 6  # steps before and after the middle of episodes


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
    set_progress(env.train(), 0.0)
    check_env_specs(env)
    trial = Trial(env, steps)
    trial.ask_env()
    _raise_or_warn(trial.findings)


def _raise_or_warn(findings: Iterable[Finding]) -> None:
    """Raise a `ValueError` for the first finding; bounds that are left are a warning."""
    for finding in findings:
        if finding.kind != "bounds":
            raise ValueError(finding.text)
        warnings.warn(finding.text, stacklevel=3)


def check_guide(
    guide: TensorDictModuleBase,
    env: EnvBase,
    action_key: NestedKey = "action",
    tolerance: float = 0.0,
    steps: int = 12,
) -> None:
    """Check that a guide writes valid actions, and depends on nothing but the history of its row.

    The guide is asked through `GuideActions`. The same history gives the same action, whatever the
    other rows are; an episode begins without the memory of the one before, and the reset of a row
    leaves the others alone.

    Args:
        guide: without random numbers.
        env: writes what the guide reads.
        action_key: of the action.
        tolerance: allowed effect of other rows; a network rounds differently in another batch.
        steps: number of steps in the env, of random actions.

    Raises:
        ValueError: states the first property that does not hold.
    """
    action_key = nested_key(action_key)
    trial = Trial(env, steps)
    recorded = trial.recorded()
    space = space_of(trial.base, action_key)

    def check(guide: nn.Module, _: object, written: TensorDictBase) -> None:
        _check_action(guide, written[action_key], written.batch_size, space)

    hook = guide.register_forward_hook(check)
    try:
        trial.ask_guide(guide, recorded, action_key, tolerance)
    finally:
        hook.remove()
    _raise_or_warn(trial.findings)


def _check_action(guide: nn.Module, action: Tensor, batch: torch.Size, space: ActionSpace) -> None:
    """Raise a `ValueError` for an action of a guide that is no action of the env."""
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
    """Check an env with a transform: see `check_env`, and its state in the middle of episodes.

    A copy of the transform that gets its `state_dict()` and the data of a step, as in a resumed
    run, has to go on with the same numbers. An env that cannot be restored is not asked for this,
    and a warning says so.

    Args:
        env: the env.
        transform: the transform; its random state must be in its `state_dict()`.

    Raises:
        ValueError: as `check_env`, and if the copy does not go on in the same way.
    """
    transformed = TransformedEnv(env, transform)
    # Copies of the transforms without what contains them.
    outer = {id(transformed): None, id(transformed.base_env): None}
    unused = copy.deepcopy(transformed.transform, outer)
    check_env(transformed)
    name = type(transform).__name__
    if not _continues(transformed.base_env):
        warnings.warn(
            f"this env cannot go on from the middle of an episode, so that the state of {name} is "
            "not checked there; try it with GymnasiumEnv too",
            stacklevel=2,
        )
        return
    try:
        found = _difference(transformed, unused)
    except Exception as error:
        reason = shortened(f"{type(error).__name__}: {error}")
        raise ValueError(
            f"{name} cannot go on from its state_dict() in a resumed run ({reason}): keep what it "
            "remembers in the data, see Link.state, or in buffers"
        ) from error
    if found:
        raise ValueError(
            f"{name} gives another {found} of a resumed run: keep what it remembers in the data, "
            "see Link.state, or in buffers"
        )


def _continues(env: EnvBase) -> bool:
    """Return whether an env alone goes on from its state in the middle of an episode."""
    if not getattr(env, "continues", True):
        return False
    try:
        return not _difference(TransformedEnv(env, Compose()), Compose())
    except Exception:
        return False


def _difference(env: TransformedEnv, unused: Transform) -> str:
    """Return where an env gives other numbers with an unused copy of its transforms.

    The copy gets the state and the data of a step, as in a resumed run. It is an entry and a step,
    or empty where nothing differs.
    """
    env.set_seed(0)
    torch.manual_seed(0)
    _, carrier = _stepped(env, env.reset(), RESUMED_AT)
    states = [copy.deepcopy(each.state_dict()) for each in (env.base_env, env)]
    numbers, begun = torch.get_rng_state(), carrier.clone()
    expected, _ = _stepped(env, carrier, RESUMED_AT)
    again = TransformedEnv(env.base_env, unused).train(env.training)
    again.base_env.load_state_dict(states[0])
    again.load_state_dict(states[1])
    torch.set_rng_state(numbers)
    found, _ = _stepped(again, begun, RESUMED_AT)
    for step, (one, other) in enumerate(zip(expected, found, strict=True), 1):
        for key, value in one.items(True, True):
            there = other.get(key)
            if isinstance(value, Tensor) and not (isinstance(there, Tensor) and same(value, there)):
                return f"{key} in step {step}"
    return ""


def _stepped(
    env: EnvBase, carrier: TensorDictBase, steps: int
) -> tuple[list[TensorDictBase], TensorDictBase]:
    """Return the entries after each of some steps of random actions, and those to go on with."""
    after = []
    for _ in range(steps):
        step, carrier = env.step_and_maybe_reset(env.rand_action(carrier))
        after.append(step["next"].clone())
    return after, carrier
