"""The policy of a finished run as a guide."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch
from numpy.typing import NDArray
from omegaconf import DictConfig
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import (
    Compose,
    EnvBase,
    ExplorationType,
    TransformedEnv,
    set_exploration_type,
)

from coil_rl.config.build import assemble
from coil_rl.config.pretrained import run_folder
from coil_rl.config.saved import read_config
from coil_rl.errors import UserError
from coil_rl.guides import PerRow
from coil_rl.run.parts import TRAIN
from coil_rl.run.policy_batch import memory_keys
from coil_rl.run.run import Run
from coil_rl.transforms.action_space import ActionSpace, OwnChoices, first_choices, space_of
from coil_rl.transforms.hosted import HostedGuide
from coil_rl.transforms.normalised_action import normalising

LONGEST_CHAIN = 4  # learned guides of learned guides
_loading: list[Path] = []  # runs that are being loaded, each of which is a guide of the one before


class LearnedGuide(HostedGuide):
    """Deterministic action of a trained policy, with the guides and action transforms of its run.

    All rows act at once. Where the policy, a guide of it or a transform depends on earlier steps,
    they act one after the other, each with a `Controller` of its own.

    Args:
        run: folder of a run of `coil-train`, or `pretrained:NAME`.
        which: the policy that the run hands over, or the last one.
        device: of the networks.

    Raises:
        UserError: if the folder holds no finished run, or one that is its own guide.
        ValueError: if the run has no policy (method=guide).
    """

    def __init__(
        self,
        run: str,
        which: Literal["handed_over", "last"] = "handed_over",
        device: str = "cpu",
    ) -> None:
        super().__init__()
        folder = run_folder(run)
        config = read_config(folder, "run", {"device": device})
        if config.method.observes is None:
            raise ValueError(
                f"{folder} trained no agent: its method is {config.method.name}; name its guide "
                "instead"
            )
        with _guarded(folder):
            opened = assemble(config, folder)
            all_rows = _AllRows(config, opened, which)
            guide: TensorDictModuleBase = all_rows
            if all_rows.needs_past:
                guide = PerRow(partial(_OneRow, opened, which), all_rows.plant_keys)
        self.in_keys, self.out_keys = guide.in_keys, guide.out_keys
        self.guide, self.first = guide, all_rows.first
        self.folder, self.space = folder, all_rows.space
        self.requires_grad_(False)
        self.eval()

    @property
    def by_row(self) -> bool:  # type: ignore[override]
        """Whether there is one object for each row, see `Guides`."""
        return isinstance(self.guide, PerRow)

    def meet(self, space: ActionSpace, choices: OwnChoices) -> None:
        """Check the action of an env.

        Raises:
            UserError: if the policy has another number of choices or other bounds, which may be in
                another unit.
        """
        if not self.space.range.same_as(space.range):
            raise UserError(
                f"run={self.folder} acts {self.space.range}, but the action of this env goes "
                f"{space.range}: give a run in an env with the same action, or convert it by a "
                "wrapper"
            )

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `action` as executed by the env, and the next state of a policy with a memory."""
        tensordict = self.guide(tensordict)
        if self.first is not None:
            tensordict["action"] = tensordict["action"] + self.first
        return tensordict


class _AllRows(TensorDictModuleBase):
    """The policy of a run on all rows at once, without a past behind its transforms.

    Attributes:
        needs_past: whether it has such a past, so that it must not be used.
        plant_keys: entries of the env of the run.
        first: lowest numbers of the choices of the env, [n] or one; None: 0.
        space: of the actions of the env of the run.
    """

    def __init__(self, config: DictConfig, run: Run, which: str) -> None:
        super().__init__()
        # The transforms need the specs of an env; some need at least two rows.
        env = run.make_env.bare(2, TRAIN, None)
        first = normalising(env)
        env = TransformedEnv(env, Compose(*first, *run.make_env.transforms("")))
        self.policy = run.load_policy(env, which)
        memory = memory_keys(self.policy)
        self.in_keys, self.out_keys = list(self.policy.in_keys), ["action", *memory]
        specs = env.base_env.observation_spec
        self.plant_keys = observed(env.base_env)
        self.space = space_of(env.base_env, env.base_env.action_key)
        lowest = first_choices(env.base_env)
        self.first = None if lowest is None else lowest.squeeze()
        self.transforms, self.needs_past = None, False
        if first or config.method.transforms or config.action:
            self.transforms = env.transform
            parts = env.transform.modules()
            self.needs_past = bool(memory) or any(getattr(p, "needs_past", False) for p in parts)
            self.in_keys = [key for key in specs if key != "info"]
        # Transforms hold a weak reference to their env; the tuple keeps it from becoming a
        # submodule.
        self._env = (env,)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `action` as executed by the env, and the next state of a policy with a memory."""
        data = tensordict.select(*self.in_keys)
        if self.transforms is not None:
            data = self.transforms(data)
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            data = self.policy(data)
        if self.transforms is not None:
            data = self.transforms.inv(data)
        for key in self.out_keys:
            tensordict.set(key, data[key])
        return tensordict


def observed(env: EnvBase) -> list[NestedKey]:
    """Return the entries of an env without those under `info`."""
    keys = env.observation_spec.keys(True, True)
    return [key for key in keys if isinstance(key, str) or key[0] != "info"]


class _OneRow:
    """The policy of a run on one row, with its past; the object of a row for `PerRow`."""

    def __init__(self, run: Run, which: str) -> None:
        self.controller = run.controller(which)
        self.keys = observed(self.controller.plant)
        self.reset = self.controller.reset
        self.state_dict = self.controller.state_dict
        self.load_state_dict = self.controller.load_state_dict

    def act(self, *values: NDArray[Any]) -> NDArray[Any]:
        """Return the action for the entries of the row."""
        plant = self.controller.plant
        entries = plant.full_observation_spec.zero()
        for key, value in zip(self.keys, values, strict=True):
            entries.set(key, torch.as_tensor(value, device=plant.device)[None])
        return self.controller.act_on(entries)[0].cpu().numpy()


@contextmanager
def _guarded(folder: Path) -> Iterator[None]:
    """Refuse a run that is already being loaded as a guide, and too long a chain of them."""
    place = folder.resolve()
    if place in _loading:
        raise UserError(f"run={folder} is its own guide; give a run that does not depend on itself")
    if len(_loading) == LONGEST_CHAIN:
        raise UserError(
            f"run={folder} ends a chain of more than {LONGEST_CHAIN} learned guides; give a "
            "shorter one"
        )
    _loading.append(place)
    try:
        yield
    finally:
        _loading.pop()
