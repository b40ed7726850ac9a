"""Activations of networks by name, with a tanh that takes a third of the time.

PyTorch's tanh on a CPU takes four times as long as its sigmoid, and in an update of small networks
a quarter of the time. The two are one function: tanh(x) = 2 sigmoid(2 x) - 1.
"""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn


class FastTanh(nn.Module):
    """Tanh from the sigmoid, within 2e-7 of tanh (PyTorch's own is within 3e-8).

    It may overwrite its argument, as an activation after a layer may.
    """

    def forward(self, x: Tensor) -> Tensor:
        """Return tanh of x, of the same shape."""
        simple = not (x.requires_grad and torch.is_grad_enabled()) or x.is_leaf
        if simple or torch.compiler.is_compiling() or torch._C._are_functorch_transforms_active():
            return (x * 2).sigmoid().mul(2).sub(1)
        y: Tensor = _Tanh.apply(x)
        return y


class _Tanh(torch.autograd.Function):
    """Tanh in the memory of its argument."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        y = x.mul_(2).sigmoid_().mul_(2).sub_(1)
        ctx.mark_dirty(x)
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (y,) = ctx.saved_tensors
        product: Tensor = torch.ops.aten.tanh_backward(gradient, y)
        return product


ACTIVATIONS: Mapping[str, type[nn.Module]] = {
    "tanh": nn.Tanh,
    "relu": nn.ReLU,
    "elu": nn.ELU,
    "silu": nn.SiLU,
    "fast_tanh": FastTanh,
}
ORTHOGONAL = (nn.Tanh, FastTanh)  # whose layers have orthogonal initial weights
