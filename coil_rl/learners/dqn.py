"""Deep Q-learning (Mnih et al. 2015), by default with double Q-learning (van Hasselt et al. 2016).

A network estimates the return of each discrete action, Q(s, a). For stored steps sampled at random,
Q(s, a) is moved towards y = r + gamma * Q'(s', argmax_b Q(s', b)), or y = r where the episode
terminated. Q' is a target network that follows Q slowly. The policy is epsilon-greedy.
"""

from collections.abc import Sequence
from typing import Unpack

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Categorical, OneHot
from torchrl.envs import EnvBase
from torchrl.modules import EGreedyModule, QValueModule

from coil_rl.learners import networks
from coil_rl.learners.anchor import AnchoredInputs, AnchoredValues, hold_of
from coil_rl.learners.encoders import Mlp, ObservationNetwork
from coil_rl.learners.gradient import Weights
from coil_rl.learners.off_policy import OffPolicy, ReplaySettings, UpdatesPerStep
from coil_rl.learners.policy import Entries, next_of, read_through
from coil_rl.learners.rewards import discounted
from coil_rl.ranges import NonNegative, Positive, Share, checked
from coil_rl.schedules import Linear, Schedule, schedule

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

    minimised = ("loss",)
    reported = ("loss", "value")

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
        updates_per_step: UpdatesPerStep = 0.25,
        learning_rate: NonNegative | Schedule = Linear(1e-3, 0.0),
        max_grad_norm: Positive | None = 10.0,
        **settings: Unpack[ReplaySettings],
    ) -> None:
        self.epsilon = schedule(epsilon)
        check_actions(env)
        super().__init__(
            env,
            in_keys,
            network or Mlp(hidden, "relu"),
            tau=tau,
            updates_per_step=updates_per_step,
            learning_rate=learning_rate,
            max_grad_norm=max_grad_norm,
            **settings,
        )
        self.one_hot = isinstance(env.action_spec, OneHot)
        single = env.action_spec_unbatched  # the network is evaluated on batches of any size
        numbers = ObservationNetwork(
            env,
            self.in_keys,
            self.network,
            single.space.n,
            action_gain,
            dtype=env.reward_spec.dtype,
        )
        keys = read_through(self.inputs, self.in_keys)
        self.values = networks.FastTensorDictModule(numbers, keys, ["action_value"])
        self.choice = QValueModule(spec=single)
        first = float(self.epsilon(0))
        if self.anchor is not None:  # of the first batch; whether a guide is held is not known yet
            first = min(first, HELD_EPSILON)
        self.explorer = EGreedyModule(single, eps_init=first, eps_end=0.0, device=env.device)
        self.policy, self.double = self.build_policy(), double
        self.of_values = Weights(self.values)
        self.follow(self.values, self.of_values)
        self.set_update([self.of_values.vector], [*self.values.buffers()])

    def build_policy(self) -> TensorDictSequential:
        """Return the policy: values, perhaps a bonus for the advised action, choice and noise."""
        modules: list[TensorDictModuleBase] = [] if self.inputs is None else [self.inputs]
        modules.append(self.values)
        if self.anchor is not None and isinstance(self.inputs, AnchoredInputs):
            bonus = AnchoredValues(self.inputs.hold, self.anchor.choice_weight)
            keys = [self.anchor.advice_key, "action_value"]
            modules.append(networks.FastTensorDictModule(bonus, keys, ["action_value"]))
        return TensorDictSequential(*modules, self.choice, self.explorer)

    def losses(self, minibatch: Entries) -> dict[str, Tensor]:
        """Return the loss of a minibatch [N] and the mean value of the best action, scalars.

        Huber's loss estimates medians. These ignore the rare step that ends an episode, unless
        rewards are tiny.
        """
        action = minibatch["action"]
        index = action.argmax(-1) if self.one_hot else action
        with self.of_values.used():
            values = self.values(minibatch.copy())["action_value"]
            with torch.no_grad():
                target = self.targets(minibatch)
        chosen = values.gather(-1, index.long().unsqueeze(-1)).squeeze(-1)
        return {
            "loss": (chosen - target).square().mean(),
            "value": values.detach().amax(-1).mean(),
        }

    def targets(self, minibatch: Entries) -> Tensor:
        """Return y of a minibatch, [N]."""
        with self.of_target.used(fixed=True):
            values = self.target(next_of(minibatch))["action_value"]
        selecting = self.values(next_of(minibatch))["action_value"] if self.double else values
        best = values.gather(-1, selecting.argmax(-1, keepdim=True)).squeeze(-1)
        reward = minibatch["next", "reward"].squeeze(-1).to(best.dtype)
        return reward + discounted(minibatch, self.gamma, best)

    def update(self, batch: TensorDictBase, progress: float = 0.0) -> dict[str, float]:
        """Store the steps of a batch and learn; arguments as for `OffPolicy.update`.

        Returns:
            The metrics of `OffPolicy`, and `epsilon`.
        """
        metrics = super().update(batch, progress)
        epsilon = self.epsilon(progress)
        hold = hold_of(self.policy)
        if hold is not None and hold.held:
            epsilon = min(epsilon, HELD_EPSILON)
        self.explorer.eps.fill_(epsilon)
        return metrics | {"epsilon": epsilon}


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
