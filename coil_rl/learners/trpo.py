"""Trust region policy optimisation (paper equations 89 and 90; Schulman et al. 2015).

Each batch gives one step along the natural gradient: the direction in which the objective grows
most for a given KL divergence of the policy. To second order the divergence is x F x / 2 with the
Fisher matrix F, so the step is F^-1 g, scaled to the bound. F is never formed: conjugate gradients
need its product with a vector only, a second derivative of the divergence. A line search then makes
sure that the objective improved and that the bound holds.
"""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn
from torch.distributions import Categorical, Distribution, Independent, Normal, kl_divergence
from torch.nn import functional as F
from torch.nn.utils import parameters_to_vector, vector_to_parameters
from torchrl.envs import EnvBase
from torchrl.modules import TanhNormal

from coil_rl.envs.limits import check_range
from coil_rl.learners.networks import Choices
from coil_rl.learners.ppo import PPO, standardise


class TRPO(PPO):
    """The TRPO learner. The optimiser, its passes and its minibatches are for the critic only.

    Args:
        env, in_keys, options: as for `PPO`; auxiliary losses are part of the objective.
        max_kl: bound on a step, mean KL(before || after) over the batch.
        damping: added to the diagonal of the Fisher matrix, which may be singular.
        iterations: of the conjugate gradients.
        backtracks: how often the line search may shorten a step.
        shrink: factor by which it shortens a step.
    """

    with_memory = False

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[NestedKey] = ("observation",),
        *,
        max_kl: float = 0.03,
        damping: float = 0.1,
        iterations: int = 10,
        backtracks: int = 10,
        shrink: float = 0.8,
        **options: Any,
    ) -> None:
        check_range(0, above=True, max_kl=max_kl)
        check_range(0, 1, above=True, shrink=shrink)
        check_range(0, damping=damping, backtracks=backtracks)
        check_range(1, iterations=iterations)
        super().__init__(
            env, in_keys, clip=1.0, entropy=0.0, critic=1.0, compile=False, **options
        )  # no clipped loss
        self.max_kl, self.damping, self.iterations = max_kl, damping, iterations
        self.backtracks, self.shrink = backtracks, shrink

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
        errors = []
        for minibatch in self.draw_minibatches(rows):
            value = self.critic(minibatch.select(*self.critic.in_keys))["state_value"]
            error = F.mse_loss(value, minibatch["value_target"])
            self.gradient.minimise(error)
            errors.append(error.detach())
        means = {
            "loss_critic": float(torch.stack(errors).mean()),
            "learning_rate": self.learning_rate(progress),
        }
        return (
            {name: float(value) for name, value in report.items()}
            | means
            | self.finish(batch, progress)
        )

    def improve(self, rows: TensorDictBase, progress: float = 0.0) -> dict[str, Any]:
        """Take a step of the policy; returns its metrics.

        Of the rows [N] with `minibatch_keys` those in which a guide acted count for auxiliary
        losses only.
        """
        agent_rows = rows[rows["agent_acts"].squeeze(-1)] if self.guide_may_act else rows
        if (
            self.policy_waits(progress) or len(agent_rows) < 2
        ):  # one advantage cannot be standardised
            names = ("objective", *(auxiliary.name for auxiliary in self.auxiliary))
            return {f"loss_{name}": 0.0 for name in names} | {"kl": 0.0, "step": 0.0}
        weights = list(self.policy.parameters())
        observed = agent_rows.select(*self.policy.in_keys)
        advantage = standardise(agent_rows["advantage"]).squeeze(-1)
        with torch.no_grad():
            before = unsquashed(self.policy.get_dist(observed.copy()))

        def evaluate() -> tuple[Tensor, Tensor, dict[str, Tensor]]:
            """Return the total loss, the divergence, and each loss."""
            after = self.policy.get_dist(observed.copy())
            ratio = (after.log_prob(agent_rows["action"]) - agent_rows["action_log_prob"]).exp()
            total = -(ratio * advantage).mean()
            losses = {"loss_objective": total}
            for auxiliary in self.auxiliary:
                losses[f"loss_{auxiliary.name}"] = loss = auxiliary(self.policy, rows)
                total = total + auxiliary.coefficient_at(progress) * loss
            return total, kl_divergence(before, unsquashed(after)).mean(), losses

        loss, divergence, losses = evaluate()
        gradient = derivative(loss, weights)
        slope = derivative(divergence, weights, differentiable=True)

        def fisher(vector: Tensor) -> Tensor:
            return derivative(slope @ vector, weights) + self.damping * vector

        direction = conjugate_gradients(fisher, -gradient, self.iterations)
        curvature = direction @ fisher(direction)
        step = direction * (2 * self.max_kl / curvature.clamp_min(1e-30)).sqrt()
        start, fraction = parameters_to_vector(weights).detach().clone(), 1.0
        with torch.no_grad():
            for _ in range(self.backtracks + 1):
                vector_to_parameters(start + fraction * step, weights)
                new_loss, divergence, new_losses = evaluate()
                if (new_loss < loss) & (divergence <= self.max_kl):
                    return new_losses | {"kl": divergence, "step": fraction}
                fraction *= self.shrink
            vector_to_parameters(start, weights)
        return losses | {"kl": 0.0, "step": 0.0}


def unsquashed(distribution: Any) -> Distribution:
    """Return the distribution before squashing; squashing does not change KL divergences."""
    if isinstance(distribution, Categorical):
        return Categorical(logits=distribution.logits)
    if isinstance(distribution, Choices):
        return distribution
    normal = distribution if isinstance(distribution, TanhNormal) else distribution.base_dist
    return Independent(Normal(normal.loc, normal.scale), len(distribution.event_shape))


def conjugate_gradients(
    product: Callable[[Tensor], Tensor], target: Tensor, iterations: int
) -> Tensor:
    """Solve A x = b for a positive definite A, given its `product` with a vector, without waiting for the device.

    For b = `target` [n], n iterations suffice in exact arithmetic. Iterations after convergence
    change nothing.
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


def derivative(value: Tensor, weights: Sequence[Tensor], differentiable: bool = False) -> Tensor:
    """Return the derivative of a scalar with respect to all weights, as one vector; the graph is kept."""
    return parameters_to_vector(
        torch.autograd.grad(value, weights, retain_graph=True, create_graph=differentiable)
    )
