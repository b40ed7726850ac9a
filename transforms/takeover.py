"""The guide acts instead of the agent in some steps, and the data say in which.

Whether the agent acts in a step is decided before it chooses its action and stands beside what it observes, as
`agent_acts` [*batch, 1]. Where it does not, its action is not what the env gets, and a learner leaves it out of the
policy's loss.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.utils import expand_as_right
from torch import Tensor
from torchrl.data import Binary, Composite, Unbounded

from coil_rl.transforms.guided import Guided, Schedule


class _Takeover(Guided):
    """What both kinds of it have: a generator, and the exchange of the action."""

    def __init__(self, guide: int, seed: int, *more_keys: str) -> None:
        super().__init__(["agent_acts", *more_keys], guide=guide)
        self.generator = torch.Generator().manual_seed(seed)

    def get_extra_state(self) -> Tensor:
        """The generator's state."""
        return self.generator.get_state()

    def set_extra_state(self, state: Tensor) -> None:
        """Restore the generator."""
        self.generator.set_state(state.cpu())

    def _draw(self) -> Tensor:
        """A uniform number for every row, whichever need one: the next numbers must not depend on the data."""
        return torch.rand((*self.parent.batch_size, 1), generator=self.generator).to(self.parent.device)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        if not self.training:
            return tensordict
        action, advice = tensordict[self.action_key], self.space.actions(self.advice(tensordict))
        # The flag has one number a row, and a choice may have none.
        agent = tensordict["agent_acts"].reshape(tensordict.batch_size)
        return tensordict.set(self.action_key, torch.where(expand_as_right(agent, action), action, advice))

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add who acts."""
        observation_spec = super().transform_observation_spec(observation_spec)
        shape, device = (*self.parent.batch_size, 1), self.parent.device
        observation_spec["agent_acts"] = Binary(1, shape=shape, device=device, dtype=torch.bool)
        return observation_spec


class Takeover(_Takeover):
    """In each step the guide acts with some probability: DAgger's mixture (Ross et al. 2011; paper algorithm 7).

    In evaluation the agent always acts.

    Args:
        probability: of the guide (DAgger's beta), a number or a schedule over the run.
        guide: which row of the advice.
        seed: of the draws.
    """

    def __init__(self, probability: float | Schedule = 1.0, guide: int = 0, seed: int = 0) -> None:
        super().__init__(guide, seed)
        self.probability = probability

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        draw = self._draw()
        agent = draw >= self.now(self.probability) if self.training else torch.ones_like(draw, dtype=torch.bool)
        return next_tensordict.set("agent_acts", agent)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)


class JumpStart(_Takeover):
    """The guide drives the first steps of each episode, then the agent (Uchendu et al. 2023, jump-start RL).

    In evaluation the agent drives from the start.

    Args:
        horizon: how many steps the guide drives, a number or a schedule over the run: one that falls is a curriculum.
        random: each episode draws its own horizon, uniform between 0 and this one.
        guide: which row of the advice.
        seed: of the draws.
    """

    def __init__(self, horizon: float | Schedule, random: bool = False, guide: int = 0, seed: int = 0) -> None:
        super().__init__(guide, seed, "guide_steps")
        self.horizon, self.random = horizon, random

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        draw = self._draw()
        horizon = max(self.now(self.horizon), 0.0) if self.training else 0.0
        # Rounded down so that 0, 1 ... horizon are equally likely.
        steps = (draw * (horizon + 1)).long() if self.random else torch.full_like(draw, horizon).long()
        return self._write(tensordict_reset, steps)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._write(next_tensordict, (tensordict["guide_steps"] - 1).clamp(0))

    def _write(self, tensordict: TensorDictBase, steps: Tensor) -> TensorDictBase:
        tensordict.set("guide_steps", steps)
        return tensordict.set("agent_acts", steps == 0)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add who acts, and for how many steps the guide still does."""
        shape, device = (*self.parent.batch_size, 1), self.parent.device
        observation_spec["guide_steps"] = Unbounded(shape, device=device, dtype=torch.int64)
        return super().transform_observation_spec(observation_spec)
