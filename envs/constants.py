"""Cached constant tensors.

On a small batch an operation with a Python number takes twice as long as one with a tensor, because
PyTorch converts the number on every call. Creating the numbers 0, 1, 2, ... takes as long as two
operations.
"""

from collections.abc import Sequence
from functools import lru_cache

import torch
from torch import Tensor


def constant(
    value: float | Sequence[float], like: Tensor, dtype: torch.dtype | None = None
) -> Tensor:
    """Return a constant tensor that broadcasts against another one; it must not be written to.

    Args:
        value: a number gives a tensor without dimensions; one number per row, as a tuple or a
            range, gives [rows, 1, ...] with as many dimensions as `like`.
        like: the other tensor, [any, *batch]; the constant is on its device.
        dtype: of the constant; by default that of `like`.
    """
    # Compiled code makes constants part of itself, so there is nothing to cache.
    make = _new if torch.compiler.is_compiling() else _cached
    return make(value, like.ndim - 1, dtype or like.dtype, like.device)


def flat_index(rows: Tensor) -> Tensor:
    """Convert row indices into a tensor to indices into its flattened form.

    Args:
        rows: [K, *batch], for each place of the batch the indices of K of the N rows of a tensor
            [N, *batch].

    Returns:
        Indices into the flattened tensor [N * batch]: [K * batch], so that one `index_select` reads
        other rows in each place of the batch.
    """
    rows = rows.view(len(rows), -1)
    columns = rows.shape[1]
    if torch.compiler.is_exporting():  # for any number of columns
        numbers = torch.arange(columns, dtype=rows.dtype, device=rows.device)
    else:
        make = _new if torch.compiler.is_compiling() else _cached
        numbers = make(range(columns), 0, rows.dtype, rows.device)
    return torch.add(numbers, rows, alpha=columns).flatten()


def _new(
    value: float | Sequence[float], dims: int, dtype: torch.dtype, device: torch.device
) -> Tensor:
    if isinstance(value, int | float):
        return torch.tensor(value, dtype=dtype, device=device)
    return torch.tensor(list(value), dtype=dtype, device=device).view(-1, *[1] * dims)


@lru_cache(maxsize=1024)
def _cached(
    value: float | Sequence[float], dims: int, dtype: torch.dtype, device: torch.device
) -> Tensor:
    # Autograd rejects tensors created in inference mode, which may be active at the first call.
    with torch.inference_mode(False):
        return _new(value, dims, dtype, device)
