"""Actions made of the agent's and the guide's. The data keep the agent's, whose probability so stays the right one."""

from __future__ import annotations

from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite

from coil_rl.transforms.guided import Guided, Schedule


class _CombinedAction(Guided):
    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """See that there is advice, and that actions can be added up.

        Raises:
            ValueError: if they are choices.
        """
        if not self.space.continuous:
            raise ValueError(
                f"{type(self).__name__} adds actions up, but this env takes one of {self.space.size} choices; "
                "use Takeover, by which the guide acts in some of the steps"
            )
        return super().transform_observation_spec(observation_spec)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        combined = self._combine(tensordict[self.action_key], self.advice(tensordict))
        return tensordict.set(self.action_key, self.space.clamp(combined))

    def _combine(self, action: Tensor, advice: Tensor) -> Tensor:
        raise NotImplementedError


class ResidualAction(_CombinedAction):
    """The env gets g + scale * a, clipped: the agent learns what to add to its guide (Johannink et al. 2019).

    Args:
        scale: of the agent's part, a number or a schedule over the run. With 0 the guide drives alone.
        guide: which row of the advice.
    """

    alters = "scale"

    def __init__(self, scale: float | Schedule = 1.0, guide: int = 0) -> None:
        super().__init__(guide=guide)
        self.scale = scale

    def _combine(self, action: Tensor, advice: Tensor) -> Tensor:
        return advice + self.now(self.scale) * action


class MixedAction(_CombinedAction):
    """The env gets weight * a + (1 - weight) * g.

    Args:
        weight: of the agent, a number or a schedule over the run. One that ends with 1 leaves the agent alone.
        guide: which row of the advice.
    """

    alters = "weight"

    def __init__(self, weight: float | Schedule, guide: int = 0) -> None:
        super().__init__(guide=guide)
        self.weight = weight

    def _combine(self, action: Tensor, advice: Tensor) -> Tensor:
        weight = self.now(self.weight)
        return weight * action + (1 - weight) * advice
