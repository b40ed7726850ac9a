"""Dropout of advice: whole episodes without it, so that the policy also learns to act alone."""

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite

from coil_rl.transforms.guide_transform import GuideTransform, SeededGenerator


class AdviceDropout(GuideTransform):
    """Advice that is missing in some episodes of the training.

    Missing advice is zeros, and `advice_given` [*batch, 1] is false. One run then gives a policy
    with its guide and one without: see `in_evaluation`.

    Args:
        probability: of an episode without advice, in training; from 0 to 1, else a `ValueError`.
        in_evaluation: whether there is advice in evaluation.
        seed: of the draws.
        action_key: entry of the env's action.
        advice_key: entry of the advice, [*batch, n_guides, A]; that of all guides is left out.
    """

    written = ("advice_given",)

    def __init__(
        self,
        probability: float = 0.5,
        in_evaluation: bool = True,
        seed: int = 0,
        *,
        action_key: NestedKey = "action",
        advice_key: NestedKey = "guide_action",
    ) -> None:
        super().__init__(action_key=action_key, advice_key=advice_key)
        if not 0 <= probability <= 1:
            raise ValueError(f"probability={probability} must be at least 0 and at most 1")
        self.probability, self.in_evaluation = probability, in_evaluation
        self.rng = SeededGenerator(seed)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        shape = (*self.parent.batch_size, 1)
        # A number for every row, so that later draws do not depend on which rows are reset.
        given = self.rng.sample(torch.rand, shape) >= self.probability
        if not self.learns:
            given = torch.full(shape, self.in_evaluation)
        return self._write(tensordict_reset, given.to(self.parent.device))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._write(next_tensordict, tensordict["advice_given"])

    def _write(self, tensordict: TensorDictBase, given: Tensor) -> TensorDictBase:
        """Write the advice, or zeros where it is not `given` [*batch, 1]."""
        advice = tensordict[self.advice_key]
        shape = (*tensordict.batch_size, *[1] * (advice.ndim - tensordict.ndim))
        advice = advice * given.reshape(shape).to(advice.dtype)
        return tensordict.set(self.advice_key, advice).set("advice_given", given)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add `advice_given`."""
        observation_spec = super().transform_observation_spec(observation_spec)
        shape, device = (*self.parent.batch_size, 1), self.parent.device
        observation_spec["advice_given"] = Binary(1, shape=shape, device=device, dtype=torch.bool)
        return observation_spec
