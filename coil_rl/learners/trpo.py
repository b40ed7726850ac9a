"""Trust region policy optimisation (paper equations 89 and 90; Schulman et al. 2015).

Each batch gives one step along the natural gradient: the direction in which the objective grows
most for a given KL divergence of the policy. To second order the divergence is x F x / 2 with the
Fisher matrix F, so the step is F^-1 g, scaled to the bound. F is never formed: conjugate gradients
need its product with a vector only, a second derivative of the divergence. A line search then makes
sure that the objective improved and that the bound holds.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Unpack

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase

from coil_rl.learners.batches import of_agent, standardise
from coil_rl.learners.gradient import Weights
from coil_rl.learners.policy import Entries
from coil_rl.learners.ppo import PPO, OnPolicySettings
from coil_rl.ranges import Count, Index, Interval, NonNegative, Positive, Share, checked
from coil_rl.schedules import Linear, Schedule

# Returns the total loss, the divergence from the policy before the step, and each loss by name.
Surrogate = Callable[[], tuple[Tensor, Tensor, dict[str, Tensor]]]


@checked
class TRPO(PPO):
    """The TRPO learner. The optimiser, its passes and its minibatches are for the critic only.

    Args:
        max_kl: bound on a step, mean KL(before || after) over the batch.
        damping: added to the diagonal of the Fisher matrix, which may be singular.
        iterations: of the conjugate gradients.
        backtracks: how often the line search may shorten a step.
        shrink: factor by which it shortens a step.
        learning_rate: of the critic by Adam, a number or a schedule.
        epochs: passes of the critic over each batch.
        settings: further ones of `PPO`; a network without a memory. Minibatches and `max_grad_norm`
            are those of the critic, and losses of `auxiliary` are part of the objective.
    """

    with_memory = False

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[NestedKey] = ("observation",),
        *,
        max_kl: Positive = 0.03,
        damping: NonNegative = 0.1,
        iterations: Count = 10,
        backtracks: Index = 10,
        shrink: Annotated[float, Interval(gt=0, le=1)] = 0.8,
        learning_rate: NonNegative | Schedule = Linear(1e-3, 0.0),
        gae_lambda: Share = 0.95,
        epochs: Count = 5,
        **settings: Unpack[OnPolicySettings],
    ) -> None:
        super().__init__(
            env,
            in_keys,
            learning_rate=learning_rate,
            gae_lambda=gae_lambda,
            epochs=epochs,
            entropy=0.0,
            critic=1.0,
            compile=False,
            **settings,
        )
        self.max_kl, self.damping, self.iterations = max_kl, damping, iterations
        self.backtracks, self.shrink = backtracks, shrink
        self.of_policy = Weights(self.policy)

    def parameter_groups(self) -> list[list[nn.Parameter]]:
        """Return the parameters of the critic."""
        return [list(self.critic.parameters())]

    def update(self, batch: TensorDictBase, progress: float = 0.0) -> dict[str, float]:
        """Learn from a batch of rollouts; arguments as for `PPO.update`.

        Returns:
            The losses of the policy after its step; `kl`, the divergence of the step; `step`, its
            length as a fraction of the longest one within the bound, 0 if none was taken; the
            critic's mean loss and its learning rate.
        """
        rows = self.prepare(batch, progress)
        report = self.improve(rows, progress)
        metrics = {name: float(value) for name, value in report.items()}
        errors = []
        for minibatch in self.sampler.draw(rows):
            error, _ = self.critic_loss(minibatch)
            self.gradient.minimise(error)
            errors.append(error.detach())
        metrics["loss_critic"] = float(torch.stack(errors).mean())
        metrics["learning_rate"] = self.learning_rate(progress)
        return metrics | self.extensions.finish(batch, progress)

    def improve(self, rows: Entries, progress: float = 0.0) -> dict[str, Any]:
        """Take a step of the policy; returns its metrics.

        Of the rows [N] with `minibatch_keys` those in which a guide acted count for the losses of
        extensions only.
        """
        weights = self.loss_weights(progress)
        if len(of_agent(rows)["advantage"]) < 2:  # one advantage cannot be standardised
            nothing = {name: 0.0 for name in weights if name != "loss_critic"}
            return nothing | {"kl": 0.0, "step": 0.0}
        evaluate = self.surrogate(rows, weights)
        with self.of_policy.used():
            loss, divergence, losses = evaluate()
        step = self.natural_step(loss, divergence)
        improved = self.line_search(evaluate, loss, step)
        if improved is None:
            return losses | {"kl": 0.0, "step": 0.0}
        return improved

    def surrogate(self, rows: Entries, weights: Mapping[str, float]) -> Surrogate:
        """Return a function that evaluates the policy, which may change, beside the present one.

        Args:
            rows: [N] with `minibatch_keys`.
            weights: of the losses by name.
        """
        agent_rows = of_agent(rows)
        advantage = standardise(agent_rows["advantage"]).squeeze(-1)
        with torch.no_grad():
            before = self.head.density(Entries(agent_rows))

        def evaluate() -> tuple[Tensor, Tensor, dict[str, Tensor]]:
            after = self.head.density(Entries(agent_rows))
            ratio = (after.log_prob(agent_rows["action"]) - agent_rows["action_log_prob"]).exp()
            losses = {"loss_objective": -(ratio * advantage).mean()}
            total = weights["loss_objective"] * losses["loss_objective"]
            for name, loss in self.extensions.losses(self.head, rows).items():
                losses[name] = loss
                total = total + weights[name] * loss
            return total, before.divergence(after).mean(), losses

        return evaluate

    def natural_step(self, loss: Tensor, divergence: Tensor) -> Tensor:
        """Return the change of the policy's weights along the natural gradient of a loss, a vector.

        To second order the `divergence` of the policy from itself becomes the bound.
        """
        weights = self.of_policy.vector
        gradient = derivative(loss, weights)
        slope = derivative(divergence, weights, differentiable=True)

        def fisher(vector: Tensor) -> Tensor:
            return derivative(slope @ vector, weights) + self.damping * vector

        direction = conjugate_gradients(fisher, -gradient, self.iterations)
        curvature = direction @ fisher(direction)
        return direction * (2 * self.max_kl / curvature.clamp_min(1e-30)).sqrt()

    @torch.no_grad()
    def line_search(self, evaluate: Surrogate, loss: Tensor, step: Tensor) -> dict[str, Any] | None:
        """Take the longest part of a step with a smaller loss and a divergence within the bound.

        Returns:
            The losses after the step, `kl` and `step`; None if no part will do.
        """
        weights = self.of_policy.vector
        start, fraction = weights.clone(), 1.0
        for _ in range(self.backtracks + 1):
            weights.copy_(start + fraction * step)
            new_loss, divergence, new_losses = evaluate()
            if (new_loss < loss) & (divergence <= self.max_kl):
                return new_losses | {"kl": divergence, "step": fraction}
            fraction *= self.shrink
        weights.copy_(start)
        return None


def conjugate_gradients(
    product: Callable[[Tensor], Tensor], target: Tensor, iterations: int
) -> Tensor:
    """Solve A x = b for a positive definite A, given its `product` with a vector.

    For b = `target` [n], n iterations suffice in exact arithmetic. Iterations after convergence
    change nothing, so that nothing has to wait for the device.
    """
    solution, residual, direction = torch.zeros_like(target), target.clone(), target.clone()
    square = first_square = residual @ residual
    for _ in range(iterations):
        active = square > 1e-10 * first_square
        image = product(direction)
        length = torch.where(active, square / (direction @ image), 0.0)
        solution, residual = solution + length * direction, residual - length * image
        last_square, square = square, residual @ residual
        direction = residual + torch.where(active, square / last_square, 0.0) * direction
    return solution


def derivative(value: Tensor, weights: Tensor, differentiable: bool = False) -> Tensor:
    """Return the derivative of a scalar by all weights, a vector; the graph is kept."""
    return torch.autograd.grad(value, weights, retain_graph=True, create_graph=differentiable)[0]
