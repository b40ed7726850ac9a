import copy
import math

import pytest
import torch
import worlds
from any_env import check_same_update

from coil_rl.learners import TRPO
from coil_rl.learners.trpo import conjugate_gradients
from coil_rl.run.rollout import Rollout
from coil_rl.schedules import Linear
from coil_rl.transforms import Takeover


def weights(learner):
    return torch.cat([p.detach().flatten() for p in learner.policy.parameters()])


def prepared(learner, env, steps=16):
    torch.manual_seed(1)
    return learner.prepare(Rollout(env, learner.policy, steps, learner.keys).collect(), 0.0)


def linear(**options):
    """A policy with a linear mean of one observation and a global standard deviation."""
    torch.manual_seed(0)
    env = worlds.pendulum()
    learner = TRPO(
        env, ["thdot"], hidden=[], action_gain=0.3, action_scale=0.7, damping=0.0, **options
    )
    return learner, prepared(learner, env, 200)


@pytest.mark.parametrize("size", [1, 5, 30])
def test_conjugate_gradients_solve_a_linear_system(size):
    torch.manual_seed(0)
    root = torch.randn(size, size, dtype=torch.float64)
    matrix, target = root @ root.T + 0.1 * torch.eye(size), torch.randn(size, dtype=torch.float64)
    # Twice as many iterations as exact arithmetic needs; the superfluous ones change nothing.
    solution = conjugate_gradients(lambda vector: matrix @ vector, target, 2 * size)
    torch.testing.assert_close(solution, torch.linalg.solve(matrix, target), rtol=1e-3, atol=1e-4)
    assert (conjugate_gradients(lambda vector: matrix @ vector, 0 * target, 5) == 0).all()


def order_of_weights(learner):
    """Return the places of weight, bias and logarithmic scale of a linear policy in `weights`."""
    names = [name for name, _ in learner.policy.named_parameters()]
    return [
        next(i for i, name in enumerate(names) if name.endswith(end))
        for end in ("weight", "bias", "log_scale")
    ]


def natural_step(inputs, standard, advantage, scale, bound):
    """Return the exact step of the weight, the bias and the logarithmic scale of a linear policy.

    Fisher matrix and gradient of a normal distribution are known: F = diag(E[x x^T] / s^2, 2).
    """
    gradient = torch.cat(
        [(advantage * standard / scale * inputs).mean(0), (advantage * (standard**2 - 1)).mean(0)]
    )
    fisher = torch.zeros(3, 3, dtype=torch.float64)
    fisher[:2, :2] = inputs.T @ inputs / len(inputs) / scale**2
    fisher[2, 2] = 2
    natural = torch.linalg.solve(fisher, gradient)
    return natural * math.sqrt(2 * bound / (gradient @ natural))


def test_step_is_the_exact_natural_gradient_scaled_to_the_bound():
    bound = 1e-6  # so small that the divergence is its second order
    learner, rows = linear(max_kl=bound, iterations=10)
    head = learner.policy.module[0].module
    scale = head.log_scale.exp().detach()
    observed = rows["thdot"].reshape(-1, 1)
    inputs = torch.cat([observed, torch.ones_like(observed)], 1).double()
    with torch.no_grad():
        mean, _ = head(rows["thdot"])
    standard = ((rows["action"] / 2).clamp(-1 + 1e-6, 1 - 1e-6).atanh() - mean).double() / scale
    advantage = rows["advantage"].double()
    advantage = (advantage - advantage.mean()) / advantage.std()
    expected = natural_step(inputs, standard, advantage, scale, bound)

    before = weights(learner)
    report = learner.improve(rows)
    step = (weights(learner) - before)[order_of_weights(learner)].double()
    torch.testing.assert_close(step / report["step"], expected, rtol=0.02, atol=2e-6)
    assert report["kl"] <= bound


@pytest.mark.parametrize("world", [worlds.cones, worlds.carts])
@pytest.mark.parametrize("bound", [1e-4, 1e-2, 1.0])
def test_bound_holds_and_objective_does_not_get_worse(world, bound):
    torch.manual_seed(0)
    env = world()
    learner = TRPO(env, max_kl=bound, damping=0.01)
    for _ in range(2):
        report = learner.improve(prepared(learner, env, 8))
        assert report["kl"] <= bound
        assert (
            report["loss_objective"] <= 1e-6
        )  # before the step it is minus the mean of what was standardised


def test_step_is_not_taken_if_the_line_search_fails():
    learner, rows = linear(backtracks=0, max_kl=1e6)
    before = weights(learner)
    report = learner.improve(rows)
    assert report["step"] == report["kl"] == 0
    assert torch.equal(before, weights(learner))


def test_restored_learner_goes_on_with_the_same_digits_from_any_number_of_steps():
    """The last digits of a product depend on where its numbers are in the memory."""
    torch.manual_seed(0)
    env = worlds.cones(Takeover(Linear(0.5, 0.5)))
    first, second = (TRPO(env, minibatches=2) for _ in range(2))
    rollout = Rollout(env, first.policy, 8, first.keys)
    for _ in range(3):
        first.update(rollout.collect())
    second.load_state_dict(copy.deepcopy(first.state_dict()))
    check_same_update(first, second, rollout.collect())
