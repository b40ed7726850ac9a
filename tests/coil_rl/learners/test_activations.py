import pytest
import torch
import worlds
from torch import nn

from coil_rl.learners import PPO, SAC, TRPO, Mlp
from coil_rl.learners.activations import FastTanh
from coil_rl.run.rollout import Rollout


def layers(activation):
    torch.manual_seed(0)
    return nn.Sequential(nn.Linear(3, 64), activation, nn.Linear(64, 64), activation)


def test_fast_tanh_is_tanh_within_2e_7():
    x = torch.linspace(-20, 20, 400_001)
    exact = x.double().tanh()
    assert float((FastTanh()(x.clone()) - exact).abs().max()) < 2e-7
    assert FastTanh()(torch.tensor([-torch.inf, 0.0, torch.inf])).tolist() == [-1.0, 0.0, 1.0]


def test_numbers_are_the_same_with_a_gradient_without_one_and_for_a_batch_of_weights():
    x, net = torch.randn(500, 3), layers(FastTanh())
    with_gradient = net(x)
    assert with_gradient.requires_grad
    with torch.no_grad():
        assert torch.equal(net(x), with_gradient)

    def call(weights):
        return torch.func.functional_call(net, weights, (x,))

    stacked = {name: each.detach()[None] for name, each in net.named_parameters()}
    torch.testing.assert_close(torch.vmap(call)(stacked)[0], with_gradient)


def test_gradients_of_first_and_second_order_are_those_of_tanh():
    x, found = torch.randn(200, 3, requires_grad=True), []
    for activation in (nn.Tanh(), FastTanh()):
        (first,) = torch.autograd.grad(layers(activation)(x).square().sum(), x, create_graph=True)
        (second,) = torch.autograd.grad(first.square().sum(), x)
        found.append((first.detach(), second))
    torch.testing.assert_close(found[0], found[1], rtol=1e-4, atol=1e-4)
    leaf = torch.randn(5, requires_grad=True)
    before = leaf.detach().clone()
    FastTanh()(leaf).sum().backward()
    assert torch.equal(leaf.detach(), before)
    torch.testing.assert_close(leaf.grad, 1 - before.tanh().square())


@pytest.mark.slow
@pytest.mark.parametrize("kind", [PPO, TRPO, SAC])
def test_a_learner_with_fast_tanh_begins_and_learns_as_with_tanh(kind):
    weights = []
    for activation in ("tanh", "fast_tanh"):
        torch.manual_seed(0)
        env = worlds.cones()
        options = {"starts": 12, "batch_size": 8} if kind is SAC else {"minibatches": 2}
        learner = kind(env, network=Mlp([8, 8], activation), **options)
        Rollout(env, learner.policy, 8, learner.keys).collect()  # its steps have the same numbers
        learner.update(Rollout(env, learner.policy, 8, learner.keys).collect(), 0.1)
        weights.append([each.detach() for each in learner.policy.parameters()])
    torch.testing.assert_close(weights[0], weights[1], rtol=1e-3, atol=1e-4)
