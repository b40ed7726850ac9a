"""Many rooms as one batched env of TorchRL."""

import math
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

HOURS, STEPS = 0.25, 96  # of a step, of an episode


class Rooms(EnvBase):
    """Rooms as `thermostat.room.Room`, all stepped at once.

    Args:
        num_envs: B.
        seed: of the days that are drawn.
        first_seed: of those of the cases, for evaluation.
        cases: number of these; row i always has day `i % cases`.
        goal: degrees Celsius.
    """

    def __init__(
        self,
        num_envs: int = 1,
        seed: int = 0,
        first_seed: int | None = None,
        cases: int = 1,
        goal: float = 21.0,
    ) -> None:
        super().__init__(batch_size=[num_envs])
        self.goal, self.generator, self.days = goal, torch.Generator(), None
        if first_seed is not None:
            days = torch.rand(cases, generator=torch.Generator().manual_seed(first_seed))
            self.days = days[torch.arange(num_envs) % cases]
        self.set_seed(seed)
        self.rooms = torch.zeros(num_envs, 4)  # air, wall, mean outside, number of steps
        number, flag = Unbounded((num_envs, 1)), Binary(1, (num_envs, 1), dtype=torch.bool)
        info = Composite(power=number.clone(), in_band=number.clone(), shape=(num_envs,))
        self.observation_spec = Composite(
            observation=Unbounded((num_envs, 2)), info=info, shape=(num_envs,)
        )
        self.action_spec, self.reward_spec = Bounded(0, 1, (num_envs, 1)), number
        self.done_spec = Composite(
            done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=(num_envs,)
        )

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:
        count, everything = len(self.rooms), torch.ones(len(self.rooms), 1, dtype=torch.bool)
        mask = everything if tensordict is None else tensordict.get("_reset", everything)
        days = torch.rand(count, generator=self.generator) if self.days is None else self.days
        begin = torch.tensor([15.0, 14.0, -5.0, 0.0]).repeat(count, 1)
        begin[:, 2] += 15 * days
        self.rooms = torch.where(mask, begin, self.rooms)
        return TensorDict(
            self._observed(torch.zeros(count)) | dict(self.done_spec.zero()), self.batch_size
        )

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        (air, wall, mean, steps), outside, power = (
            self.rooms.unbind(-1),
            self._outside(),
            tensordict["action"][:, 0],
        )
        flows = 1.5 * (wall - air) + 0.3 * (outside - air) + 15 * power
        walls = 0.4 * (air - wall) + 0.05 * (outside - wall)
        air, wall, steps = air + HOURS * flows, wall + HOURS * walls, steps + 1
        self.rooms = torch.stack([air, wall, mean, steps], -1)
        reward = (1 - (air - self.goal).abs() / 5).clamp(min=0) - 0.1 * power
        hot, over = air > 40, steps >= STEPS
        ends = {"reward": reward, "terminated": hot, "truncated": over, "done": hot | over}
        columns = {name: column.unsqueeze(-1) for name, column in ends.items()}
        return TensorDict(self._observed(power) | columns, self.batch_size)

    def _outside(self) -> Tensor:
        return self.rooms[:, 2] + 5 * torch.sin(2 * math.pi * HOURS * self.rooms[:, 3] / 24)

    def _observed(self, power: Tensor) -> dict[str, Any]:
        error = self.rooms[:, 0] - self.goal
        info = {"power": power.unsqueeze(-1), "in_band": (error.abs() < 0.5).float().unsqueeze(-1)}
        return {"observation": torch.stack([error, self._outside()], -1), "info": info}

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self.generator.manual_seed(seed)

    def get_extra_state(self) -> dict[str, Any]:
        """Return what a checkpoint needs, so that a resumed run goes on to the bit."""
        return {"generator": self.generator.get_state(), "rooms": self.rooms}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Go on from such a state."""
        self.generator.set_state(state["generator"])
        self.rooms = state["rooms"]
