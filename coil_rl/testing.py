"""Contract checks of envs, guides and transforms, for tests of your own parts."""

from collections.abc import Callable

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase, Transform, TransformedEnv, check_env_specs, step_mdp

from coil_rl.transforms import GuideActions, set_progress
from coil_rl.transforms.action_space import ActionSpace, nested_key


def check_env(env: EnvBase, steps: int = 10) -> None:
    """Check an env in training mode.

    Data fits the specs (else `check_env_specs` raises an `AssertionError`), numbers are finite, the
    same seed gives the same rollout, a step leaves the data before it alone, and a partial reset
    leaves the other rows alone (else a `ValueError` names the entry).
    """
    set_progress(env.train(), 0.0)
    check_env_specs(env)
    state = (
        env.state_dict() if isinstance(env, TransformedEnv) else None
    )  # of the transforms, which have no seed
    rollouts = []
    for _ in range(2):
        if state is not None:
            env.load_state_dict(state)
        env.set_seed(0)
        torch.manual_seed(0)  # of the actions
        rollouts.append(env.rollout(steps, break_when_any_done=False))
    rollout, again = rollouts
    for key, value in rollout.items(True, True):
        if value.is_floating_point() and not value.isfinite().all():
            raise ValueError(f"{key} holds a number that is not finite")
        if value.shape != again[key].shape or not torch.equal(value, again[key]):
            raise ValueError(
                f"the same seed gives other values of {key}; draw random numbers from a seeded generator"
            )
    data = env.rand_action(env.reset())
    copy = data.clone()
    env.step(data)
    for key, value in copy.items(True, True):
        if not torch.equal(value, data[key]):
            raise ValueError(f"a step changed {key} of the data before it; write new tensors")
    if env.batch_size and env.batch_size[0] > 1:
        _check_partial_reset(env.base_env if state is not None else env)


def _check_partial_reset(env: EnvBase) -> None:
    """Compare a step after the reset of row 0 with the same step without it; an env that draws in steps may differ."""

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

    plain, seeded, after_reset = (
        second_step(change) for change in (lambda present: present, seed, reset)
    )
    if (plain == seeded).all():
        for key, value in plain.items(True, True):
            if not torch.equal(value[1:], after_reset[key][1:]):
                raise ValueError(f"resetting row 0 changed {key} of other rows in the next step")


def check_guide(
    guide: TensorDictModuleBase,
    data: TensorDictBase | EnvBase,
    action_key: NestedKey = "action",
    tolerance: float = 0.0,
    steps: int = 12,
) -> None:
    """Check that a guide writes valid actions, does not change its input, and depends on nothing but its own row.

    With an env the guide is asked through `GuideActions`, and the history is checked too: the same
    history gives the same action, an episode begins without the memory of the one before, and the
    reset of a row leaves the others alone.

    A `ValueError` states the first property that does not hold.

    Args:
        guide: without random numbers.
        data: [B], written by an env; or the env, which a guide with a memory needs.
        action_key: of the action.
        tolerance: allowed effect of other rows; a network rounds differently in another batch.
        steps: number of steps in the env, of random actions.
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
        alone = torch.cat(
            [guide(inputs[row : row + 1].copy())[action_key] for row in range(len(inputs))]
        )
    if not together.isfinite().all():
        raise ValueError("the guide's action is not finite")
    if not (inputs == copy).all():
        raise ValueError("the guide changed its input")
    if not torch.allclose(together, alone, rtol=0, atol=tolerance):
        raise ValueError("the guide's action for a row depends on the other rows")


class _Recorded(EnvBase):
    """Recorded data [B, T] as an env: each reset of all rows begins anew, a reset of some rows goes on in them."""

    def __init__(self, env: EnvBase, data: TensorDictBase) -> None:
        super().__init__(device=env.device, batch_size=data.batch_size[:1])
        rows = data.batch_size[0]
        for name in ("observation_spec", "full_action_spec", "full_reward_spec", "full_done_spec"):
            spec = getattr(env, name).clone()
            setattr(self, name, spec if env.batch_size else spec.expand(rows, *spec.shape))
        self.data, self.step_number = data, 0

    def _reset(self, tensordict: TensorDictBase | None = None, **_: object) -> TensorDictBase:
        if tensordict is None or "_reset" not in tensordict or tensordict["_reset"].all():
            self.step_number = 0
        return self._present()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.step_number += 1
        return self._present().update(self.full_reward_spec.zero())

    def _present(self) -> TensorDictBase:
        present = (
            self.data[:, self.step_number].select(*self.observation_spec.keys(True, True)).clone()
        )
        return present.update(self.full_done_spec.zero())

    def _set_seed(self, seed: int | None) -> None:
        pass


def _check_history(
    guide: TensorDictModuleBase, env: EnvBase, action_key: NestedKey, tolerance: float, steps: int
) -> None:
    with torch.no_grad():
        data = [
            env.rollout(steps, break_when_any_done=False) for _ in range(1 if env.batch_size else 2)
        ]
    shortest = min(map(len, data))
    recorded: TensorDictBase = (
        data[0] if env.batch_size else TensorDict.stack([one[:shortest] for one in data])
    )
    if len(recorded.batch_size) != 2 or len(recorded) < 2:
        raise ValueError(
            f"check_guide needs an env with one batch dimension of at least 2 rows, not {env.batch_size}"
        )
    env = TransformedEnv(_Recorded(env, recorded), GuideActions({"guide": guide}, action_key))
    space, middle, last = (
        ActionSpace(env.full_action_spec[action_key], 1),
        recorded.shape[1] // 2,
        recorded.shape[1],
    )

    def check_action(_: object, __: object, written: TensorDictBase) -> None:
        action = written[action_key]
        space.check_advice(action, written.batch_size)
        if space.continuous and not action.is_floating_point():
            raise ValueError(f"is of {action.dtype}, but the env's of {space.spec.dtype}")
        if space.bounds is not None and not torch.equal(action, action.clamp(*space.bounds)):
            raise ValueError("lies outside the bounds of the env's action")

    def advice(begin: int = 0, reset: bool = False) -> Tensor:
        """Return the advice from a step on, [B, T]; with `reset` row 0 begins anew in the middle."""
        recordings, taken = recorded[:, begin:].exclude("next"), []
        env.base_env.data = recordings
        present = env.reset()
        for step in range(recordings.shape[1]):
            if reset and step == middle:
                mask = torch.tensor(
                    [True, *[False] * (len(recorded) - 1)], device=env.device
                ).unsqueeze(-1)
                present = env.reset(present.set("_reset", mask))
            taken.append(present["guide_action"])
            if step + 1 < recordings.shape[1]:
                action = TensorDict(
                    {action_key: recordings[action_key][:, step]}, present.batch_size
                )
                present = env.step(present.update(action))["next"]
        return torch.stack(taken, 1)

    hook = guide.register_forward_hook(check_action)
    try:
        first, again, fresh = advice(), advice(), advice(middle)
        try:
            interrupted = advice(reset=True)
        except (IndexError, RuntimeError) as error:
            cause = "so it may remember in itself, not in entries"
            raise ValueError(
                f"the guide fails after a single row was reset, {cause}: {error}"
            ) from error
    finally:
        hook.remove()

    def equal(one: Tensor, other: Tensor) -> bool:
        return torch.allclose(one, other, rtol=0, atol=tolerance)

    if not torch.equal(first, again):
        cause = "it draws, or remembers earlier episodes"
        raise ValueError(f"the guide's action is another one for the same history; {cause}")
    if not equal(interrupted[1:], first[1:]):
        raise ValueError("the guide's action for a row depends on the reset of another row")
    if not equal(interrupted[0, middle:], fresh[0, : last - middle]):
        raise ValueError(
            "the guide's action after the reset of a row depends on what was before it"
        )


def check_transform(env: EnvBase, transform: Transform) -> None:
    """Check an env with a transform; see `check_env`. The random state must be in the transform's `state_dict()`."""
    check_env(TransformedEnv(env, transform))
