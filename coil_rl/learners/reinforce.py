"""REINFORCE (paper equation 67; Williams 1992): actions become more likely by what they brought.

What an action brought is the discounted sum of the rewards from its step on, the return to go, less a baseline that
knows only the state, which leaves the expected gradient as it is and makes it less noisy.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from torchrl.objectives import ReinforceLoss

from coil_rl.learners.actor_critic import ActorCritic
from coil_rl.learners.advantages import Advantages


class Reinforce(ActorCritic):
    """The REINFORCE learner: minimises - mean(log pi(a | s) (G - b(s))).

    Batches are so many steps, whatever episodes do meanwhile, and not all episodes in one have ended. One that goes on
    (also one that a time limit cut short) is worth, from there on, what the baseline says of its last state. Without a
    baseline nobody can say: its return is the rewards that the batch holds, so that what an action brings later than
    that is not counted, and batches should be long. To learn from whole episodes alone would be worse: that an episode
    ends within a batch follows from its actions, as in a crash.

    Args:
        env: for the shapes of what is observed and done.
        in_keys: what policy and baseline observe.
        gamma: discount.
        baseline: "critic", a network that learns the return to go of each state; "none", 0.
        standardise: the weights G - b of a minibatch; without a baseline this makes their mean one.
        networks_and_optimiser: everything else as for `ActorCritic`.

    Raises:
        ValueError: for a value outside its range.

    Example:
        >>> from coil_rl.envs import ConeTrackEnv, shipped_tracks
        >>> from coil_rl.train.rollout import Rollout
        >>> env = ConeTrackEnv(shipped_tracks("train"), num_cars=64)
        >>> reinforce = Reinforce(env)
        >>> metrics = reinforce.update(Rollout(env, reinforce.policy, steps=32).collect())
    """

    kind = "agent"

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[str] = ("observation",),
        *,
        gamma: float = 0.99,
        baseline: Literal["critic", "none"] = "critic",
        standardise: bool = True,
        **networks_and_optimiser: Any,
    ) -> None:
        if baseline not in ("critic", "none"):
            raise ValueError(f"baseline={baseline!r} must be critic or none")
        self.baseline = baseline
        super().__init__(env, in_keys, **networks_and_optimiser)
        self.standardise = standardise
        # With lambda = 1 an advantage is the return to go less the value of the state.
        self.advantage = Advantages(self.critic, gamma, gae_lambda=1.0)
        self.loss = ReinforceLoss(self.policy, self.critic, loss_critic_type="l2", functional=False)

    def build_critic(self, env: EnvBase, in_keys: Sequence[str], hidden: Sequence[int]) -> TensorDictModuleBase:
        """The baseline."""
        return Zero(in_keys) if self.baseline == "none" else super().build_critic(env, in_keys, hidden)

    def losses(self, minibatch: TensorDictBase) -> TensorDictBase:
        """TorchRL's losses by the names that its other losses have; that of no baseline is 0."""
        losses = super().losses(minibatch)
        losses.rename_key_("loss_actor", "loss_objective")
        losses.rename_key_("loss_value", "loss_critic")
        return losses if self.baseline == "critic" else losses.set("loss_critic", losses["loss_critic"] * 0)


class Zero(TensorDictModuleBase):
    """A critic that expects nothing of any state; writes `state_value` [*batch, 1]."""

    def __init__(self, in_keys: Sequence[str]) -> None:
        self.in_keys, self.out_keys = list(in_keys), ["state_value"]
        super().__init__()

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the value."""
        value = torch.zeros(*tensordict.shape, 1, device=tensordict.device)
        return tensordict.set("state_value", value)
