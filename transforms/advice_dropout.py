"""Dropout of advice: whole episodes without it, so that the policy also learns to act alone."""

from collections.abc import Mapping

import torch
from tensordict import NestedKey, TensorDictBase
from torchrl.data import Binary, TensorSpec

from coil_rl.ranges import Share, checked
from coil_rl.transforms.guide_transform import GuideTransform, SeededGenerator
from coil_rl.transforms.link import State


@checked
class AdviceDropout(GuideTransform):
    """Advice that is missing in some episodes of the training.

    Missing advice is zeros, and `advice_given` [*batch, 1] is false. One run then gives a policy
    with its guide and one without: see `in_evaluation`.

    Args:
        probability: of an episode without advice, in training.
        in_evaluation: whether there is advice in evaluation.
        seed: of the draws.
        advice_key: entry of the advice, [*batch, n_guides, A]; that of all guides is left out.
    """

    written = ("advice_given",)
    constant = True

    def __init__(
        self,
        probability: Share = 0.5,
        in_evaluation: bool = True,
        seed: int = 0,
        *,
        action_key: NestedKey = "action",
        advice_key: NestedKey = "guide_action",
    ) -> None:
        super().__init__(action_key=action_key, advice_key=advice_key)
        self.probability, self.in_evaluation = probability, in_evaluation
        self.rng = SeededGenerator(seed)

    def first(self, data: TensorDictBase, reset: TensorDictBase | None = None) -> State:
        """Draw which rows get advice in this episode."""
        shape = (*data.batch_size, 1)
        if not self.learns:
            given = torch.full(shape, self.in_evaluation)
        else:
            # A number for every row, so that later draws do not depend on which rows are reset.
            given = self.rng.sample(torch.rand, shape) >= self.probability
        return {"advice_given": given.to(data.device or "cpu")}

    def observe(self, data: TensorDictBase, state: State) -> State:
        """Write the advice, or zeros where there is none."""
        advice = data[self.advice_key]
        shape = (*data.batch_size, *[1] * (advice.ndim - data.ndim))
        given = state["advice_given"].reshape(shape).to(advice.dtype)
        data.set(self.advice_key, advice * given)
        return state

    @property
    def state(self) -> Mapping[NestedKey, TensorSpec]:
        """Whether there is advice in this episode."""
        return {"advice_given": self._of_rows(Binary, 1, dtype=torch.bool)}
