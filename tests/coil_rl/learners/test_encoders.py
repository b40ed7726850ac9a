"""Networks by YAML: widths, activations and images."""

import pytest
import torch
from any_env import AnyEnv, action_of, learning
from torch import nn
from torchrl.data import Bounded, Unbounded

from coil_rl.learners import DQN, PPO, SAC
from coil_rl.learners.encoders import Cnn, Mlp, ObservationNetwork

SMALL = {"channels": [4, 8], "kernels": [3, 3], "strides": [2, 1], "hidden": [16]}


def images(*shape, dtype=torch.uint8, action=None):
    image = (
        Bounded(0, 255, shape, dtype=dtype)
        if dtype == torch.uint8
        else Unbounded(shape, dtype=dtype)
    )
    return AnyEnv(4, action, {"image": image, "speed": Unbounded((2,))})


class Skip(nn.Module):
    """A layer that is added to what it reads, and one after it."""

    def __init__(self, inputs, outputs):
        super().__init__()
        self.inner, self.last = nn.Linear(inputs, inputs), nn.Linear(inputs, outputs)

    def forward(self, x):
        return self.last(x + self.inner(x).tanh())


class Skips(Mlp):
    """An architecture of somebody else."""

    def layers(self, inputs, outputs, gain, device=None):
        return Skip(inputs, outputs)


@pytest.mark.parametrize(("kind", "networks"), [(PPO, 2), (SAC, 3), (DQN, 1)])
def test_every_network_has_layers_of_ones_own_and_learns(kind, networks):
    env = AnyEnv(action=action_of(kind))
    learner, rollout = learning(kind, env, ["observation"], network=Skips())
    learned = (learner.policy, learner.critic, getattr(learner, "critics", None))
    parts = {part for each in learned if each for part in each.modules() if type(part) is Skip}
    before = {part: part.inner.weight.clone() for part in parts}
    assert len(parts) == networks
    learner.update(rollout.collect())
    assert not any(torch.equal(part.inner.weight, weight) for part, weight in before.items())


@pytest.mark.parametrize("options", [{"dropout": 0.1}, {"critic_layer_norm": True}])
def test_critics_with_layers_of_ones_own_do_not_normalise_or_drop(options):
    with pytest.raises(ValueError, match="Skips has layers of its own"):
        SAC(AnyEnv(), network=Skips(), **options)


def test_default_network_is_that_of_hidden_to_the_bit():
    weights = []
    for options in ({"hidden": [8, 4]}, {"network": Mlp([8, 4])}, {"network": Mlp([8, 4], "relu")}):
        torch.manual_seed(0)
        weights.append(nn.utils.parameters_to_vector(PPO(AnyEnv(), **options).policy.parameters()))
    assert torch.equal(weights[0], weights[1])
    assert not torch.equal(weights[0], weights[2])


@pytest.mark.parametrize("activation", ["relu", "elu", "silu"])
def test_activation_is_used_and_gain_scales_the_last_layer(activation):
    env = AnyEnv()
    policy = PPO(env, network=Mlp([8], activation), action_gain=0.0).policy
    assert any(type(module).__name__.lower() == activation for module in policy.modules())
    assert (policy(env.reset())["loc"] == 0).all()


@pytest.mark.parametrize("kind", [PPO, SAC, DQN])
@pytest.mark.parametrize("shape", [(3, 16, 12), (16, 12, 3)])
def test_learners_update_with_images_and_vectors(kind, shape):
    torch.manual_seed(0)
    env = images(*shape, action=action_of(kind))
    learner, rollout = learning(kind, env, ["image", "speed"], network=Cnn(**SMALL))
    convolutions = [module for module in learner.policy.modules() if isinstance(module, nn.Conv2d)]
    assert [(layer.in_channels, layer.out_channels) for layer in convolutions] == [(3, 4), (4, 8)]
    before = convolutions[0].weight.clone()
    assert torch.tensor(list(learner.update(rollout.collect()).values())).isfinite().all()
    assert not torch.equal(convolutions[0].weight, before)


def test_image_is_read_the_same_with_channels_first_and_last_in_bytes_and_fractions():
    torch.manual_seed(0)
    image, speed = torch.randint(256, (5, 6, 16, 12, 3), dtype=torch.uint8), torch.randn(5, 6, 2)
    outputs = []
    for dtype in (torch.uint8, torch.float32):
        values = image if dtype == torch.uint8 else image / 255
        for last in (True, False):
            torch.manual_seed(1)
            env = images(*((16, 12, 3) if last else (3, 16, 12)), dtype=dtype)
            network = ObservationNetwork(env, ["image", "speed"], Cnn(**SMALL), 7, 1.0)
            outputs.append(network(values if last else values.movedim(-1, -3), speed))
            one = network((values if last else values.movedim(-1, -3))[0, 0], speed[0, 0])
            torch.testing.assert_close(one, outputs[-1][0, 0])
    assert outputs[0].shape == (5, 6, 7)
    for each in outputs[1:]:
        torch.testing.assert_close(each, outputs[0])
