"""Env actions combined from the actions of agent and guide.

The data keep the agent's own action, so its log-probability stays valid. `ResidualAction` and `MixedAction` add the two
actions. `Takeover` and `JumpStart` replace the agent's action in some steps and write `agent_acts` [*batch, 1] with the
observation; learners leave the steps of the guide out of the policy loss.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import expand_as_right
from torch import Tensor
from torchrl.data import Binary, Composite, Unbounded

from coil_rl.transforms.guide_transform import GuideTransform, Schedule, SeededGenerator


class _ActionSum(GuideTransform):
    """Base class: sum of agent and guide action, clamped to the bounds of the action."""

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Check that there is advice and that actions are continuous; raises a `ValueError` for discrete actions."""
        if not self.action_space.continuous:
            raise ValueError(
                f"{type(self).__name__} needs continuous actions, but this env has {self.action_space.size} discrete "
                "ones; use Takeover, which replaces the agent's action in some steps"
            )
        return super().transform_observation_spec(observation_spec)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        combined = self._combine(tensordict[self.action_key], self.advice(tensordict))
        return tensordict.set(self.action_key, self.action_space.clamp(combined))

    def _combine(self, action: Tensor, advice: Tensor) -> Tensor:
        raise NotImplementedError


class ResidualAction(_ActionSum):
    """Residual policy: the env action is g + scale * a, clamped (Johannink et al. 2019).

    Args:
        scale: factor of the agent's action, a number or a schedule over the run. With 0 the guide acts alone.
        options: `guide`, `action_key` and `advice_key`, as for `GuideTransform`.
    """

    mdp_parameter = "scale"

    def __init__(self, scale: float | Schedule = 1.0, **options: Any) -> None:
        super().__init__(**options)
        self.scale = scale

    def _combine(self, action: Tensor, advice: Tensor) -> Tensor:
        return advice + self.current(self.scale) * action


class MixedAction(_ActionSum):
    """Weighted mean: the env action is weight * a + (1 - weight) * g.

    Args:
        weight: weight of the agent, a number or a schedule over the run. With 1 the agent acts alone.
        options: `guide`, `action_key` and `advice_key`, as for `GuideTransform`.
    """

    mdp_parameter = "weight"

    def __init__(self, weight: float | Schedule, **options: Any) -> None:
        super().__init__(**options)
        self.weight = weight

    def _combine(self, action: Tensor, advice: Tensor) -> Tensor:
        weight = self.current(self.weight)
        return weight * action + (1 - weight) * advice


class _ActionSwitch(GuideTransform):
    """Base class: the env gets the guide's action where `agent_acts` is false."""

    written: tuple[str, ...] = ("agent_acts",)

    def __init__(self, seed: int = 0, **options: Any) -> None:
        super().__init__(**options)
        self.rng = SeededGenerator(seed)

    def _draw(self) -> Tensor:
        """Draw a uniform number for every row, so that later draws do not depend on the data."""
        shape = (*self.parent.batch_size, 1)
        return torch.rand(shape, generator=self.rng.generator).to(self.parent.device)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        if not self.learns:
            return tensordict
        action, advice = tensordict[self.action_key], self.action_space.actions(self.advice(tensordict))
        # `agent_acts` has one more dimension than a discrete action.
        agent = tensordict["agent_acts"].reshape(tensordict.batch_size)
        return tensordict.set(self.action_key, torch.where(expand_as_right(agent, action), action, advice))

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add `agent_acts`."""
        observation_spec = super().transform_observation_spec(observation_spec)
        shape, device = (*self.parent.batch_size, 1), self.parent.device
        observation_spec["agent_acts"] = Binary(1, shape=shape, device=device, dtype=torch.bool)
        return observation_spec


class Takeover(_ActionSwitch):
    """Random takeover by the guide in each step: the mixture of DAgger (Ross et al. 2011; paper algorithm 7).

    In evaluation the agent always acts.

    Args:
        probability: probability of the guide (beta in DAgger), a number or a schedule over the run.
        options: `seed` of the draws, `guide`, `action_key` and `advice_key`, as for `GuideTransform`.
    """

    def __init__(self, probability: float | Schedule = 1.0, **options: Any) -> None:
        super().__init__(**options)
        self.probability = probability

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        draw = self._draw()
        agent = draw >= self.current(self.probability) if self.learns else torch.ones_like(draw, dtype=torch.bool)
        return next_tensordict.set("agent_acts", agent)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)


class JumpStart(_ActionSwitch):
    """Jump start: the guide acts in the first steps of each episode, then the agent (Uchendu et al. 2023).

    In evaluation the agent always acts. `guide_steps` [*batch, 1] counts the remaining steps of the guide.

    Args:
        horizon: steps of the guide, a number or a schedule over the run; a decreasing schedule is a curriculum.
        random: draw the horizon of each episode uniformly from 0 to `horizon`.
        options: `seed` of the draws, `guide`, `action_key` and `advice_key`, as for `GuideTransform`.
    """

    written = ("agent_acts", "guide_steps")

    def __init__(self, horizon: float | Schedule, random: bool = False, **options: Any) -> None:
        super().__init__(**options)
        self.horizon, self.random = horizon, random

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        draw = self._draw()
        horizon = max(self.current(self.horizon), 0.0) if self.learns else 0.0
        # Rounded down, so that 0, 1 ... horizon are equally likely.
        steps = (draw * (horizon + 1)).long() if self.random else torch.full_like(draw, horizon).long()
        return self._write(tensordict_reset, steps)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._write(next_tensordict, (tensordict["guide_steps"] - 1).clamp(0))

    def _write(self, tensordict: TensorDictBase, steps: Tensor) -> TensorDictBase:
        return tensordict.set("guide_steps", steps).set("agent_acts", steps == 0)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add `agent_acts` and `guide_steps`."""
        shape, device = (*self.parent.batch_size, 1), self.parent.device
        observation_spec["guide_steps"] = Unbounded(shape, device=device, dtype=torch.int64)
        return super().transform_observation_spec(observation_spec)
