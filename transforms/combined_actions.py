"""Env actions combined from the actions of agent and guide.

`action` remains the agent's own action, so its log-probability stays valid. The action that the env
was given is `("next", "executed_action")` [*batch, *A], in the unit of the agent's action.
`ResidualAction`, `MixedAction` and `AdaptiveMixedAction` add the two actions. `Takeover`,
`JumpStart` and `GradualResidual` let the guide act alone in some steps and write `agent_acts`
[*batch, 1] with the observation; on-policy learners leave these steps out of the policy loss,
learners with replay learn from the executed action where the agent could have chosen it.
"""

from abc import abstractmethod
from collections.abc import Mapping
from typing import Unpack

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.utils import expand_as_right
from torch import Tensor, nn
from torchrl.data import Binary, Bounded, Composite, TensorSpec, Unbounded

from coil_rl.ranges import Share, checked
from coil_rl.transforms.guide_transform import (
    GuideSettings,
    GuideTransform,
    Schedule,
    SeededGenerator,
)
from coil_rl.transforms.link import State

EXECUTED, WEIGHT, ACTS, REMAINING = "executed_action", "agent_weight", "agent_acts", "guide_steps"


class CombinedAction(GuideTransform):
    """Base class: executes another action than the agent's, and writes it as `executed_action`.

    After a reset that entry is 0.

    Args:
        settings: further ones of `GuideTransform`.
    """

    written: tuple[str, ...] = (EXECUTED,)
    adds = False  # whether the guide's action is added to the agent's, not put in its place

    def __init__(self, **settings: Unpack[GuideSettings]) -> None:
        super().__init__(**settings)
        # Steps in training, over all rows.
        self.taken: Tensor = nn.Buffer(torch.zeros((), dtype=torch.int64))

    def act(self, data: TensorDictBase, state: State) -> State:
        """Write the action to execute."""
        if self.training:
            self.taken = self.taken + data.numel()
        executed = self._executed(data)
        # The transform next to the env is the last one here, so its action remains.
        data.set(self.action_key, executed).set(EXECUTED, executed)
        return state

    @abstractmethod
    def _executed(self, tensordict: TensorDictBase) -> Tensor:
        """Return the action to execute, [*batch, *A], by the observation and the agent's action."""

    @property
    def records(self) -> Mapping[NestedKey, TensorSpec]:
        """The executed action."""
        spec = self.action_space.spec  # not its own spec, as 0 need not be an action
        return {EXECUTED: Unbounded(spec.shape, device=self.parent.device, dtype=spec.dtype)}

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the entries that it writes; a `ValueError` if choices would have to be added."""
        if self.adds and not self.action_space.continuous:
            raise ValueError(
                f"{type(self).__name__} needs continuous actions, but this env has "
                f"{self.action_space.size} discrete ones; take method=coil_anchored, method=coil, "
                "or Takeover, which replaces the agent's action in some steps"
            )
        return super().transform_observation_spec(observation_spec)


class ResidualAction(CombinedAction):
    """Residual policy: the env action is g + scale * a, clamped (Johannink et al. 2019).

    It is computed in normalised actions, see `ActionUnits`: an agent in the centre of the action
    leaves the guide as it is.

    Args:
        scale: a number or a schedule over the run; with 0 the guide acts alone.
        settings: further ones of `GuideTransform`.
    """

    mdp_parameter = "scale"
    adds = True

    def __init__(
        self,
        scale: float | Schedule = 1.0,
        **settings: Unpack[GuideSettings],
    ) -> None:
        super().__init__(**settings)
        self.scale = scale

    def _executed(self, tensordict: TensorDictBase) -> Tensor:
        scale, action = self.current(self.scale), tensordict[self.action_key]
        return self.action_space.added(self.advice(tensordict), action, scale)


@checked
class MixedAction(CombinedAction):
    """Weighted mean: the env action is weight * a + (1 - weight) * g, clamped.

    Args:
        weight: of the agent, a number or a schedule over the run; with 1 the agent acts alone.
        settings: further ones of `GuideTransform`.
    """

    mdp_parameter = "weight"
    adds = True

    def __init__(
        self,
        weight: Share | Schedule,
        **settings: Unpack[GuideSettings],
    ) -> None:
        super().__init__(**settings)
        self.weight = weight

    def _executed(self, tensordict: TensorDictBase) -> Tensor:
        weight = self.current(self.weight)
        action, advice = tensordict[self.action_key], self.advice(tensordict)
        return self.action_space.clamp(weight * action + (1 - weight) * advice)


class AdaptiveMixedAction(CombinedAction):
    """Weighted mean in which the agent weighs more the surer its critics are.

    This is CHEQ (Cramer et al. 2024). The weight is observed as `agent_weight` [*batch, 1], so
    stored steps remain valid. It is `low` in the first step of an episode, then a linear function
    of `("next", "uncertainty")` [*batch, 1], which the policy wrote in the step before: `high` up
    to `certain`, and `low` from `uncertain` on, or if the policy writes none.

    Args:
        low: smallest weight of the agent, at least 0.
        high: largest weight of the agent, at most 1.
        certain: uncertainty up to which the weight is `high`, at least 0.
        uncertain: uncertainty from which on the weight is `low`, more than `certain`.
        warm_up: number of steps at the start of the run, over all rows, in which the weight is
            drawn from `low` to `warm_up_high` instead.
        warm_up_high: largest weight of the warm-up, from `low` to `high`.
        seed: of the draws.
        settings: further ones of `GuideTransform`.

    Raises:
        ValueError: for weights that are not in order within [0, 1], or uncertainties not in order.
    """

    written = (EXECUTED, WEIGHT)
    adds = True

    def __init__(
        self,
        low: float = 0.2,
        high: float = 1.0,
        certain: float = 0.03,
        uncertain: float = 0.15,
        warm_up: int = 10_000,
        warm_up_high: float = 0.3,
        seed: int = 0,
        **settings: Unpack[GuideSettings],
    ) -> None:
        super().__init__(**settings)
        if not (0 <= low <= warm_up_high <= high <= 1 and 0 <= certain < uncertain):
            raise ValueError(
                f"low={low}, warm_up_high={warm_up_high} and high={high} must be in this order, "
                f"from 0 to 1, and certain={certain} at least 0 and less than uncertain={uncertain}"
            )
        self.low, self.high, self.certain, self.uncertain = low, high, certain, uncertain
        self.warm_up, self.warm_up_high, self.rng = warm_up, warm_up_high, SeededGenerator(seed)

    def _executed(self, tensordict: TensorDictBase) -> Tensor:
        advice, weight = self.advice(tensordict), tensordict[WEIGHT].squeeze(-1)
        weight = expand_as_right(weight, advice)
        return self.action_space.clamp(weight * tensordict[self.action_key] + (1 - weight) * advice)

    def weight_after(self, weight: Tensor, uncertainty: Tensor | None) -> Tensor:
        """Return the weight of the agent in the next step, [*batch, 1], as in evaluation.

        Args:
            weight: in this step, [*batch, 1].
            uncertainty: of the critics about this step, [*batch, 1]; None: not known.
        """
        if uncertainty is None:
            return torch.full_like(weight, self.low)
        share = (uncertainty - self.certain) / (self.uncertain - self.certain)
        return self.high - (self.high - self.low) * share.clamp(0, 1).to(weight.dtype)

    def first(self, data: TensorDictBase, reset: TensorDictBase | None = None) -> State:
        """Return the smallest weight."""
        space, shape = self.action_space, (*data.batch_size, 1)
        return {WEIGHT: torch.full(shape, self.low, dtype=space.dtype, device=data.device)}

    def act(self, data: TensorDictBase, state: State) -> State:
        """Write the action to execute, and return the weight in the next step."""
        weight = self.weight_after(state[WEIGHT], data.get(("next", "uncertainty"), None))
        if self.learns:
            draw = self.rng.sample(torch.rand, weight.shape).to(weight)
            drawn = self.low + (self.warm_up_high - self.low) * draw
            weight = torch.where((self.taken < self.warm_up).to(weight.device), drawn, weight)
        return {**super().act(data, state), WEIGHT: weight}

    def observe(self, data: TensorDictBase, state: State) -> State:
        """Leave the uncertainty of the step before out, which the policy wrote."""
        data.pop("uncertainty", None)
        return state

    @property
    def state(self) -> Mapping[NestedKey, TensorSpec]:
        """The weight of the agent."""
        dtype = self.action_space.dtype
        return {WEIGHT: self._of_rows(Bounded, self.low, self.high, dtype=dtype)}


class _ActionSwitch(CombinedAction):
    """Base class: the env gets the guide's action where `agent_acts` is false.

    Args:
        seed: of the draws.
        settings: further ones of `GuideTransform`.
    """

    written: tuple[str, ...] = (EXECUTED, ACTS)

    def __init__(self, seed: int = 0, **settings: Unpack[GuideSettings]) -> None:
        super().__init__(**settings)
        self.rng = SeededGenerator(seed)

    def _draw(self, data: TensorDictBase) -> Tensor:
        """Draw a uniform number for every row, so that later draws do not depend on the data."""
        return self.rng.sample(torch.rand, (*data.batch_size, 1)).to(data.device or "cpu")

    def _of_agent(self, tensordict: TensorDictBase) -> Tensor:
        """Return the env's action where the agent acts."""
        return tensordict[self.action_key]

    def _executed(self, tensordict: TensorDictBase) -> Tensor:
        action = self._of_agent(tensordict)
        if not self.learns:
            return action
        advice = self.action_space.actions(self.advice(tensordict))
        # `agent_acts` has one more dimension than a discrete action.
        agent = tensordict[ACTS].reshape(tensordict.batch_size)
        return torch.where(expand_as_right(agent, action), action, advice)

    @abstractmethod
    def _agent_acts(self, data: TensorDictBase, state: State) -> Tensor:
        """Return whether the agent acts in a state, [*batch, 1], in training."""

    def observe(self, data: TensorDictBase, state: State) -> State:
        """Write whether the agent acts."""
        if self.learns:
            acts = self._agent_acts(data, state)
        else:
            shape, device = (*data.batch_size, 1), data.device or "cpu"
            acts = torch.ones(shape, dtype=torch.bool, device=device)
        data.set(ACTS, acts)
        return state

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add `agent_acts` and what is remembered and recorded."""
        observation_spec = super().transform_observation_spec(observation_spec)
        observation_spec[ACTS] = self._of_rows(Binary, 1, dtype=torch.bool)
        return observation_spec


@checked
class Takeover(_ActionSwitch):
    """Random takeover by the guide in each step.

    This is the mixture of DAgger (Ross et al. 2011; paper algorithm 7). In evaluation the agent
    always acts.

    Args:
        probability: probability of the guide (beta in DAgger), from 0 to 1, a number or a schedule
            over the run.
        frames: number of steps at the start of the run, over all rows, after which the agent always
            acts, as in RLPD and WSRL; None for no limit.
        settings: further ones of `GuideTransform`.
    """

    def __init__(
        self,
        probability: Share | Schedule = 1.0,
        frames: int | None = None,
        *,
        seed: int = 0,
        **settings: Unpack[GuideSettings],
    ) -> None:
        super().__init__(seed, **settings)
        self.probability, self.frames = probability, frames

    def _agent_acts(self, data: TensorDictBase, state: State) -> Tensor:
        agent = self._draw(data) >= self.current(self.probability)
        if self.frames is None:
            return agent
        return agent | (self.taken >= self.frames).to(agent.device)


@checked
class GradualResidual(Takeover):
    """Residual policy that is mixed in step by step: Policy Decorator (Yuan et al. 2024).

    The env action is g with a probability that decreases over the run, else g + scale * a, clamped;
    in evaluation always the latter. It is computed in normalised actions, see `ActionUnits`.

    Args:
        scale: of the agent's action, a number or a schedule over the run.
        probability: of the guide's action alone, from 0 to 1, a number or a schedule over the run.
        frames: number of steps at the start of the run, over all rows, after which the agent's
            action is always added; None for no limit.
        settings: further ones of `GuideTransform`.
    """

    mdp_parameter = "scale"
    adds = True

    def __init__(
        self,
        scale: float | Schedule = 0.2,
        *,
        probability: Share | Schedule = 1.0,
        frames: int | None = None,
        seed: int = 0,
        **settings: Unpack[GuideSettings],
    ) -> None:
        super().__init__(probability, frames, seed=seed, **settings)
        self.scale = scale

    def _of_agent(self, tensordict: TensorDictBase) -> Tensor:
        scale, action = self.current(self.scale), super()._of_agent(tensordict)
        return self.action_space.added(self.advice(tensordict), action, scale)


class JumpStart(_ActionSwitch):
    """Jump start: the guide acts in the first steps of each episode, then the agent.

    It is due to Uchendu et al. 2023. In evaluation the agent always acts. `guide_steps` [*batch, 1]
    counts the remaining steps of the guide.

    Args:
        horizon: steps of the guide, a number or a schedule over the run; a decreasing schedule is a
            curriculum.
        random: draw the horizon of each episode uniformly from 0 to `horizon`.
        settings: further ones of `GuideTransform`.
    """

    written = (EXECUTED, ACTS, REMAINING)
    constant = True

    def __init__(
        self,
        horizon: float | Schedule,
        random: bool = False,
        *,
        seed: int = 0,
        **settings: Unpack[GuideSettings],
    ) -> None:
        super().__init__(seed, **settings)
        self.horizon, self.random = horizon, random

    def _agent_acts(self, data: TensorDictBase, state: State) -> Tensor:
        return state[REMAINING] == 0

    def first(self, data: TensorDictBase, reset: TensorDictBase | None = None) -> State:
        """Return the steps of the guide in this episode; none in evaluation."""
        if not self.learns:
            zero = torch.zeros((*data.batch_size, 1), dtype=torch.int64)
            return {REMAINING: zero.to(data.device or "cpu")}
        draw, horizon = self._draw(data), max(self.current(self.horizon), 0.0)
        if self.random:
            # Rounded down, so that 0, 1 ... horizon are equally likely.
            return {REMAINING: (draw * (horizon + 1)).long()}
        return {REMAINING: torch.full_like(draw, horizon).long()}

    def act(self, data: TensorDictBase, state: State) -> State:
        """Write the action to execute, and count down."""
        state = super().act(data, state)
        return {REMAINING: (state[REMAINING] - 1).clamp(0)} if self.learns else state

    @property
    def state(self) -> Mapping[NestedKey, TensorSpec]:
        """The remaining steps of the guide."""
        return {REMAINING: self._of_rows(Unbounded, dtype=torch.int64)}
