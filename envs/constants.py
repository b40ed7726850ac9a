"""Constant tensors, made once.

On a small batch an operation with a Python number takes twice as long as one with a tensor, because PyTorch makes a
tensor of the number every time; and to make the numbers 0, 1, 2, ... takes as long as two operations.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import torch
from torch import Tensor


def constant(value: float | Sequence[float], like: Tensor, dtype: torch.dtype | None = None) -> Tensor:
    """A number, or a column of numbers, for an operation with another tensor. It is not to be changed.

    Args:
        value: a number, or as many as the column has rows: a tuple or a range.
        like: what it goes with, [any, *batch], on whose device it is.
        dtype: that of `like` by default.

    Returns:
        A tensor without dimensions, or [rows, 1, ...] of as many dimensions as `like`.

    Example:
        >>> constant(range(3), torch.zeros(8, 2)).tolist()
        [[0.0], [1.0], [2.0]]
    """
    make = _made if torch.compiler.is_compiling() else _kept
    return make(value, like.ndim - 1, dtype or like.dtype, like.device)


def flat_index(place: Tensor) -> Tensor:
    """Rows [K, *batch] of a tensor [N, *batch] as places in it once it is flattened, [K * batch]."""
    rows = place.view(len(place), -1)
    columns = rows.shape[1]
    make = _made if torch.compiler.is_compiling() else _kept
    return torch.add(make(range(columns), 0, place.dtype, place.device), rows, alpha=columns).flatten()


def _made(value: float | Sequence[float], dims: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    if isinstance(value, int | float):
        return torch.tensor(value, dtype=dtype, device=device)
    return torch.tensor(list(value), dtype=dtype, device=device).view(-1, *[1] * dims)


@lru_cache(maxsize=1024)
def _kept(value: float | Sequence[float], dims: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    # Nothing could be differentiated with tensors made in inference mode, which may be on at the first call.
    with torch.inference_mode(False):
        return _made(value, dims, dtype, device)
