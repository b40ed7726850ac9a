import torch

from coil_rl.envs.constants import constant


def test_constants_created_in_inference_mode_support_autograd():
    with torch.inference_mode():
        constant(0.123, torch.zeros(2))
    leaf = torch.ones(2, requires_grad=True)
    (leaf * constant(0.123, leaf)).square().sum().backward()
    assert torch.allclose(leaf.grad, torch.full((2,), 2 * 0.123**2))
