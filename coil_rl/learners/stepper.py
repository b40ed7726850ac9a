"""A learner as the optimisation step of TorchRL's `Trainer`."""

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.trainers import Trainer
from torchrl.trainers.trainers import OptimizationStepper

from coil_rl.learners.learner import Learner


class LearnerStepper(OptimizationStepper):
    """Runs a learner in TorchRL's `Trainer`: one step is one update with the whole batch.

    Give the trainer `optim_steps_per_batch=1`, no replay buffer and no optimiser: the learner has
    its own, draws its own minibatches and computes its own advantages. The collector needs the
    learner's policy, and the trainer's checkpoint has the learner's state. The progress of its
    schedules is the share of `total_frames` that was collected before the batch.

    Args:
        learner: any learner of this package.

    Example:
        >>> from torchrl.collectors import Collector
        >>> from coil_rl import PPO, GymnasiumEnv
        >>> env = GymnasiumEnv("CartPole-v1", num_envs=4)
        >>> ppo = PPO(env, minibatches=4)
        >>> collector = Collector(env, ppo.policy, frames_per_batch=64, total_frames=128)
        >>> trainer = Trainer(
        ...     collector=collector,
        ...     total_frames=128,
        ...     frame_skip=1,
        ...     optim_steps_per_batch=1,
        ...     loss_module=ppo.policy,
        ...     optimization_stepper=LearnerStepper(ppo),
        ...     progress_bar=False,
        ... )
        >>> trainer.train()
    """

    def __init__(self, learner: Learner) -> None:
        self.learner = learner

    def step(self, trainer: Trainer, sub_batch: TensorDictBase) -> TensorDictBase:
        """Update the learner with a batch [B, T], and return its metrics.

        Args:
            trainer: which has counted the frames of the batch already.
            sub_batch: steps of all rows of an env, with the learner's `keys`.
        """
        before = trainer.collected_frames - sub_batch.numel() * trainer.frame_skip
        metrics = self.learner.update(sub_batch, max(0.0, before / trainer.total_frames))
        return TensorDict({name: torch.tensor(value) for name, value in metrics.items()})

    def state_dict(self) -> dict[str, Any]:
        """Return the state of the learner."""
        return self.learner.state_dict()

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restore the state of the learner.

        Args:
            state_dict: from `state_dict`.
        """
        self.learner.load_state_dict(dict(state_dict))
