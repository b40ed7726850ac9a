"""REINFORCE (paper equation 67; Williams 1992).

The probability of an action changes with the return G that followed it, the discounted sum of the
rewards from its step on. A baseline b that depends on the state only is subtracted: it reduces the
variance of the gradient and not its mean.

    loss = -mean(log pi(a | s) (G - b(s)))

An episode that goes on after the batch, or was truncated, is bootstrapped from the baseline of its
last state. Without a baseline its return ends with the batch, so batches should be long. Complete
episodes alone would give a bias, because their length depends on the actions.
"""

from collections.abc import Sequence
from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from torchrl.envs import EnvBase

from coil_rl.envs.limits import check_choice
from coil_rl.learners import networks
from coil_rl.learners.a2c import A2C
from coil_rl.learners.encoders import Mlp
from coil_rl.schedules import Linear, Schedule


class Reinforce(A2C):
    """The REINFORCE learner: A2C with the whole return, lambda = 1; `standardise` then concerns G - b.

    The `baseline` is "critic", a network trained on the returns, or "none"; other arguments are
    those of `A2C`.
    """

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[NestedKey] = ("observation",),
        *,
        baseline: Literal["critic", "none"] = "critic",
        learning_rate: float | Schedule = Linear(1e-3, 0.0),
        **options: Any,
    ) -> None:
        check_choice(("critic", "none"), baseline=baseline)
        self.baseline, critic = baseline, float(baseline == "critic")
        super().__init__(
            env,
            in_keys,
            learning_rate=learning_rate,
            gae_lambda=1.0,
            entropy=0.0,
            critic=critic,
            **options,
        )

    def build_networks(
        self, env: EnvBase, in_keys: Sequence[NestedKey], network: Mlp, **options: Any
    ) -> tuple[ProbabilisticTensorDictSequential, TensorDictModuleBase]:
        """Return policy and baseline."""
        if self.baseline == "critic":
            return super().build_networks(env, in_keys, network, **options)
        return networks.actor(
            env, in_keys, network, normaliser=self.normaliser, **options
        ), ZeroCritic(in_keys)


class ZeroCritic(TensorDictModuleBase):
    """A critic that writes 0 as `state_value` [*batch, 1]."""

    def __init__(self, in_keys: Sequence[NestedKey]) -> None:
        self.in_keys, self.out_keys = list(in_keys), ["state_value"]
        super().__init__()

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the value."""
        return tensordict.set(
            "state_value", torch.zeros(*tensordict.shape, 1, device=tensordict.device)
        )
