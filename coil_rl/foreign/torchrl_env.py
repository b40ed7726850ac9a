"""TorchRL envs without batch as one batched env."""

from collections.abc import Callable
from typing import Any

import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import EnvBase, StepCounter, TransformedEnv

from coil_rl.foreign.batch import SeededRows
from coil_rl.foreign.guard import Guard
from coil_rl.foreign.plant import TorchRLPlant
from coil_rl.foreign.rows import Rows
from coil_rl.ranges import Count, Seed, checked


@checked
class EnvBatch(SeededRows):
    """TorchRL envs without batch as one env of batch size [num_envs], stepped one after the other.

    The entries are those of the single env, with the batch dimension in front. Entries that the
    single env reads beside its action come from its own last step.

    Args:
        of: makes one env, without a batch and with one action; called once for each row.
        num_envs: B, number of rows.
        max_steps: steps after which an episode is truncated. With None an env that names no number
            of its own is truncated after 1,000, with a warning.
        cases: number of different episodes, by default `num_envs`; needs `first_seed`.

    Raises:
        ValueError: for an env with a batch or with several actions, and for a number out of range.

    Example:
        >>> from torchrl.envs import PendulumEnv
        >>> EnvBatch(PendulumEnv, num_envs=3).rollout(5)["next", "th"].shape
        torch.Size([3, 5])
    """

    def __init__(
        self,
        of: Callable[[], EnvBase],
        num_envs: Count = 1,
        *,
        max_steps: Count | None = None,
        seed: Seed = 0,
        first_seed: Seed | None = None,
        cases: Count | None = None,
    ) -> None:
        guard = Guard()
        with guard:
            envs = [of() for _ in range(num_envs)]
        if max_steps is not None and isinstance(envs[0], EnvBase):
            envs = [TransformedEnv(env, StepCounter(max_steps)) for env in envs]
        one = envs[0]
        name = type(one).__name__
        if not isinstance(one, EnvBase):
            raise ValueError(
                f"of makes {name}, which is no env of TorchRL; for an env of Gymnasium write "
                "env=gym env.id=MODULE:NAME"
            )
        if one.batch_size:
            raise ValueError(
                f"{name} has the batch size {list(one.batch_size)}: use it as it is, or without "
                "batch"
            )
        if len(one.action_keys) != 1:
            raise ValueError(
                f"{name} must have one action, it has {', '.join(map(str, one.action_keys))}"
            )
        self.held = Rows([TorchRLPlant(env, row) for row, env in enumerate(envs)], guard)
        super().__init__(
            self.held,
            num_envs,
            seed,
            first_seed,
            cases,
            one.device or "cpu",
        )
        for spec in ("observation_spec", "action_spec", "reward_spec", "done_spec"):
            full = f"full_{spec}"
            setattr(self, full, getattr(one, full).expand(num_envs).to(self.device))

    def _decode(self, actions: NDArray[Any]) -> Tensor:
        return torch.from_numpy(actions)

    def _output(self, *, stepped: bool) -> TensorDict:
        specs = [self.full_observation_spec, self.full_done_spec]
        if stepped:
            specs.append(self.full_reward_spec)
        keys = [key for spec in specs for key in spec.keys(True, True)]
        after = [plant.after.select(*keys) for plant in self.held.plants]
        return torch.stack(after).to(self.device)
