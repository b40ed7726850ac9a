"""Deep Q-learning (Mnih et al. 2015), by default with double Q-learning (van Hasselt et al. 2016).

A network says of each choice what return it expects, Q(s, a). Steps of the past are drawn at random, and Q(s, a) is
moved towards y = r + gamma * Q'(s', argmax_b Q(s', b)), or r alone where the episode terminated; Q' is a copy of the
network that follows it slowly. The agent takes the best choice and, in some of the steps, any.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torchrl.data import Categorical, OneHot
from torchrl.envs import EnvBase
from torchrl.modules import EGreedyModule, QValueModule
from torchrl.objectives import DQNLoss

from coil_rl.learners import networks
from coil_rl.learners.limits import check_numbers
from coil_rl.learners.off_policy import OffPolicy
from coil_rl.schedules import Schedule, schedule


class DQN(OffPolicy):
    """The DQN learner: networks, replay, loss and optimiser.

    Args:
        env: for the shapes of what is observed and the number of choices.
        in_keys: what the network observes. COIL is DQN with `guide_action` among them, which is one-hot.
        hidden: widths of the hidden layers.
        action_gain: size of the weights behind the values at the start; with 0 every choice is worth 0.
        learning_rate: of Adam, a number or a schedule over the run.
        gamma: discount.
        epsilon: share of the steps in which the agent takes any choice, a number or a schedule. Deterministic it never
            does.
        double: let the network choose and its slow copy judge the next action; else the copy does both.
        tau: share of the way to the network that its slow copy goes after each minibatch.
        max_grad_norm: gradients are scaled down to this norm.
        capacity: steps that are kept.
        batch_size: steps of a minibatch.
        ratio: how often a step is learned from, on average.
        starts: steps before it begins to learn.
        seed: of the draws of minibatches.

    Raises:
        ValueError: for a value outside its range, an env that takes numbers, or as `Replay`.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from coil_rl.envs import ConeTrackEnv, shipped_tracks
        >>> from coil_rl.train.rollout import Rollout
        >>> from coil_rl.transforms import DiscreteActions
        >>> env = TransformedEnv(ConeTrackEnv(shipped_tracks("train"), num_cars=64), DiscreteActions(5))
        >>> dqn = DQN(env, starts=256)
        >>> metrics = dqn.update(Rollout(env, dqn.policy, steps=8, keys=dqn.keys).collect())
    """

    kind = "agent"

    minimised = reported = ("loss",)

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[str] = ("observation",),
        *,
        hidden: Sequence[int] = (64, 64),
        action_gain: float = 1.0,
        learning_rate: float | Schedule = 1e-3,
        gamma: float = 0.99,
        epsilon: float | Schedule = 0.1,
        double: bool = True,
        tau: float = 0.005,
        max_grad_norm: float = 10.0,
        capacity: int = 100_000,
        batch_size: int = 256,
        ratio: float = 8.0,
        starts: int = 1_000,
        seed: int = 0,
    ) -> None:
        self.epsilon = schedule(epsilon)
        check_numbers(1, hidden=min(hidden, default=1))
        check_numbers(0, action_gain=action_gain)
        for progress in (0, 1):
            check_numbers(0, 1, epsilon=self.epsilon(progress))
        spec = env.action_spec
        if not isinstance(spec, (Categorical, OneHot)):
            raise ValueError(
                "DQN takes one of a few choices, but this env takes numbers; "
                "put the transform DiscreteActions around it: action=choices"
            )
        one = env.action_spec_unbatched  # the network is asked about batches of any size
        network = networks.Network(env, in_keys, hidden, spec.space.n, action_gain, layers=networks.relu_layers)
        self.network = TensorDictSequential(networks.Keyed(network, in_keys, ["action_value"]), QValueModule(spec=one))
        self.explorer = EGreedyModule(one, eps_init=float(self.epsilon(0)), eps_end=0.0, device=env.device)
        self.policy = TensorDictSequential(*self.network.module, self.explorer)
        # Huber's loss would fit medians, which do not see the rare step that ends an episode, unless rewards were tiny.
        loss = DQNLoss(self.network, action_space=one, double_dqn=double, delay_value=True, loss_function="l2")
        super().__init__(
            env, in_keys, loss, learning_rate=learning_rate, gamma=gamma, tau=tau, max_grad_norm=max_grad_norm,
            capacity=capacity, batch_size=batch_size, ratio=ratio, starts=starts, seed=seed,
        )  # fmt: skip

    def update(self, batch: TensorDictBase, progress: float = 0.0) -> dict[str, float]:
        """As `OffPolicy` does.

        Args:
            batch: [*B, T] with `keys`.
            progress: share of the run that is over, for the schedules.

        Returns:
            What `OffPolicy` returns; the mean `value` of the best choice in the last minibatch, 0 before it begins to
            learn; and `epsilon`.
        """
        metrics = super().update(batch, progress)
        self.explorer.eps.fill_(self.epsilon(progress))
        return metrics | {"epsilon": self.epsilon(progress)}

    @torch.no_grad()
    def describe(self, minibatch: TensorDictBase | None) -> dict[str, float]:
        """The mean value of the best choice, 0 before it begins to learn."""
        value = 0.0 if minibatch is None else float(self.network(minibatch)["chosen_action_value"].mean())
        return {"value": value}

    def state_dict(self) -> dict[str, Any]:
        """Everything an update depends on besides the batch."""
        return {"policy": self.policy.state_dict()} | super().state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over a state of `state_dict`."""
        self.policy.load_state_dict(state["policy"])
        super().load_state_dict(state)
