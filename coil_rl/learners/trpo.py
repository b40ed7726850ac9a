"""Trust region policy optimisation (paper equations 89 and 90; Schulman et al. 2015).

One step a batch, along the natural gradient: the direction in which the objective grows most for a given change of what
the policy does, measured by the KL divergence, and as far as that may change. To second order the divergence is
x F x / 2 with the Fisher matrix F, so the step is F^-1 g scaled to the bound. F is never formed: conjugate gradients
need only its product with a vector, which is a second derivative of the divergence. A line search then sees to it that
the objective did grow and the bound holds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.distributions import Categorical, Distribution, Independent, Normal, kl_divergence
from torch.nn import functional as F
from torch.nn.utils import parameters_to_vector
from torchrl.envs import EnvBase
from torchrl.modules import TanhNormal

from coil_rl.learners.actor_critic import ActorCritic
from coil_rl.learners.advantages import Advantages, standardised
from coil_rl.learners.limits import check_numbers


class TRPO(ActorCritic):
    """The TRPO learner. Its optimiser, its passes and its minibatches are the critic's: the policy needs none.

    Args:
        env: for the shapes of what is observed and done.
        in_keys: what policy and critic observe.
        gamma: discount.
        gae_lambda: lambda of generalised advantage estimation.
        max_kl: by how much a step may change the policy, mean KL(before || after) over the batch.
        damping: added to the diagonal of the Fisher matrix, which may be singular.
        iterations: of the conjugate gradients.
        backtracks: how often the line search shortens a step before it gives it up.
        shrink: to which fraction, each time.
        epochs: the critic's passes over each batch.
        minibatches: parts of each of its passes.
        networks_and_optimiser: everything else as for `ActorCritic`; auxiliary losses are part of the objective.

    Raises:
        ValueError: for a value outside its range.

    Example:
        >>> from coil_rl.envs import ConeTrackEnv, shipped_tracks
        >>> from coil_rl.train.rollout import Rollout
        >>> env = ConeTrackEnv(shipped_tracks("train"), num_cars=64)
        >>> trpo = TRPO(env)
        >>> metrics = trpo.update(Rollout(env, trpo.policy, steps=32).collect())
    """

    kind = "agent"

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[str] = ("observation",),
        *,
        gamma: float = 0.99,
        gae_lambda: float = 0.95,
        max_kl: float = 0.01,
        damping: float = 0.1,
        iterations: int = 10,
        backtracks: int = 10,
        shrink: float = 0.8,
        epochs: int = 5,
        minibatches: int = 16,
        **networks_and_optimiser: Any,
    ) -> None:
        check_numbers(0, above=True, max_kl=max_kl, shrink=shrink)
        check_numbers(0, 1, shrink=shrink)
        check_numbers(0, damping=damping, backtracks=backtracks)
        check_numbers(1, iterations=iterations, epochs=epochs)
        super().__init__(env, in_keys, minibatches=minibatches, **networks_and_optimiser)
        self.max_kl, self.damping, self.iterations = max_kl, damping, iterations
        self.backtracks, self.shrink, self.epochs = backtracks, shrink, epochs
        self.advantage = Advantages(self.critic, gamma, gae_lambda)

    def groups(self) -> list[list[torch.nn.Parameter]]:
        """The critic's parameters alone."""
        return [list(self.critic.parameters())]

    def update(self, batch: TensorDictBase, progress: float = 0.0) -> dict[str, float]:
        """Learn from a batch of rollouts.

        Args:
            batch: as for `ActorCritic`.
            progress: share of the run that is over, for the schedules.

        Returns:
            The losses of the policy after its step; `kl`, how far it went; `step`, which fraction of the step that
            leads to the bound the line search took, 0 if none; and the mean loss of the critic.
        """
        flat = self.prepare(batch, progress)
        report = self.improve(flat, progress)
        errors = []
        for minibatch in self.passes(flat, self.epochs):
            value = self.critic(minibatch.select(*self.critic.in_keys))["state_value"]
            error = F.mse_loss(value, minibatch["value_target"])
            self.step(error)
            errors.append(error.detach())
        means = {"loss_critic": float(torch.stack(errors).mean()), "learning_rate": self.learning_rate(progress)}
        return {name: float(value) for name, value in report.items()} | means

    def improve(self, flat: TensorDictBase, progress: float = 0.0) -> dict[str, Any]:
        """Step the policy.

        Args:
            flat: [N] with `learned_from`. Steps in which a guide acted are left out but for auxiliary losses.
            progress: as for `update`.

        Returns:
            What `update` returns of the policy, numbers or scalars.
        """
        rows = flat[flat["agent_acts"].squeeze(-1)] if self.shares_control else flat
        if len(rows) < 2:  # one advantage cannot be standardised
            names = ("objective", *(auxiliary.name for auxiliary in self.auxiliary))
            return {f"loss_{name}": 0.0 for name in names} | {"kl": 0.0, "step": 0.0}
        weights = list(self.policy.parameters())
        seen, advantage = rows.select(*self.policy.in_keys), standardised(rows["advantage"]).squeeze(-1)
        with torch.no_grad():
            before = unsquashed(self.policy.get_dist(seen.copy()))

        def look() -> tuple[Tensor, Tensor, dict[str, Tensor]]:
            """The loss in all, the divergence, and each loss."""
            now = self.policy.get_dist(seen.copy())
            ratio = (now.log_prob(rows["action"]) - rows["action_log_prob"]).exp()
            total = -(ratio * advantage).mean()
            losses = {"loss_objective": total}
            for auxiliary in self.auxiliary:
                losses[f"loss_{auxiliary.name}"] = loss = auxiliary(self.policy, flat)
                total = total + auxiliary.coefficient(progress) * loss
            return total, kl_divergence(before, unsquashed(now)).mean(), losses

        loss, divergence, losses = look()
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
                assign(weights, start + fraction * step)
                reached, divergence, candidates = look()
                if (reached < loss) & (divergence <= self.max_kl):
                    return candidates | {"kl": divergence, "step": fraction}
                fraction *= self.shrink
            assign(weights, start)
        return losses | {"kl": 0.0, "step": 0.0}


def unsquashed(distribution: Any) -> Distribution:
    """What KL divergences are computed between: squashing is the same for both, and they do not see it."""
    if isinstance(distribution, Categorical):
        return Categorical(logits=distribution.logits)
    normal = distribution if isinstance(distribution, TanhNormal) else distribution.base_dist
    return Independent(Normal(normal.loc, normal.scale), 1)


def conjugate_gradients(product: Callable[[Tensor], Tensor], wanted: Tensor, iterations: int) -> Tensor:
    """Solve A x = b for a positive definite matrix.

    Args:
        product: A times a vector.
        wanted: b, [n].
        iterations: n of them suffice; where fewer do, the others change nothing. None waits for the device.
    """
    solution, residual, direction = torch.zeros_like(wanted), wanted.clone(), wanted.clone()
    square = start = residual @ residual
    for _ in range(iterations):
        goes_on = square > 1e-10 * start
        image = product(direction)
        length = torch.where(goes_on, square / (direction @ image), 0.0)
        solution, residual = solution + length * direction, residual - length * image
        before, square = square, residual @ residual
        direction = residual + torch.where(goes_on, square / before, 0.0) * direction
    return solution


def derivative(value: Tensor, weights: Sequence[Tensor], differentiable: bool = False) -> Tensor:
    """Of a scalar by all weights as one vector, keeping the graph for more of them."""
    return parameters_to_vector(torch.autograd.grad(value, weights, retain_graph=True, create_graph=differentiable))


def assign(weights: Sequence[Tensor], vector: Tensor) -> None:
    """Set all weights from one vector."""
    for weight, values in zip(weights, vector.split([weight.numel() for weight in weights]), strict=True):
        weight.copy_(values.view_as(weight))
