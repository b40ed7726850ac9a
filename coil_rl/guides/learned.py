"""The policy of a run as a guide: today's agent can advise tomorrow's."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from coil_rl.train.build import build_bare_env, build_transforms
from coil_rl.train.load import load_policy, read_config


class LearnedGuide(TensorDictModuleBase):
    """What a trained policy would do, its action being the deterministic one.

    It brings along what the policy needs: a policy of COIL asks its own guide, a residual policy adds to it.

    Args:
        run: the folder that `coil-train` left.
        which: the last policy, or the one with the best return of a training batch.
        device: where it runs.

    Raises:
        UserError: if the folder holds no finished run.
    """

    def __init__(self, run: str, which: Literal["last", "best"] = "last", device: str = "cpu") -> None:
        super().__init__()
        folder = Path(run).expanduser()
        config = read_config(folder, "run", {"device": device})
        if config.method.observes is None:
            raise ValueError(f"{folder} trained no agent: its method is {config.method.name}; name its guide instead")
        # What the transforms need of an env are its specs; one of them is there for two cars or more.
        env = TransformedEnv(build_bare_env(config, {"num_cars": 2}), Compose(*build_transforms(config)))
        self.policy, self.transforms = load_policy(folder, config, env, which), None
        self.in_keys, self.out_keys = list(self.policy.in_keys), ["action"]
        if config.method.needs_guide or config.action:
            self.transforms = env.transform
            self.in_keys = [key for key in env.base_env.observation_spec if key != "info"]
        # Transforms know their env by a weak reference; in a tuple it is no module of this one.
        self._kept = (env,)
        self.requires_grad_(False)
        self.eval()

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `action`, as the env gets it in the end."""
        seen = tensordict.select(*self.in_keys)
        if self.transforms is not None:
            seen = self.transforms(seen)
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            chosen = self.policy(seen)
        if self.transforms is not None:
            chosen = self.transforms.inv(chosen)
        return tensordict.set("action", chosen["action"])
