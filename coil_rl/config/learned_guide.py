"""The policy of a finished run as a guide."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import Compose, ExplorationType, TransformedEnv, set_exploration_type

from coil_rl.config.build import assemble, build_bare_env, build_transforms
from coil_rl.config.saved import read_config
from coil_rl.errors import UserError
from coil_rl.run.policy_batch import memory_keys

LONGEST_CHAIN = 4  # learned guides of learned guides
_loading: list[Path] = []  # runs that are being loaded, each of which is a guide of the one before


class LearnedGuide(TensorDictModuleBase):
    """Deterministic action of a trained policy, with the guides and action transforms of its run.

    Args:
        run: folder of a run of `coil-train`.
        which: the last policy, or the best of the kept ones.
        device: of the networks.

    Raises:
        UserError: if the folder holds no finished run, or one that is its own guide.
        ValueError: if the run has no policy (method=guide), one whose advice depends on earlier
            steps, or one with a memory behind transforms.
    """

    def __init__(
        self, run: str, which: Literal["last", "best"] = "last", device: str = "cpu"
    ) -> None:
        super().__init__()
        folder = Path(os.path.expanduser(run))
        config = read_config(folder, "run", {"device": device})
        if config.method.observes is None:
            raise ValueError(
                f"{folder} trained no agent: its method is {config.method.name}; name its guide instead"
            )
        with _guarded(folder):
            # The transforms need the specs of an env; some need at least two rows.
            env = TransformedEnv(
                build_bare_env(config, {"num_envs": 2}), Compose(*build_transforms(config))
            )
            self.policy = assemble(config, folder).load_policy(env, which)
            self.transforms = None
        memory = memory_keys(self.policy)
        self.in_keys, self.out_keys = list(self.policy.in_keys), ["action", *memory]
        if config.method.needs_guide or config.action:
            if memory:
                raise ValueError(
                    f"{folder} has a policy with a memory behind transforms, which is no guide; train one with "
                    "network=mlp, or with method=ppo action=continuous"
                )
            self.transforms = env.transform
            past = [
                type(part).__name__
                for part in env.transform.modules()
                if getattr(part, "needs_past", False)
            ]
            if past:
                raise ValueError(
                    f"{folder} has {', '.join(past)}, which needs earlier steps; its policy is no guide"
                )
            self.in_keys = [key for key in env.base_env.observation_spec if key != "info"]
        # Transforms hold a weak reference to their env; the tuple keeps it from becoming a
        # submodule.
        self._env = (env,)
        self.requires_grad_(False)
        self.eval()

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


@contextmanager
def _guarded(folder: Path) -> Iterator[None]:
    """Refuse a run that is already being loaded as a guide, and too long a chain of them."""
    place = folder.resolve()
    if place in _loading:
        raise UserError(f"run={folder} is its own guide; give a run that does not depend on itself")
    if len(_loading) == LONGEST_CHAIN:
        raise UserError(
            f"run={folder} ends a chain of more than {LONGEST_CHAIN} learned guides; give a shorter one"
        )
    _loading.append(place)
    try:
        yield
    finally:
        _loading.pop()
