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
from typing import Literal, Unpack

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs import EnvBase

from coil_rl.learners.a2c import A2C
from coil_rl.learners.encoders import Mlp
from coil_rl.learners.networks import FastTensorDictModule
from coil_rl.learners.ppo import OnPolicySettings
from coil_rl.ranges import NonNegative, checked
from coil_rl.schedules import Linear, Schedule


@checked
class Reinforce(A2C):
    """The REINFORCE learner: A2C with the whole return, lambda = 1.

    Args:
        baseline: "critic", a network that is trained on the returns, or "none".
        standardise: whether to standardise G - b in a minibatch. The coefficients of other losses
            then do not depend on the scale of the reward.
        settings: further ones of `PPO`.
    """

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[NestedKey] = ("observation",),
        *,
        baseline: Literal["critic", "none"] = "critic",
        learning_rate: NonNegative | Schedule = Linear(1e-3, 0.0),
        compile: bool | Literal["auto"] = "auto",
        standardise: bool = True,
        **settings: Unpack[OnPolicySettings],
    ) -> None:
        self.baseline = baseline
        super().__init__(
            env,
            in_keys,
            learning_rate=learning_rate,
            gae_lambda=1.0,
            entropy=0.0,
            critic=float(baseline == "critic"),
            compile=compile,
            standardise=standardise,
            **settings,
        )

    def build_critic(
        self, env: EnvBase, in_keys: Sequence[NestedKey], network: Mlp
    ) -> TensorDictModuleBase:
        """Return the baseline."""
        if self.baseline == "critic":
            return super().build_critic(env, in_keys, network)
        key = in_keys[0]
        dims = len(env.observation_spec[key].shape) - len(env.batch_size)
        return FastTensorDictModule(Zero(dims), [key], ["state_value"])


class Zero(nn.Module):
    """The value 0 of a state.

    Args:
        dims: number of dimensions of the entry that is read, after those of a batch.
    """

    def __init__(self, dims: int) -> None:
        super().__init__()
        self.dims = dims

    def forward(self, entry: Tensor) -> Tensor:
        """Return the value, [*batch, 1]."""
        return torch.zeros(*entry.shape[: entry.ndim - self.dims], 1, device=entry.device)
