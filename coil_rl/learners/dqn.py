"""Deep Q-learning (Mnih et al. 2015), by default with double Q-learning (van Hasselt et al. 2016).

A network says of each choice what return it expects, Q(s, a). Steps of the past are drawn at random, and Q(s, a) is
moved towards y = r + gamma * Q'(s', argmax_b Q(s', b)), or r alone where the episode terminated; Q' is a copy of the
network that follows it slowly. The agent takes the best choice and, in some of the steps, any.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torchrl.data import Categorical, OneHot
from torchrl.envs import EnvBase
from torchrl.modules import EGreedyModule, QValueModule
from torchrl.objectives import DQNLoss, SoftUpdate

from coil_rl import networks
from coil_rl.learners.replay import Replay
from coil_rl.schedules import Schedule, schedule


class DQN:
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
        >>> from coil_rl.rollout import Rollout
        >>> from coil_rl.transforms import DiscreteActions
        >>> env = TransformedEnv(ConeTrackEnv(shipped_tracks("train"), num_cars=64), DiscreteActions(5))
        >>> dqn = DQN(env, starts=256)
        >>> metrics = dqn.update(Rollout(env, dqn.policy, steps=8, keys=dqn.keys).collect())
    """

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
        self.learning_rate, self.epsilon = schedule(learning_rate), schedule(epsilon)
        for name, number, highest in (
            ("gamma", gamma, 1), ("tau", tau, 1), ("epsilon", self.epsilon(0), 1), ("epsilon", self.epsilon(1), 1),
            ("action_gain", action_gain, math.inf), ("learning_rate", self.learning_rate(0), math.inf),
        ):  # fmt: skip
            if not 0 <= number <= highest:
                raise ValueError(f"{name}={number} must be at least 0 and at most {highest}")
        if min(hidden, default=1) < 1:
            raise ValueError(f"hidden={min(hidden)} must be at least 1")
        if not 0 < max_grad_norm < math.inf:
            raise ValueError(f"max_grad_norm={max_grad_norm} must be a finite number of more than 0")
        spec = env.action_spec
        if not isinstance(spec, (Categorical, OneHot)):
            raise ValueError(
                "DQN takes one of a few choices, but this env takes numbers; "
                "put the transform DiscreteActions around it: action=choices"
            )
        self.replay = Replay(
            env, in_keys, capacity=capacity, batch_size=batch_size, ratio=ratio, starts=starts, seed=seed
        )
        self.keys = self.replay.keys
        one = env.action_spec_unbatched  # the network is asked about batches of any size
        network = networks.Network(env, in_keys, hidden, spec.space.n, action_gain, layers=networks.relu_layers)
        self.network = TensorDictSequential(networks.Keyed(network, in_keys, ["action_value"]), QValueModule(spec=one))
        self.explorer = EGreedyModule(one, eps_init=float(self.epsilon(0)), eps_end=0.0, device=env.device)
        self.policy = TensorDictSequential(*self.network.module, self.explorer)
        # Huber's loss would fit medians, which do not see the rare step that ends an episode, unless rewards were tiny.
        self.loss = DQNLoss(self.network, action_space=one, double_dqn=double, delay_value=True, loss_function="l2")
        self.loss.make_value_estimator(gamma=gamma)
        self.target = SoftUpdate(self.loss, tau=tau)
        self.max_grad_norm = max_grad_norm
        self.parameters = list(self.network.parameters())
        self.optimiser = torch.optim.Adam(self.parameters, lr=self.learning_rate(0), fused=True)

    def update(self, batch: TensorDictBase, progress: float = 0.0) -> dict[str, float]:
        """Keep the steps of a batch, and learn from steps of the past.

        Args:
            batch: [*B, T] with `keys`. A truncated episode counts as going on.
            progress: share of the run that is over, for the schedules.

        Returns:
            The `loss`, mean over the minibatches, and the mean `value` of the best choice in the last of
            them, both 0 before it begins to learn; how many `minibatches` there were; the steps that are `kept`; what
            the schedules say.
        """
        for group in self.optimiser.param_groups:
            group["lr"] = self.learning_rate(progress)
        self.replay.add(batch)
        losses = []
        for minibatch in self.replay.draws():
            losses.append(self.loss(minibatch)["loss"])
            self.optimiser.zero_grad()
            losses[-1].backward()
            torch.nn.utils.clip_grad_norm_(self.parameters, self.max_grad_norm)
            self.optimiser.step()
            self.target.step()
        self.explorer.eps.fill_(self.epsilon(progress))
        with torch.no_grad():
            value = float(self.network(minibatch)["chosen_action_value"].mean()) if losses else 0.0
        return {
            "loss": float(torch.stack(losses).detach().mean()) if losses else 0.0,
            "value": value,
            "minibatches": float(len(losses)),
            "kept": float(len(self.replay)),
            "epsilon": self.epsilon(progress),
            "learning_rate": self.learning_rate(progress),
        }

    def state_dict(self) -> dict[str, Any]:
        """Everything an update depends on besides the batch."""
        return {
            "policy": self.policy.state_dict(),
            "loss": self.loss.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "replay": self.replay.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over a state of `state_dict`."""
        self.policy.load_state_dict(state["policy"])
        self.loss.load_state_dict(state["loss"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.replay.load_state_dict(state["replay"])
