import math

import pytest
import torch
import worlds
from cart_poles import CartPoles

from coil_rl.learners import TRPO, GuideLoss
from coil_rl.learners.trpo import conjugate_gradients
from coil_rl.train.rollout import Rollout
from coil_rl.transforms import Takeover


def weights(made):
    return torch.cat([p.detach().flatten() for p in made.policy.parameters()])


def prepared(made, env, steps=16):
    torch.manual_seed(1)
    return made.prepare(Rollout(env, made.policy, steps, made.keys).collect(), 0.0)


def linear(**options):
    """A policy that is linear in one observation and sure to a degree that is its only other parameter."""
    torch.manual_seed(0)
    env = worlds.pendulum()
    made = TRPO(env, ["thdot"], hidden=[], action_gain=0.3, action_scale=0.7, damping=0.0, **options)
    return made, prepared(made, env, 200)


@pytest.mark.parametrize("size", [1, 5, 30])
def test_conjugate_gradients_solve_a_linear_system(size):
    torch.manual_seed(0)
    root = torch.randn(size, size, dtype=torch.float64)
    matrix, wanted = root @ root.T + 0.1 * torch.eye(size), torch.randn(size, dtype=torch.float64)
    # Twice as many as exact arithmetic needs; what is superfluous changes nothing.
    found = conjugate_gradients(lambda vector: matrix @ vector, wanted, 2 * size)
    torch.testing.assert_close(found, torch.linalg.solve(matrix, wanted), rtol=1e-3, atol=1e-4)


def test_conjugate_gradients_of_nothing_are_nothing():
    assert (conjugate_gradients(lambda vector: 2 * vector, torch.zeros(3), 5) == 0).all()


def test_the_step_is_the_exact_natural_gradient_scaled_to_the_bound():
    """Fisher matrix and gradient of a normal distribution are known: F = diag(E[x x^T] / s^2, 2)."""
    bound = 1e-6  # so small that the divergence is its second order
    made, rows = linear(max_kl=bound, iterations=10)
    head = made.policy.module[0].module
    scale = head.log_scale.exp().detach()
    seen = rows["thdot"].reshape(-1, 1)
    inputs = torch.cat([seen, torch.ones_like(seen)], 1).double()
    with torch.no_grad():
        mean, _ = head(rows["thdot"])
    standard = ((rows["action"] / 2).clamp(-1 + 1e-6, 1 - 1e-6).atanh() - mean).double() / scale
    advantage = rows["advantage"].double()
    advantage = (advantage - advantage.mean()) / advantage.std()
    gradient = torch.cat([(advantage * standard / scale * inputs).mean(0), (advantage * (standard**2 - 1)).mean(0)])
    fisher = torch.zeros(3, 3, dtype=torch.float64)
    fisher[:2, :2] = inputs.T @ inputs / len(inputs) / scale**2
    fisher[2, 2] = 2
    natural = torch.linalg.solve(fisher, gradient)
    expected = natural * math.sqrt(2 * bound / (gradient @ natural))

    names = [name for name, _ in made.policy.named_parameters()]
    order = [next(i for i, name in enumerate(names) if name.endswith(end)) for end in ("weight", "bias", "log_scale")]
    before = weights(made)
    report = made.improve(rows)
    step = (weights(made) - before)[order].double()
    torch.testing.assert_close(step / report["step"], expected, rtol=0.02, atol=2e-6)
    assert report["kl"] <= bound


@pytest.mark.parametrize("world", [worlds.cones, worlds.carts])
@pytest.mark.parametrize("bound", [1e-4, 1e-2, 1.0])
def test_the_bound_holds_and_the_objective_never_gets_worse(world, bound):
    torch.manual_seed(0)
    env = world()
    made = TRPO(env, max_kl=bound, damping=0.01)
    for _ in range(2):
        report = made.improve(prepared(made, env, 8))
        assert report["kl"] <= bound
        assert report["loss_objective"] <= 1e-6  # before the step it is minus the mean of what was standardised


def test_a_step_that_no_shortening_makes_better_is_not_taken():
    made, rows = linear(backtracks=0, max_kl=1e6)
    before = weights(made)
    report = made.improve(rows)
    assert report["step"] == report["kl"] == 0
    assert torch.equal(before, weights(made))


def test_auxiliary_losses_are_part_of_what_the_step_improves():
    torch.manual_seed(0)
    env = worlds.cones(cars=16)
    made = TRPO(env, auxiliary=[GuideLoss(100.0)], max_kl=0.1)
    rollout = Rollout(env, made.policy, 8, made.keys)
    losses = [made.update(rollout.collect())["loss_guide"] for _ in range(6)]
    assert losses[-1] < losses[0] - 0.3


def test_without_a_step_of_its_own_the_policy_stays():
    torch.manual_seed(0)
    env = worlds.cones(Takeover(1.0))
    made = TRPO(env, epochs=1, minibatches=2)
    before = weights(made)
    metrics = made.update(Rollout(env, made.policy, 8, made.keys).collect())
    assert metrics["kl"] == metrics["step"] == 0 < metrics["loss_critic"]
    assert torch.equal(before, weights(made))


@pytest.mark.parametrize(
    ("name", "value"),
    [("max_kl", 0), ("damping", -1), ("iterations", 0), ("backtracks", -1), ("shrink", 1.5), ("epochs", 0)],
)
def test_numbers_outside_their_range_are_refused(name, value):
    with pytest.raises(ValueError, match=f"{name}={value} must be"):
        TRPO(CartPoles(2), **{name: value})
