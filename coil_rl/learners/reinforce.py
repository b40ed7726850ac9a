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
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from coil_rl.learners.a2c import A2C
from coil_rl.learners.encoders import Mlp
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
        return ZeroCritic(key, len(env.observation_spec[key].shape) - len(env.batch_size))


class ZeroCritic(TensorDictModuleBase):
    """A critic that writes 0 as `state_value` [*batch, 1].

    Args:
        key: entry that it reads for the size of a batch.
        dims: number of dimensions of this entry after those of a batch.
    """

    by_key = True

    def __init__(self, key: NestedKey, dims: int) -> None:
        self.in_keys, self.out_keys, self.dims = [key], ["state_value"], dims
        super().__init__()

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the value."""
        entry = tensordict[self.in_keys[0]]
        batch = entry.shape[: entry.ndim - self.dims]
        return tensordict.set("state_value", torch.zeros(*batch, 1, device=entry.device))
