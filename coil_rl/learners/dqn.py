"""Deep Q-learning (Mnih et al. 2015), by default with double Q-learning (van Hasselt et al. 2016).

A network estimates the return of each discrete action, Q(s, a). For stored steps sampled at random,
Q(s, a) is moved towards y = r + gamma * Q'(s', argmax_b Q(s', b)), or y = r where the episode
terminated. Q' is a target network that follows Q slowly. The policy is epsilon-greedy.
"""

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from tensordict.utils import NestedKey
from torchrl.data import Categorical, OneHot
from torchrl.envs import EnvBase
from torchrl.modules import EGreedyModule, QValueModule
from torchrl.objectives import DQNLoss

from coil_rl.envs.limits import check_range
from coil_rl.learners import networks
from coil_rl.learners.anchor import AnchoredValues
from coil_rl.learners.encoders import Mlp, ObservationNetwork, entry_specs, without_memory
from coil_rl.learners.off_policy import OffPolicy
from coil_rl.schedules import Linear, Schedule, schedule
from coil_rl.transforms.action_space import nested_key


class DQN(OffPolicy):
    """The DQN learner.

    COIL is DQN with `guide_action` among `in_keys`; the advice is one-hot. A value out of range, an
    env with continuous actions, and what `OffPolicy` refuses are a `ValueError`.

    Args:
        env: the env, with discrete actions.
        in_keys: entries that the network observes.
        hidden: widths of the hidden layers, without `network`.
        network: architecture of the network; None: `Mlp(hidden, "relu")`.
        action_gain: initial scale of the last weights; with 0 all action values are 0.
        epsilon: probability of a random action, a number or a schedule; 0 for deterministic
            actions.
        double: whether the network, not the target network, selects the next action.
        tau, ratio, options: as for `OffPolicy`.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from coil_rl.envs import ConeTrackEnv, shipped_tracks
        >>> from coil_rl.run.rollout import Rollout
        >>> from coil_rl.transforms import DiscreteActions
        >>> env = TransformedEnv(ConeTrackEnv(shipped_tracks("train"), num_envs=64), DiscreteActions(5))
        >>> dqn = DQN(env, starts=256)
        >>> metrics = dqn.update(Rollout(env, dqn.policy, steps=8, keys=dqn.keys).collect())
    """

    parts = ("policy", *OffPolicy.parts)
    minimised = reported = ("loss",)

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[NestedKey] = ("observation",),
        *,
        hidden: Sequence[int] = (128, 128),
        network: Mlp | None = None,
        action_gain: float = 1.0,
        epsilon: float | Schedule = Linear(1.0, 0.05, until=0.3),
        double: bool = True,
        tau: float = 0.01,
        ratio: float = 16.0,
        **options: Any,
    ) -> None:
        self.epsilon = schedule(epsilon)
        check_range(0, action_gain=action_gain)
        for progress in (0, 1):
            check_range(0, 1, epsilon=self.epsilon(progress))
        spec = env.action_spec
        if spec.dtype.is_floating_point:
            remedy = "put the transform DiscreteActions around it: action=choices"
            raise ValueError(
                f"DQN needs discrete actions, but this env has continuous ones; {remedy}"
            )
        if not isinstance(spec, (Categorical, OneHot)) or len(
            networks.action_shape(env)
        ) != isinstance(spec, OneHot):
            raise ValueError(
                "DQN needs one discrete action, but this env has several at once; use PPO"
            )
        in_keys, network = (
            list(map(nested_key, in_keys)),
            without_memory(network or Mlp(hidden, "relu"), "DQN"),
        )
        super().__init__(env, in_keys, tau=tau, ratio=ratio, **options)
        single = env.action_spec_unbatched  # the network is evaluated on batches of any size
        numbers = ObservationNetwork(
            env, in_keys, network, spec.space.n, action_gain, dtype=env.reward_spec.dtype
        )
        keys = in_keys if self.normaliser is None else self.normaliser.reads(in_keys)
        values = networks.FastTensorDictModule(numbers, keys, ["action_value"])
        self.network = TensorDictSequential(values, QValueModule(spec=single))
        self.explorer = EGreedyModule(
            single, eps_init=float(self.epsilon(0)), eps_end=0.0, device=env.device
        )
        before = [] if self.normaliser is None else [self.normaliser]
        valued, chosen = self.network.module
        if self.anchor is not None:
            (advice,) = entry_specs(env, [self.anchor.advice_key])
            bonus = self.anchor.attach(AnchoredValues(advice.shape[-2], env.device))
            before.append(valued)
            valued = networks.FastTensorDictModule(
                bonus, [self.anchor.advice_key, "action_value"], ["action_value"]
            )
        self.policy = TensorDictSequential(*before, valued, chosen, self.explorer)
        # Huber's loss estimates medians. These ignore the rare step that ends an episode, unless
        # rewards are tiny.
        options = {"double_dqn": double, "delay_value": True, "loss_function": "l2"}
        self.set_loss(DQNLoss(self.network, action_space=single, **options))

    def update(self, batch: TensorDictBase, progress: float = 0.0) -> dict[str, float]:
        """Store the steps of a batch and learn; arguments as for `OffPolicy.update`.

        Returns:
            The metrics of `OffPolicy`; `value`, the mean value of the best action in the last
            minibatch, 0 before learning starts; and `epsilon`.
        """
        metrics = super().update(batch, progress)
        epsilon = (
            self.anchor.noise_at if self.anchor is not None and self.anchor.holds else self.epsilon
        )
        self.explorer.eps.fill_(epsilon(progress))
        return metrics | {"epsilon": epsilon(progress)}

    @torch.no_grad()
    def describe(self, minibatch: TensorDictBase | None) -> dict[str, float]:
        """Return the mean value of the best action, 0 before learning starts."""
        value = (
            0.0
            if minibatch is None
            else float(self.network(minibatch)["chosen_action_value"].mean())
        )
        return {"value": value}
