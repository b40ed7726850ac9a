"""Learning where a guide acts in some of the steps: the policy learns from its own steps only."""

from collections.abc import Callable, Sequence

from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

AGENT_ACTS = "agent_acts"  # entry [*batch, 1]: whether the agent acted in a step


def guide_may_act(env: EnvBase) -> bool:
    """Return whether a guide acts in some steps of an env, which then writes `agent_acts`."""
    return AGENT_ACTS in env.observation_spec


def of_agent(steps: TensorDictBase) -> TensorDictBase:
    """Return the steps of [N] in which the agent acted; all without the entry `agent_acts`."""
    if AGENT_ACTS not in steps:
        return steps
    return steps[steps[AGENT_ACTS].squeeze(-1)]


class LossesOfAgentSteps:
    """The losses of a minibatch in which a guide may have acted.

    Those of the policy are from the agent's steps, that of the critic from all steps.

    Args:
        losses: returns the losses of steps [N] by name, with `loss_objective`, `loss_critic` and
            perhaps `loss_entropy`.
        critic_loss: returns the loss of the critic of steps [N], and more.
    """

    def __init__(
        self,
        losses: Callable[[TensorDictBase], TensorDictBase],
        critic_loss: Callable[[TensorDictBase], Sequence[Tensor]],
    ) -> None:
        self.losses, self.critic_loss = losses, critic_loss

    def __call__(self, minibatch: TensorDictBase) -> TensorDictBase:
        """Return the losses of a minibatch [N] by name."""
        agent_steps = of_agent(minibatch)
        if len(agent_steps) < 2:  # one advantage cannot be standardised
            return self._without_policy(minibatch)
        losses = self.losses(agent_steps)
        losses["loss_critic"] = self.critic_loss(minibatch)[0].mean()
        return losses

    def _without_policy(self, minibatch: TensorDictBase) -> TensorDictBase:
        losses = self.losses(minibatch)
        for name in ("loss_objective", "loss_entropy"):
            if name in losses:
                losses[name] = losses[name] * 0
        return losses
