"""Deep Q-learning (Mnih et al. 2015), by default with double Q-learning (van Hasselt et al. 2016).

A network estimates the return of each discrete action, Q(s, a). For stored steps sampled at random,
Q(s, a) is moved towards y = r + gamma * Q'(s', argmax_b Q(s', b)), or y = r where the episode
terminated. Q' is a target network that follows Q slowly. The policy is epsilon-greedy.
"""

import math
from collections.abc import Sequence
from typing import Unpack

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from tensordict.utils import NestedKey
from torchrl.data import Categorical, OneHot
from torchrl.envs import EnvBase
from torchrl.modules import EGreedyModule, QValueModule
from torchrl.objectives import DQNLoss

from coil_rl.learners import networks
from coil_rl.learners.anchor import AnchoredInputs, AnchoredValues, hold_of
from coil_rl.learners.encoders import Mlp, ObservationNetwork, without_memory
from coil_rl.learners.off_policy import OffPolicy, Ratio, ReplaySettings
from coil_rl.ranges import NonNegative, Share, checked
from coil_rl.schedules import Linear, Schedule, schedule
from coil_rl.transforms.action_space import nested_key

HELD_EPSILON = 0.3  # largest probability of a random action of a policy that holds a guide


@checked
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
        settings: further ones of `OffPolicy`.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from coil_rl.envs import ConeTrackEnv, shipped_tracks
        >>> from coil_rl.run.rollout import Rollout
        >>> from coil_rl.transforms import DiscreteActions
        >>> cones = ConeTrackEnv(shipped_tracks("train"), num_envs=64)
        >>> env = TransformedEnv(cones, DiscreteActions(5))
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
        action_gain: NonNegative = 1.0,
        epsilon: Share | Schedule = Linear(1.0, 0.05, until=0.3),
        double: bool = True,
        tau: Share = 0.01,
        ratio: Ratio = 16.0,
        **settings: Unpack[ReplaySettings],
    ) -> None:
        self.epsilon = schedule(epsilon)
        check_actions(env)
        in_keys = [nested_key(key) for key in in_keys]
        network = without_memory(network or Mlp(hidden, "relu"), "DQN")
        super().__init__(env, in_keys, tau=tau, ratio=ratio, **settings)
        single = env.action_spec_unbatched  # the network is evaluated on batches of any size
        numbers = ObservationNetwork(
            env, in_keys, network, single.space.n, action_gain, dtype=env.reward_spec.dtype
        )
        keys = in_keys if self.inputs is None else self.inputs.reads(in_keys)
        values = networks.FastTensorDictModule(numbers, keys, ["action_value"])
        self.network = TensorDictSequential(values, QValueModule(spec=single))
        first = float(self.epsilon(0))
        if self.anchor is not None:  # of the first batch; whether a guide is held is not known yet
            first = min(first, HELD_EPSILON)
        self.explorer = EGreedyModule(single, eps_init=first, eps_end=0.0, device=env.device)
        self.policy = self.build_policy(env)
        # Huber's loss estimates medians. These ignore the rare step that ends an episode, unless
        # rewards are tiny.
        self.set_loss(
            DQNLoss(
                self.network,
                action_space=single,
                double_dqn=double,
                delay_value=True,
                loss_function="l2",
            )
        )
        self.extend([])

    def build_policy(self, env: EnvBase) -> TensorDictSequential:
        """Return the policy: values, perhaps a bonus for the advised action, choice and noise."""
        modules: list[TensorDictModuleBase] = [] if self.inputs is None else [self.inputs]
        values, choice = self.network.module
        modules.append(values)
        if self.anchor is not None and isinstance(self.inputs, AnchoredInputs):
            bonus = AnchoredValues(self.inputs.hold, self.anchor.choice_weight)
            keys = [self.anchor.advice_key, "action_value"]
            modules.append(networks.FastTensorDictModule(bonus, keys, ["action_value"]))
        return TensorDictSequential(*modules, choice, self.explorer)

    def update(self, batch: TensorDictBase, progress: float = 0.0) -> dict[str, float]:
        """Store the steps of a batch and learn; arguments as for `OffPolicy.update`.

        Returns:
            The metrics of `OffPolicy`; `value`, the mean value of the best action in the last
            minibatch, NaN without one; and `epsilon`.
        """
        metrics = super().update(batch, progress)
        epsilon = self.epsilon(progress)
        hold = hold_of(self.policy)
        if hold is not None and hold.held:
            epsilon = min(epsilon, HELD_EPSILON)
        self.explorer.eps.fill_(epsilon)
        return metrics | {"epsilon": epsilon}

    @torch.no_grad()
    def describe(self, minibatch: TensorDictBase | None) -> dict[str, float]:
        """Return the mean value of the best action in the last minibatch, NaN without one."""
        if minibatch is None:
            return {"value": math.nan}
        return {"value": float(self.network(minibatch)["chosen_action_value"].mean())}


def check_actions(env: EnvBase) -> None:
    """Raise a `ValueError` if an action of an env is not one of several options."""
    spec = env.action_spec
    if spec.dtype.is_floating_point:
        raise ValueError(
            "DQN needs discrete actions, but this env has continuous ones; put the transform "
            "DiscreteActions around it: action=choices"
        )
    is_one_hot = isinstance(spec, OneHot)
    dims = len(networks.action_shape(env))
    if not isinstance(spec, (Categorical, OneHot)) or dims != int(is_one_hot):
        raise ValueError("DQN needs one discrete action, but this env has several at once; use PPO")
