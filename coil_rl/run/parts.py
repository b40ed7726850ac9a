"""The sets of cases of a run, and the maker of its envs.

The other parts of a run are its learner and its callbacks, see `coil_rl.learners.learner`.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field

from tensordict.nn import TensorDictModuleBase
from torchrl.envs import (
    Compose,
    EnvBase,
    FrameSkipTransform,
    InitTracker,
    RewardSum,
    Transform,
    TransformedEnv,
    VecNorm,
    VecNormV2,
)

from coil_rl.errors import UserError
from coil_rl.foreign.batch import SeededRows
from coil_rl.foreign.limit import limits_of
from coil_rl.foreign.trial import PATIENCE, Trial
from coil_rl.guides.simple import FollowAdvice
from coil_rl.transforms import GuideActions
from coil_rl.transforms.normalised_action import normalising
from coil_rl.transforms.reward_coupling import TaskReward

TRAIN = "train"  # episodes of the training: random starts, tracks or seeds
TEST = "test"  # cases of the table, which training never sees
TESTS = "tests"  # new cases in which a training compares policies
SOME_ROWS = 2  # of an env that is only looked at; some ways to degrade advice need several
# Entries that transforms, policies and learners write. `last_action`, `row` and `is_init` are not
# among them: where the env has its own, that is used.
WRITTEN = {
    *("action_log_prob", "action_value", "advantage", "agent_acts", "agent_weight"),
    *("chosen_action", "chosen_action_value", "concatenated", "episode_reward"),
    *("executed_action", "exploration_noise", "guide_action", "guide_distance", "guide_number"),
    *("guide_state", "guide_steps", "limit_count", "loc", "logits", "normalised", "policy_state"),
    *("remembered", "scale", "shown", "state_action_value", "state_value", "task_reward"),
    *("unclipped_action", "value_target"),
}


# Makes an env without the transforms of a method, for the arguments `rows`, `cases` and `count` of
# `EnvMaker`.
BareEnv = Callable[[int | None, str, int | None], EnvBase]


@dataclass(eq=False)
class EnvMaker:
    """Makes the envs of a run, with the transforms of its method: the only way to an env.

    Args:
        bare: makes the env without transforms for a number of rows, a set of cases and the number
            of different cases.
        of_agent: makes it without what only guides that act alone read of it; None: it is the same.
        alone: makes it without any controller beside it; None: it has none.
        disturb: makes the transforms that disturb the env, for a set of cases; the guides of the
            method are behind them.
        transforms: makes the transforms of the method; its argument is the name of a further kind
            of advice, or empty.
        guides: makes the guides by name.
        degrade: makes the transforms that degrade the advice of guides that act alone.
        sizes: number of cases in each set that the env has, by its name.
    """

    bare: BareEnv
    _: KW_ONLY
    of_agent: BareEnv | None = None
    alone: BareEnv | None = None
    disturb: Callable[[str], Sequence[Transform]] = lambda cases: ()
    transforms: Callable[[str], Sequence[Transform]] = lambda advice: ()
    guides: Callable[[], Mapping[str, TensorDictModuleBase]] = dict
    degrade: Callable[[], Sequence[Transform]] = tuple
    sizes: Mapping[str, int] = field(default_factory=dict)

    def __call__(
        self,
        rows: int | None = None,
        cases: str = TRAIN,
        advice: str = "",
        *,
        count: int | None = None,
    ) -> EnvBase:
        """Return an env with all transforms.

        It also writes the sum of the rewards, `episode_reward`.

        Args:
            rows: number of rows; None: as many as a training has.
            cases: name of the set of cases.
            advice: name of a further kind of advice for the agent.
            count: number of different cases in the set, instead of its own. Row i is case
                `i % count`.

        Raises:
            UserError: if the transforms do not fit the env, or each other.
        """
        bare = self.of_agent or self.bare
        return self.around(bare(rows, cases, count), advice, self.disturb(cases))

    def plain(self, rows: int, cases: str, *, count: int | None = None) -> EnvBase:
        """Return an env without guides and controllers, disturbed as the run says.

        Args:
            rows: number of rows.
            cases: as above.
            count: as above.
        """
        make = self.alone or self.bare
        return transformed(make(rows, cases, count), self.disturb(cases), "disturb")

    def around(self, env: EnvBase, advice: str = "", disturb: Sequence[Transform] = ()) -> EnvBase:
        """Return any env with normalised actions and the transforms of the method.

        By default nothing disturbs it: a recording, or a machine, has its own delays.

        Args:
            env: the env.
            advice: as above.
            disturb: transforms that disturb it.

        Raises:
            UserError: as above.
        """
        try:
            first = normalising(env)
        except ValueError as error:
            raise UserError(f"env: {error}") from error
        transforms = [*first, *disturb, *self.transforms(advice)]
        name = "disturb, method.transforms" if disturb else "method.transforms"
        return transformed(env, transforms, name)

    def guided(
        self,
        rows: int,
        cases: str,
        guides: Mapping[str, TensorDictModuleBase] | None = None,
        *,
        count: int | None = None,
    ) -> tuple[EnvBase, TensorDictModuleBase]:
        """Return an env in which the guides act alone, and the policy that does so.

        The env is disturbed, and their advice degraded, as the run says.

        Its actions are in the unit of the env.

        Args:
            rows: number of rows for each guide. Those of the first guide come first.
            cases: as above.
            guides: instead of those of the run.
            count: as above.
        """
        guides = guides or self.guides()
        env = self.bare(rows * len(guides), cases, count)
        disturb = self.disturb(cases)
        transforms = [*disturb, GuideActions(guides), *self.degrade()]
        env = transformed(env, transforms, "disturb, degrade" if disturb else "degrade")
        of_row = [guide for guide in range(len(guides)) for _ in range(rows)]
        return env, FollowAdvice(env, of_row)


def try_out(env: EnvBase, guides: Mapping[str, TensorDictModuleBase]) -> Trial:
    """Try an env of others and the controllers that act in it, and warn of what is found.

    Args:
        env: without transforms, of `SOME_ROWS`.
        guides: by name.
    """
    trial = Trial(env, patience=PATIENCE)
    if isinstance(env, SeededRows):
        trial.ask_env()
    for guide in guides.values():
        trial.ask_controller(guide)
    for finding in trial.findings:
        warnings.warn(finding.text, stacklevel=2)
    return trial


def transformed(env: EnvBase, transforms: Sequence[Transform], name: str) -> EnvBase:
    """Return an env with the sum of its rewards, `episode_reward`, and with transforms.

    Episodes of a foreign env that nothing else ends are truncated, see `limit_of`.

    Transforms that do not fit are a `UserError` that begins with `name`.
    """
    if overwritten := WRITTEN & set(env.observation_spec.keys()):
        raise UserError(
            f"env: its observation has an entry {min(overwritten)}, a name under which a training "
            "writes its own numbers; rename it in a wrapper"
        )
    # Of the env itself and of the transforms.
    parts = [*env.modules(), *transforms]
    if any(isinstance(part, (VecNorm, VecNormV2)) for part in parts):
        raise UserError(
            f"{name}: VecNorm normalises by statistics that an evaluation begins anew; leave it "
            "out and give learner.normalise=true"
        )
    if any(isinstance(part, FrameSkipTransform) for part in transforms):
        raise UserError(
            f"{name}: FrameSkipTransform takes steps that are not counted, and with actions in "
            "another unit; repeat them in a wrapper of the env, or by its own frame_skip"
        )
    # The sum comes first, before a method changes the reward.
    kept = [TaskReward()] if any(_may_pay(each, env) for each in transforms) else []
    env = TransformedEnv(env, Compose(*limits_of(env), RewardSum(), *kept, *transforms))
    try:
        env.observation_spec  # noqa: B018  transforms check the specs when these are computed
    except (KeyError, ValueError) as error:
        raise UserError(f"{name}: {error.args[0]}") from error
    return env


def _may_pay(transform: Transform, env: EnvBase) -> bool:
    """Return whether a transform of somebody else may change the reward."""
    of_others = not type(transform).__module__.startswith(("coil_", "torchrl."))
    if isinstance(transform, InitTracker):  # it knows its keys in an env only
        return False
    return of_others or not {*env.reward_keys}.isdisjoint(transform.out_keys or ())
